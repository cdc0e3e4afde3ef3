"""How a driving robot comes to rest after a fault: when it begins to, and how far it goes."""

from collections.abc import Callable
from typing import NamedTuple

from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.faults.fault import Failed
from gigabrain_zenoh.faults.onlooker import Onlooker
from gigabrain_zenoh.faults.subject import Subject
from gigabrain_zenoh.faults.waiting import until

SLOWER = 0.01  # [m/s], half of what a body brakes in a tick
TICK_MS = TICK_NS / 1e6
LATE_TICKS = 2


class Stop(NamedTuple):
    """What came of a fault while driving straight on."""

    zero_ms: float  # from the last tick of the victim to the first that slows the body down
    travel_m: float  # by the physics, until at rest
    distance_m: float  # the whole path so far, by the physics


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
    zero = first_zero(onlooker, start, begin)
    return Stop((zero - begin) * TICK_MS, distance_m - before_m, distance_m)


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


def first_zero(onlooker: Onlooker, start: RobotState, begin: int) -> int:
    """The first tick since `begin` that has slowed the body down.

    Of ticks that control never answered, because this machine woke it too late, two at most do not
    count: what it would have done in the first of them it has done in the first that it saw.
    """
    shut = next(
        s.tick
        for s in onlooker.states
        if s.boot == start.boot and s.tick > start.tick and s.gate.mode != "enabled"
    )
    ours = [c for c in onlooker.commands if c.boot == start.boot]
    speed = next((c.linear_x for c in reversed(ours) if c.tick <= begin), 0.0)
    answered = begin
    for command in ours:
        if command.tick > begin and command.linear_x < speed - SLOWER:
            late = min(LATE_TICKS, max(0, command.tick - answered - 1))
            return min(shut, command.tick - late)
        answered = max(answered, command.tick)
    return shut


async def creep(subject: Subject, ticks: int) -> float:
    """How far the body goes within so many ticks, by the physics [m]."""
    before_m = await subject.distance()
    await subject.onlooker.ticks(ticks)
    return await subject.distance() - before_m
