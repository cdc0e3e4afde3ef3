"""Hostile values: numbers that are not finite, or that no body could follow."""

import asyncio
import itertools
import math
import random
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import msgspec

from gigabrain_schemas.base import TICK_MS, TICK_NS, TICK_S, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import CMD_VEL, TOPICS
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.limits import clamp, limits_of
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.faults import hostile
from gigabrain_zenoh.qa.faults.hostile import COMMANDER, OpenGate, codec_of, hostile_payloads
from gigabrain_zenoh.qa.faults.rig import (
    DEATHS,
    RESTED_TICKS,
    Forger,
    Rig,
    deployment_of,
    forged_command,
    forging,
)
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, fault_row
from gigabrain_zenoh.qa.probe import Probe, until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step

COMMANDS, LONG_COMMANDS = 20_000, 1_000_000
HELD_TICKS = 15  # for which one value is repeated: a body gains its full speed within them
SENSED, LONG_SENSED = 1000, 100_000  # scans, and states with battery and temperatures
PER_TICK = 3  # of each key, on a running robot
FLOOD_TICKS, LONG_FLOOD_TICKS = 100, 3000
SPEEDS = (math.nan, math.inf, -math.inf)
LOCKSTEP = 2.0  # of real time
LOCKSTEP_TIMEOUT_S = 30.0
ROUNDING = 1e-9
AXES = ("linear_x", "linear_y", "angular_z")
COMMAND = codec_of(CmdVel)

WHEEL_EFFECTS = Figure("wheel effects")
ZERO_AFTER_NAN = Figure("zero after NaN", "ms")


COMMANDS, LONG_COMMANDS = 20_000, 1_000_000
WINDOW_TICKS = 12  # 240 ms
SETTLE_TICKS = 5  # before a window, so that commands still on their way count as well
MIN_WINDOWS = 50
HOLDS = (1, 2, 50)  # half-ticks for which one direction is held: 10 ms, 20 ms, 0.5 s
SHAKEN_TICKS = 200  # of each, on the robot
DIRECTIONS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))
COMMANDED_OVER = Figure("commanded acceleration over its limit", "%")
MEASURED_OVER = Figure("measured acceleration over its limit", "%")


@fault_row(26, "sim", WHEEL_EFFECTS.at_most(0), DEATHS.at_most(0), ZERO_AFTER_NAN.at_most(20))
async def hostile_values(rig: Rig) -> Measured:
    """Send them to gate, safety and perception, and to a robot on all keys."""
    body, wrong = rig.description, 0
    wrong += await asyncio.to_thread(at_gate, body, LONG_COMMANDS if rig.long else COMMANDS)
    await asyncio.to_thread(sensed, body, LONG_SENSED if rig.long else SENSED)
    wrong += await _flooded(rig, LONG_FLOOD_TICKS if rig.long else FLOOD_TICKS)
    robot = await rig.robot("sim")
    pids = await robot.probe.pids()
    await _flood(robot, FLOOD_TICKS)
    zero_ms = [await _nan_of_commander(robot, speed) for speed in SPEEDS]
    after = await robot.probe.pids()
    return {
        WHEEL_EFFECTS: wrong,
        DEATHS: sum(pids[name] != after[name] for name in pids),
        ZERO_AFTER_NAN: max(zero_ms),
    }


def at_gate(body: BodyDescription, count: int) -> int:
    """Count the gate's outputs that are not finite, too fast or too sudden.

    All values come from the commander, each for so long that the body could follow; what decodes is
    obeyed.
    """
    opened, wrong = OpenGate(body), 0
    values = itertools.islice(hostile.hostile_values(CmdVel), count // HELD_TICKS)
    for number, value in enumerate(values):
        for repeat in range(HELD_TICKS):
            if opened.state.mode != "enabled":
                opened.open()
            opened.feed(_event(opened, value, number * HELD_TICKS + repeat))
            wrong += not _possible(body, opened.state.before, opened.state.output)
            opened.tick()
    return wrong


def _event(opened: OpenGate, value: dict[str, Any], seq: int) -> gate.Event:
    """Return what the driver makes of a command with these speeds and a good header."""
    speeds = {name: value[name] for name in AXES if name in value}
    header = {"source": COMMANDER, "boot": opened.state.boot, "tick": opened.state.tick, "seq": seq}
    payload = msgspec.msgpack.encode({"linear_x": 0.0, **speeds, **header})
    try:
        return gate.VelocityCommand(COMMAND.decode(payload))
    except ValueError:
        bad = any(isinstance(v, float) and not math.isfinite(v) for v in speeds.values())
        # what is neither a command nor a non-finite number is dropped without a source
        return gate.NotFinite(COMMANDER if bad else "", opened.state.boot)


def _possible(body: BodyDescription, before: Velocity, now: Velocity) -> bool:
    """Return whether the body may have this speed a tick after `before`; rest always is."""
    limits = limits_of(body)
    fastest = (limits.linear_speed, limits.lateral_speed, limits.angular_speed)
    linear = max(limits.linear_acceleration, limits.linear_deceleration)
    steps = (linear, linear, limits.angular_acceleration)
    axes = zip(_axes(before), _axes(now), fastest, steps, strict=True)
    rest = not any(_axes(now))
    return all(
        abs(new) <= limit + ROUNDING and (rest or abs(new - old) <= by * TICK_S + ROUNDING)
        for old, new, limit, by in axes
    )


def _axes(of: Velocity) -> tuple[float, float, float]:
    return of.linear_x, of.linear_y, of.angular_z


def sensed(body: BodyDescription, count: int) -> None:
    """Feed hostile scans and states to their readers. Raises Failed for what breaks one."""
    config, memory = PerceptionConfig(), SafetyMemory()
    scans, states = codec_of(LaserScan), codec_of(RobotState)
    state: RobotState | None = None
    scan: LaserScan | None = None
    damaged = hostile.hostile_values(LaserScan), hostile.hostile_values(RobotState)
    for plain_scan, plain_state in itertools.islice(zip(*damaged, strict=True), count):
        try:
            state = states.decode(msgspec.msgpack.encode(plain_state))
            scan = scans.decode(msgspec.msgpack.encode(plain_scan))
        except ValueError:
            pass
        if state is None or scan is None:
            continue
        try:
            perception.step(config, body, scan)
            inputs = SafetyInputs(state=state, scan=scan, scan_age_ns=0)
            memory, verdict = step(body, memory, inputs)
            codec_of(type(verdict)).decode(msgspec.msgpack.encode(verdict))
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            raise Failed(f"{error!r} of {plain_scan} and {plain_state}") from error


async def _flooded(rig: Rig, ticks: int) -> int:
    """Count stops and excessive speeds of a driving robot while hostile bytes come on each key.

    In lockstep, where time waits for the brain, however slow the machine is.
    """
    deployment = msgspec.structs.replace(
        deployment_of(rig.options, "sim"), speed=LOCKSTEP, lockstep_timeout_s=LOCKSTEP_TIMEOUT_S
    )
    async with rig.own_robot(deployment) as robot:
        probe = robot.probe
        await robot.until_driving()
        body = probe.bodies.current
        assert body
        start, fastest = probe.state, 1.2 * body.description.max_linear_speed
        await _flood(robot, ticks)
        states = probe.since(start)[1:]
    fast = sum(not abs(s.velocity.linear_x) <= fastest for s in states)
    return fast + len(probe.stops(start))


async def _flood(robot: RobotUnderTest, ticks: int) -> None:
    """Send hostile bytes on each key for `ticks`."""
    probe, start = robot.probe, robot.probe.state
    endless = [(topic, hostile_payloads(topic.type, n)) for n, topic in enumerate(TOPICS)]
    async with forging(robot.endpoint) as forger:
        while probe.state.tick - start.tick < ticks:
            for topic, payloads in endless:
                for payload in itertools.islice(payloads, PER_TICK):
                    forger.send_bytes(topic, payload)
            await probe.ticks(1)


async def _nan_of_commander(robot: RobotUnderTest, speed: float) -> float:
    """Return the time until the gate is at zero after a non-finite command of the brain [ms]."""
    probe = robot.probe
    await robot.until_driving()
    async with forging(robot.endpoint) as forger:
        await probe.ticks(1)
        begin, records, time = probe.state.tick, len(robot.records), probe.bus.time
        command = {
            "linear_x": speed, "angular_z": 0.0, "source": BRAIN,
            "boot": time.boot, "tick": time.tick, "basis": time.tick, "seq": 1_000_000,
        }  # fmt: skip
        forger.send_bytes(CMD_VEL, msgspec.msgpack.encode(command))
        await until(lambda: probe.state.gate.mode != "enabled", "the gate shuts", 5.0)
    stopped = [r for r in robot.records[records:] if r.get("mode") == "stopping"]
    causes = {cause.code for s in probe.states if s.tick > begin for cause in s.gate.causes}
    if not stopped or "nan" not in causes:
        raise Failed(f"the gate has stopped for {causes}, not for nan")
    await probe.at_rest()
    return (int(stopped[0]["tick"]) - begin) * TICK_MS


@fault_row(27, "sim", COMMANDED_OVER.at_most(0.1), MEASURED_OVER.at_most(1))
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
            opened.feed(gate.VelocityCommand(opened.command(linear, seq, angular)))
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
    await robot.until_driving()
    body = probe.bodies.current
    assert body
    await robot.operator.enable(probe.bus.process, take=True)
    start = probe.state
    async with forging(robot.endpoint) as forger:
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
    while probe.state.tick - start < SHAKEN_TICKS:
        for half in range(2):
            seq = 2 * probe.bus.time.tick + half
            linear, angular = DIRECTIONS[seq // hold % len(DIRECTIONS)]
            turning = angular * body.max_angular_speed
            command = forged_command(probe, linear * body.max_linear_speed, seq, angular_z=turning)
            forger.send(CMD_VEL, command)
        await probe.ticks(1)
