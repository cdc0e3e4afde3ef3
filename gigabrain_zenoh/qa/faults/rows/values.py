"""Hostile values: numbers that are not finite, or that no body could follow."""

import asyncio
import itertools
import math
from typing import Any

import msgspec

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import CMD_VEL, TOPICS
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.faults.fault import FaultRow
from gigabrain_zenoh.qa.faults.rig import hostile
from gigabrain_zenoh.qa.faults.rig.bad_network import forging
from gigabrain_zenoh.qa.faults.rig.hostile import COMMANDER, OpenGate, codec_of, hostile_payloads
from gigabrain_zenoh.qa.faults.rig.rig import Rig, deployment_of
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured
from gigabrain_zenoh.qa.probe import TICK_MS, until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.runtime.deployment import client_endpoint
from gigabrain_zenoh.safety.step import Inputs, Memory, step

COMMANDS, LONG_COMMANDS = 20_000, 1_000_000
HELD_TICKS = 15  # for which one value is repeated: a body gains its full speed within them
SENSED, LONG_SENSED = 1000, 100_000  # scans, and states with battery and temperatures
PER_TICK = 3  # of each key, on a running robot
FLOOD_TICKS, LONG_FLOOD_TICKS = 100, 3000
SPEEDS = (math.nan, math.inf, -math.inf)
LOCKSTEP = 2.0  # of real time
LOCKSTEP_TIMEOUT_S = 30.0
ROUNDING = 1e-9
TICK_S = TICK_NS / 1e9
AXES = ("linear_x", "linear_y", "angular_z")
COMMAND = codec_of(CmdVel)

WHEEL_EFFECTS = Figure("wheel effects")
DEATHS = Figure("deaths")
ZERO_AFTER_NAN = Figure("zero after NaN", "ms")


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
        return gate.Command(COMMAND.decode(payload))
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
    config, memory = PerceptionConfig(), Memory()
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
            inputs = Inputs(state=state, scan=scan, scan_age_ns=0)
            memory, verdict = step(body, memory, inputs)
            codec_of(type(verdict)).decode(msgspec.msgpack.encode(verdict))
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            raise Failed(f"{error!r} of {plain_scan} and {plain_state}") from error


async def _flooded(rig: Rig, ticks: int) -> int:
    """Count stops and excessive speeds of a driving robot while hostile bytes come on each key.

    In lockstep, where time waits for the brain, however slow the machine is.
    """
    await rig.give_up()
    deployment = msgspec.structs.replace(
        deployment_of(rig.options, "sim"), speed=LOCKSTEP, lockstep_timeout_s=LOCKSTEP_TIMEOUT_S
    )
    async with rig.new(deployment) as robot:
        await robot.settle()
        probe = robot.probe
        await robot.drive()
        body = probe.bodies.current
        assert body
        start, fastest = probe.state, 1.2 * body.description.max_linear_speed
        await _flood(robot, ticks)
        states = probe.since(start)[1:]
        await robot.check()
    fast = sum(not abs(s.velocity.linear_x) <= fastest for s in states)
    return fast + len(probe.stops(start))


async def _flood(robot: RobotUnderTest, ticks: int) -> None:
    """Send hostile bytes on each key for `ticks`."""
    probe, start = robot.probe, robot.probe.state
    endless = [(topic, hostile_payloads(topic.type, n)) for n, topic in enumerate(TOPICS)]
    async with forging(client_endpoint(robot.deployment)) as forger:
        while probe.state.tick - start.tick < ticks:
            for topic, payloads in endless:
                for payload in itertools.islice(payloads, PER_TICK):
                    forger.send_bytes(topic, payload)
            await probe.ticks(1)


async def _nan_of_commander(robot: RobotUnderTest, speed: float) -> float:
    """Return the time until the gate is at zero after a non-finite command of the brain [ms]."""
    probe = robot.probe
    await robot.drive()
    async with forging(client_endpoint(robot.deployment)) as forger:
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


ROWS = (
    FaultRow(
        26, hostile_values, "sim",
        (WHEEL_EFFECTS.at_most(0), DEATHS.at_most(0), ZERO_AFTER_NAN.at_most(20)),
    ),
)  # fmt: skip
