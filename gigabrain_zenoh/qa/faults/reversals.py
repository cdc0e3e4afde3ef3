"""Commands that tear at the body: full speed one way, and at once another way, or turning."""

import asyncio
import random
from collections.abc import Iterator, Sequence
from itertools import pairwise

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import clamp, limits_of
from gigabrain_zenoh.qa.faults.bodies import description_of
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.forger import Forger, forging
from gigabrain_zenoh.qa.faults.onlooker import Onlooker
from gigabrain_zenoh.qa.faults.open_gate import OpenGate
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.runtime.deployment import client_endpoint

COMMANDS, LONG_COMMANDS = 20_000, 1_000_000
WINDOW_TICKS = 12  # 240 ms
SETTLE_TICKS = 5  # before a window, so that what was on its way then counts as well
LEAST_WINDOWS = 50
TICK_S = TICK_NS / 1e9
HOLDS = (1, 2, 50)  # half-ticks for which one way is asked for: 10 ms, 20 ms, 0.5 s
HELD_TICKS = 200  # of each, on the robot
WAYS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))


async def full_reversals(rig: Rig) -> Measured:
    """At the gate by the million, and on a simulated robot by what its body was told."""
    body = description_of(rig)
    share = await asyncio.to_thread(_at_gate, body, LONG_COMMANDS if rig.long else COMMANDS)
    told, measured = await _on_robot(await rig.robot("sim"))
    return {
        "acceleration told over its limit": round(max(share, told), 6),
        "acceleration measured over it": measured,
    }


def let_through(body: BodyDescription, count: int) -> Iterator[tuple[Velocity, Velocity]]:
    """Yield what the gate lets out in a tick and in the next, for `count` hostile commands.

    Full speed and full turning, each way or not at all, for up to a second each, at up to 1000
    commands a second.
    """
    opened, chance = OpenGate(body), random.Random(0)
    seq = left = 0
    while seq < count:
        opened.tick()
        if left <= 0:
            left, wild = chance.choice((1, 5, 50)), chance.random() < 0.3
            linear, angular = _any_way(body, chance)
        for _ in range(chance.choice((1, 2, 20))):
            if wild:
                linear, angular = _any_way(body, chance)
            seq += 1
            opened.feed(gate.Command(opened.command(linear, seq, angular)))
        left -= 1
        yield opened.state.before, opened.state.output


def _any_way(body: BodyDescription, chance: random.Random) -> tuple[float, float]:
    ways = (-1.0, 0.0, 1.0)
    linear, angular = body.max_linear_speed, body.max_angular_speed
    return linear * chance.choice(ways), angular * chance.choice(ways)


def _at_gate(body: BodyDescription, count: int) -> float:
    """Up to how much what a driver sends exceeds the limits of acceleration [%].

    Straight on and turning, in any one tick, and so over any time. A driver clamps what the gate
    lets out once more.
    """
    limits = limits_of(body)
    return max(
        over(body, clamp(before, limits), clamp(now, limits), 1)
        for before, now in let_through(body, count)
    )


def over(body: BodyDescription, before: Velocity, now: Velocity, ticks: int) -> float:
    """By how much a change within so many ticks exceeds the limits, straight on or turning [%]."""
    straight = abs(now.linear_x - before.linear_x) / _limit(body)
    turning = abs(now.angular_z - before.angular_z) / body.max_angular_acceleration
    return 100.0 * max(0.0, max(straight, turning) / (ticks * TICK_S) - 1.0)


def _limit(body: BodyDescription) -> float:
    return max(body.max_linear_acceleration, body.max_linear_deceleration)


async def _on_robot(subject: Subject) -> tuple[float, float]:
    """The same of what the body of a running robot was told, and of its measured speed [%]."""
    onlooker = subject.onlooker
    await subject.drive()
    body = onlooker.bodies.current
    assert body
    await subject.person.enable(onlooker.bus.process, take=True)
    start = onlooker.state
    async with forging(client_endpoint(subject.deployment)) as forger:
        for hold in HOLDS:
            await _shake(subject, forger, hold, body.description)
    states = [s for s in onlooker.states if s.boot == start.boot and s.tick > start.tick]
    told = told_over(body.description, states)
    measured = _measured_over(onlooker, states, body.description)
    await onlooker.ticks(50)
    return told, measured


def told_over(body: BodyDescription, states: Sequence[RobotState]) -> float:
    """By how much what was told from state to state exceeds the limits [%], while the gate is open.

    Raises Failed where the body was not really told to drive and to turn.
    """
    fastest = max(abs(state.sent.linear_x) for state in states)
    turning = max(abs(state.sent.angular_z) for state in states)
    if fastest < 0.5 * body.max_linear_speed or turning < 0.5 * body.max_angular_speed:
        raise Failed(f"it has not obeyed: told {fastest:.2f} m/s, {turning:.2f} rad/s at most")
    return max(
        over(body, before.sent, now.sent, now.tick - before.tick)
        for before, now in pairwise(states)
        if now.tick > before.tick and before.gate.mode == now.gate.mode == "enabled"
    )


def _measured_over(
    onlooker: Onlooker, states: Sequence[RobotState], body: BodyDescription
) -> float:
    """The same of the measured speed straight on, over windows of a quarter of a second [%]."""
    speeds = {state.tick: state.velocity.linear_x for state in states}
    step = _limit(body) * TICK_S
    shares = [
        abs(speeds[tick + WINDOW_TICKS] - speed) / (step * allowed)
        for tick, speed in speeds.items()
        if (allowed := steps_in_window(onlooker, tick)) and tick + WINDOW_TICKS in speeds
    ]
    if len(shares) < LEAST_WINDOWS:
        raise Failed(f"the gate was open in {len(shares)} windows only")
    return 100.0 * max(0.0, max(shares) - 1.0)


def steps_in_window(onlooker: Onlooker, tick: int) -> int:
    """Return how many steps of the ramp may fall into the window that begins at this tick.

    0 where the gate was shut in it, since a stop takes all the steps that it has missed; and where
    the body was sped up and slowed down in turns just before: it lags behind that, and catches up.
    """
    first, last = tick - SETTLE_TICKS, tick + WINDOW_TICKS
    states = [s for s in onlooker.states if first <= s.tick <= last]
    if any(s.gate.mode != "enabled" for s in states) or not _one_way(states, tick):
        return 0
    return WINDOW_TICKS + (not _in_time(states, last - first + 1))


def _one_way(states: list[RobotState], until: int) -> bool:
    """Return whether the commanded speed only rose, or only fell, until a tick."""
    told = [s.sent.linear_x for s in states if s.tick <= until]
    changes = [after - before for before, after in pairwise(told)]
    return min(changes, default=0.0) >= 0.0 or max(changes, default=0.0) <= 0.0


def _in_time(states: list[RobotState], count: int) -> bool:
    """Whether all of so many states are there, and the driver made each at its time.

    In one that was held up, a step that was due just before falls into the window as well.
    """
    steps = [b.stamp_ns - a.stamp_ns for a, b in pairwise(states)]
    return len(states) == count and all(0 < 2 * step < 3 * TICK_NS for step in steps)


async def _shake(subject: Subject, forger: Forger, hold: int, body: BodyDescription) -> None:
    """Full speed one way and the other, two commands a tick, and turning in between."""
    onlooker, time = subject.onlooker, subject.onlooker.bus.time
    start = onlooker.state.tick
    while onlooker.state.tick - start < HELD_TICKS:
        for half in range(2):
            seq = 2 * time.tick + half
            linear, angular = WAYS[seq // hold % len(WAYS)]
            command = CmdVel(
                linear_x=linear * body.max_linear_speed,
                angular_z=angular * body.max_angular_speed,
                source=onlooker.bus.process,
                boot=time.boot,
                tick=time.tick,
                basis=time.tick,
                seq=seq,
            )
            forger.send(CMD_VEL, command)
        await onlooker.ticks(1)
