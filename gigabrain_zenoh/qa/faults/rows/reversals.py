"""Commands that reverse at full speed: straight on, backwards and turning, at once."""

import asyncio
import random
from collections.abc import Iterator, Sequence
from itertools import pairwise

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.topics import CMD_VEL
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import clamp, limits_of
from gigabrain_zenoh.qa.faults.fault import FaultRow
from gigabrain_zenoh.qa.faults.rig.bad_network import Forger, forged_command, forging
from gigabrain_zenoh.qa.faults.rig.hostile import OpenGate
from gigabrain_zenoh.qa.faults.rig.rig import RESTED_TICKS, Rig
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured
from gigabrain_zenoh.qa.probe import Probe
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.runtime.deployment import client_endpoint

COMMANDS, LONG_COMMANDS = 20_000, 1_000_000
WINDOW_TICKS = 12  # 240 ms
SETTLE_TICKS = 5  # before a window, so that commands still on their way count as well
MIN_WINDOWS = 50
TICK_S = TICK_NS / 1e9
HOLDS = (1, 2, 50)  # half-ticks for which one direction is held: 10 ms, 20 ms, 0.5 s
HELD_TICKS = 200  # of each, on the robot
DIRECTIONS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))

COMMANDED_OVER = Figure("commanded acceleration over its limit", "%")
MEASURED_OVER = Figure("measured acceleration over its limit", "%")


async def full_reversals(rig: Rig) -> Measured:
    """Send them to the gate by the million, and to a simulated robot."""
    body, count = rig.description, LONG_COMMANDS if rig.long else COMMANDS
    share = await asyncio.to_thread(_at_gate, body, count)
    commanded, measured = await _on_robot(await rig.robot("sim"))
    return {COMMANDED_OVER: round(max(share, commanded), 6), MEASURED_OVER: measured}


def let_through(body: BodyDescription, count: int) -> Iterator[tuple[Velocity, Velocity]]:
    """Yield the gate's outputs of a tick and of the next, for `count` hostile commands.

    The commands ask for full speed and full turning, each way or not at all, for up to a second
    each, at up to 1000 commands a second.
    """
    opened, chance = OpenGate(body), random.Random(0)
    seq = left = 0
    while seq < count:
        opened.tick()
        if left <= 0:
            left, wild = chance.choice((1, 5, 50)), chance.random() < 0.3
            linear, angular = _any_direction(body, chance)
        for _ in range(chance.choice((1, 2, 20))):
            if wild:
                linear, angular = _any_direction(body, chance)
            seq += 1
            opened.feed(gate.Command(opened.command(linear, seq, angular)))
        left -= 1
        yield opened.state.before, opened.state.output


def _any_direction(body: BodyDescription, chance: random.Random) -> tuple[float, float]:
    ways = (-1.0, 0.0, 1.0)
    linear, angular = body.max_linear_speed, body.max_angular_speed
    return linear * chance.choice(ways), angular * chance.choice(ways)


def _at_gate(body: BodyDescription, count: int) -> float:
    """Return by how much a driver's commands exceed the acceleration limits in any tick [%].

    A driver clamps the gate's output once more.
    """
    limits = limits_of(body)
    return max(
        over(body, clamp(before, limits), clamp(now, limits), 1)
        for before, now in let_through(body, count)
    )


def over(body: BodyDescription, before: Velocity, now: Velocity, ticks: int) -> float:
    """Return by how much a change within `ticks` exceeds the limits, straight or turning [%]."""
    straight = abs(now.linear_x - before.linear_x) / _limit(body)
    turning = abs(now.angular_z - before.angular_z) / body.max_angular_acceleration
    return 100.0 * max(0.0, max(straight, turning) / (ticks * TICK_S) - 1.0)


def _limit(body: BodyDescription) -> float:
    return max(body.max_linear_acceleration, body.max_linear_deceleration)


async def _on_robot(robot: RobotUnderTest) -> tuple[float, float]:
    """Return by how much a robot's commanded and measured accelerations exceed the limits [%]."""
    probe = robot.probe
    await robot.drive()
    body = probe.bodies.current
    assert body
    await robot.person.enable(probe.bus.process, take=True)
    start = probe.state
    async with forging(client_endpoint(robot.deployment)) as forger:
        for hold in HOLDS:
            await _shake(probe, forger, hold, body.description)
    states = probe.since(start)[1:]
    commanded = commanded_over(body.description, states)
    measured = _measured_over(probe, states, body.description)
    await probe.ticks(RESTED_TICKS)
    return commanded, measured


def commanded_over(body: BodyDescription, states: Sequence[RobotState]) -> float:
    """Return by how much commands exceed the limits while the gate is open [%].

    Raises Failed where the body was not really commanded to drive and to turn.
    """
    fastest = max(abs(state.sent.linear_x) for state in states)
    turning = max(abs(state.sent.angular_z) for state in states)
    if fastest < 0.5 * body.max_linear_speed or turning < 0.5 * body.max_angular_speed:
        raise Failed(f"commanded only {fastest:.2f} m/s and {turning:.2f} rad/s at most")
    return max(
        over(body, before.sent, now.sent, now.tick - before.tick)
        for before, now in pairwise(states)
        if now.tick > before.tick and before.gate.mode == now.gate.mode == "enabled"
    )


def _measured_over(probe: Probe, states: Sequence[RobotState], body: BodyDescription) -> float:
    """Return by how much the measured speed changes too fast, over windows of 240 ms [%]."""
    speeds = {state.tick: state.velocity.linear_x for state in states}
    step = _limit(body) * TICK_S
    shares = [
        abs(speeds[tick + WINDOW_TICKS] - speed) / (step * allowed)
        for tick, speed in speeds.items()
        if (allowed := steps_in_window(probe, tick)) and tick + WINDOW_TICKS in speeds
    ]
    if len(shares) < MIN_WINDOWS:
        raise Failed(f"the gate was open in {len(shares)} windows only")
    return 100.0 * max(0.0, max(shares) - 1.0)


def steps_in_window(probe: Probe, tick: int) -> int:
    """Return how many steps of the ramp may fall into the window that begins at this tick.

    0 where the gate was shut in it, since a stop makes up for all missed steps; and where the body
    was sped up and slowed down in turns just before: it lags behind that, and catches up.
    """
    first, last = tick - SETTLE_TICKS, tick + WINDOW_TICKS
    states = [s for s in probe.states if first <= s.tick <= last]
    if any(s.gate.mode != "enabled" for s in states) or not _one_way(states, tick):
        return 0
    return WINDOW_TICKS + (not _in_time(states, last - first + 1))


def _one_way(states: list[RobotState], until: int) -> bool:
    """Return whether the commanded speed only rose, or only fell, until a tick."""
    commanded = [s.sent.linear_x for s in states if s.tick <= until]
    changes = [after - before for before, after in pairwise(commanded)]
    return min(changes, default=0.0) >= 0.0 or max(changes, default=0.0) <= 0.0


def _in_time(states: list[RobotState], count: int) -> bool:
    """Return whether all `count` states are there, and the driver made each at its time.

    Where one was delayed, a step that was due just before falls into the window as well.
    """
    steps = [b.stamp_ns - a.stamp_ns for a, b in pairwise(states)]
    return len(states) == count and all(0 < 2 * step < 3 * TICK_NS for step in steps)


async def _shake(probe: Probe, forger: Forger, hold: int, body: BodyDescription) -> None:
    """Command full speed one way and the other, two commands a tick, and turning in between."""
    start = probe.state.tick
    while probe.state.tick - start < HELD_TICKS:
        for half in range(2):
            seq = 2 * probe.bus.time.tick + half
            linear, angular = DIRECTIONS[seq // hold % len(DIRECTIONS)]
            turning = angular * body.max_angular_speed
            command = forged_command(probe, linear * body.max_linear_speed, seq, angular_z=turning)
            forger.send(CMD_VEL, command)
        await probe.ticks(1)


ROWS = (
    FaultRow(27, full_reversals, "sim", (COMMANDED_OVER.at_most(0.1), MEASURED_OVER.at_most(1))),
)
