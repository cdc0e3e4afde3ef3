"""Commands that tear at the body: full speed one way, and at once full speed the other."""

import asyncio
import random
from itertools import pairwise

from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL
from gigabrain_zenoh import gate
from gigabrain_zenoh.deployment import client_endpoint
from gigabrain_zenoh.faults.bodies import description_of
from gigabrain_zenoh.faults.fault import Failed, Measured
from gigabrain_zenoh.faults.forger import Forger, forging
from gigabrain_zenoh.faults.onlooker import Onlooker
from gigabrain_zenoh.faults.open_gate import OpenGate
from gigabrain_zenoh.faults.rig import Rig
from gigabrain_zenoh.faults.subject import Subject

COMMANDS, LONG_COMMANDS = 20_000, 1_000_000
WINDOW_TICKS = 12  # 240 ms
SETTLE_TICKS = 5  # before a window, so that what was on its way then counts as well
LEAST_WINDOWS = 50
TICK_S = TICK_NS / 1e9
HOLDS = (1, 2, 50)  # half-ticks for which one way is asked for: 100 Hz, 50 Hz, 1 Hz
HELD_TICKS = 150  # of each, on the robot


async def full_reversals(rig: Rig) -> Measured:
    """At the gate by the million, and with a simulated body by its own wheels."""
    body = description_of(rig)
    share = await asyncio.to_thread(_at_gate, body, LONG_COMMANDS if rig.long else COMMANDS)
    subject = await rig.robot("sim")
    return {"acceleration over its limit": max(share, await _at_wheels(subject))}


def _at_gate(body: BodyDescription, count: int) -> float:
    """Up to how much what the gate lets through exceeds the limits of acceleration [%].

    Straight on and turning, in any one tick, and so over any time; at up to 1000 commands a second.
    """
    opened, chance = OpenGate(body), random.Random(0)
    fast, most, seq = body.max_linear_speed, 0.0, 0
    while seq < count:
        opened.tick()
        for _ in range(chance.choice((1, 2, 20))):
            seq += 1
            speed = chance.choice((-fast, fast))
            opened.feed(gate.Command(opened.command(speed, seq, 10 * speed)))
            before, now = opened.state.before, opened.state.output
            straight = abs(now.linear_x - before.linear_x) / _limit(body)
            turning = abs(now.angular_z - before.angular_z) / body.max_angular_acceleration
            most = max(most, straight / TICK_S, turning / TICK_S)
    return 100.0 * max(0.0, most - 1.0)


def _limit(body: BodyDescription) -> float:
    return max(body.max_linear_acceleration, body.max_linear_deceleration)


async def _at_wheels(subject: Subject) -> float:
    """The same of the measured speed, over windows of a quarter of a second [%]."""
    onlooker = subject.onlooker
    await subject.drive()
    body = onlooker.bodies.current
    assert body
    await subject.person.enable(onlooker.bus.process, take=True)
    start = onlooker.state
    async with forging(client_endpoint(subject.deployment)) as forger:
        for hold in HOLDS:
            await _shake(subject, forger, hold, body.description.max_linear_speed)
    speeds = {s.tick: s.velocity.linear_x for s in onlooker.states if s.tick > start.tick}
    fastest = max(map(abs, speeds.values()))
    if fastest < 0.5 * body.description.max_linear_speed:
        raise Failed(f"it has not obeyed: {fastest:.2f} m/s at most")
    step = _limit(body.description) * TICK_S
    shares = [
        abs(speeds[tick + WINDOW_TICKS] - speed) / (step * allowed)
        for tick, speed in speeds.items()
        if (allowed := _steps(onlooker, tick)) and tick + WINDOW_TICKS in speeds
    ]
    if len(shares) < LEAST_WINDOWS:
        raise Failed(f"the gate was open in {len(shares)} windows only")
    await onlooker.ticks(50)
    return 100.0 * max(0.0, max(shares) - 1.0)


def _steps(onlooker: Onlooker, tick: int) -> int:
    """How many steps of the ramp may fall into the window that begins at this tick.

    None where the gate was shut in it: a stop takes all the steps that it has missed.
    """
    first, last = tick - SETTLE_TICKS, tick + WINDOW_TICKS
    states = [s for s in onlooker.states if first <= s.tick <= last]
    if any(s.gate.mode != "enabled" for s in states):
        return 0
    return WINDOW_TICKS + (not _in_time(states, last - first + 1))


def _in_time(states: list[RobotState], count: int) -> bool:
    """Whether all of so many states are there, and the driver made each at its time.

    In one that was held up, a step that was due just before falls into the window as well.
    """
    steps = [b.stamp_ns - a.stamp_ns for a, b in pairwise(states)]
    return len(states) == count and all(0 < 2 * step < 3 * TICK_NS for step in steps)


async def _shake(subject: Subject, forger: Forger, hold: int, speed: float) -> None:
    """Full speed one way and the other, two commands a tick."""
    onlooker, time = subject.onlooker, subject.onlooker.bus.time
    start = onlooker.state.tick
    while onlooker.state.tick - start < HELD_TICKS:
        for half in range(2):
            seq = 2 * time.tick + half
            command = CmdVel(
                linear_x=speed if seq // hold % 2 else -speed,
                source=onlooker.bus.process,
                boot=time.boot,
                tick=time.tick,
                basis=time.tick,
                seq=seq,
            )
            forger.send(CMD_VEL, command)
        await onlooker.ticks(1)
