"""How a driving robot comes to rest after a fault: when it begins to, and how far it goes."""

from collections.abc import Callable
from typing import NamedTuple

from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.qa.faults.fault import Failed
from gigabrain_zenoh.qa.faults.onlooker import Onlooker, at_rest
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until

SLOWER = 0.01  # [m/s], half of what a body brakes in a tick
TICK_MS = TICK_NS / 1e6


class Stop(NamedTuple):
    """What came of a fault while driving straight on."""

    brakes_ms: float  # from the last tick of the victim to the first that slows the body down
    zero_ms: float  # to the first tick from which the body is measured at rest
    travel_m: float  # by the physics, until at rest
    distance_m: float  # the whole path so far, by the physics

    def figures(self) -> dict[str, float]:
        """Return what a row of the table is judged by."""
        return {
            "brakes after": self.brakes_ms,
            "zero after": self.zero_ms,
            "travel": self.travel_m,
        }


async def stop_by(subject: Subject, fault: Callable[[], object], victim: str = "") -> Stop:
    """Have a fault while the brain drives, and wait until the gate is shut and the body rests.

    The time is counted from the last tick that the `victim` has answered.
    """
    onlooker = subject.onlooker
    await subject.drive()
    before_m = await subject.distance()
    start = onlooker.state
    fault()
    await until(lambda: onlooker.state.gate.mode != "enabled", "the gate begins to shut")
    begin = max(start.tick, _last_word(onlooker, victim, start))
    await until(lambda: onlooker.state.gate.mode in ("idle", "latched"), "the gate shuts")
    if not any(s.gate.causes for s in onlooker.states if s.tick > start.tick):
        raise Failed("the gate does not say why it is shut")
    await onlooker.still()
    distance_m = await subject.distance()
    brakes, zero = first_slower(onlooker, start, begin), first_zero(onlooker, start, begin)
    brakes_ms, zero_ms = (brakes - begin) * TICK_MS, (zero - begin) * TICK_MS
    return Stop(brakes_ms, zero_ms, distance_m - before_m, distance_m)


def _last_word(onlooker: Onlooker, victim: str, start: RobotState) -> int:
    """The newest tick that the victim has answered.

    Asked once the gate shuts: by then all of it has come, however busy this machine is, and nobody
    has started the victim again yet.
    """
    said = {
        "decision": onlooker.intent.current,
        "safety": onlooker.safety.current,
        "control": onlooker.commands[-1] if onlooker.commands else None,
    }.get(victim)
    return said.tick if said and said.boot == start.boot else 0


def first_slower(onlooker: Onlooker, start: RobotState, begin: int) -> int:
    """Return the first tick since `begin` that slows the body: a slower command, or a shut gate."""
    shut = next(s.tick for s in _since(onlooker, start) if s.gate.mode != "enabled")
    ours = [c for c in onlooker.commands if c.boot == start.boot]
    speed = next((c.linear_x for c in reversed(ours) if c.tick <= begin), 0.0)
    slower = (c.tick for c in ours if c.tick > begin and c.linear_x < speed - SLOWER)
    return min(shut, next(slower, shut))


def first_zero(onlooker: Onlooker, start: RobotState, begin: int) -> int:
    """Return the tick since `begin` from which the body is measured at rest."""
    moving = [s.tick for s in _since(onlooker, start) if s.tick > begin and not at_rest(s)]
    return (moving[-1] if moving else begin) + 1


def _since(onlooker: Onlooker, start: RobotState) -> list[RobotState]:
    return [s for s in onlooker.states if s.boot == start.boot and s.tick > start.tick]


async def creep(subject: Subject, ticks: int) -> float:
    """How far the body goes within so many ticks, by the physics [m]."""
    before_m = await subject.distance()
    await subject.onlooker.ticks(ticks)
    return await subject.distance() - before_m
