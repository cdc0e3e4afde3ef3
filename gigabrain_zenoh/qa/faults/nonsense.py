"""Faults of values: numbers that are none, or that no body could follow."""

import asyncio
import itertools
import math
from typing import Any

import msgspec

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import CMD_VEL, TOPICS
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.faults.bodies import description_of
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.forger import Forger, forging
from gigabrain_zenoh.qa.faults.hostile import codec_of, hostile_payloads
from gigabrain_zenoh.qa.faults.hostile import hostile_values as damaged
from gigabrain_zenoh.qa.faults.open_gate import COMMANDER, OpenGate
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.smooth import stops
from gigabrain_zenoh.qa.faults.stopping import TICK_MS
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
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
AXES = ("linear_x", "linear_y", "angular_z")
COMMAND = codec_of(CmdVel)
Axes = tuple[float, float, float]


async def hostile_values(rig: Rig) -> Measured:
    """In every field of what drives a robot: at the gate, in safety and perception, on the keys."""
    body, wrong = description_of(rig), 0
    wrong += await asyncio.to_thread(at_gate, body, LONG_COMMANDS if rig.long else COMMANDS)
    await asyncio.to_thread(sensed, body, LONG_SENSED if rig.long else SENSED)
    wrong += await _flooded(rig, LONG_FLOOD_TICKS if rig.long else FLOOD_TICKS)
    subject = await rig.robot("sim")
    pids = await subject.onlooker.pids()
    await _pour(subject, FLOOD_TICKS)
    zero_ms = [await _nan_of_commander(subject, speed) for speed in SPEEDS]
    after = await subject.onlooker.pids()
    return {
        "wheel effects": wrong,
        "deaths": sum(pids[name] != after[name] for name in pids),
        "zero after NaN": max(zero_ms),
    }


def at_gate(body: BodyDescription, count: int) -> int:
    """How often what the gate lets through was no number, too fast, or too sudden.

    All come from the commander, each for so long that the body could follow; what decodes is
    obeyed.
    """
    opened, wrong = OpenGate(body), 0
    for number, value in enumerate(itertools.islice(damaged(CmdVel), count // HELD_TICKS)):
        for repeat in range(HELD_TICKS):
            if opened.state.mode != "enabled":
                opened.open()
            opened.feed(_event(opened, value, number * HELD_TICKS + repeat))
            wrong += not _possible(body, opened.state.before, opened.state.output)
            opened.tick()
    return wrong


def _event(opened: OpenGate, value: dict[str, Any], seq: int) -> gate.Event:
    """What the driver makes of a command with these speeds and the header of a good one."""
    speeds = {name: value[name] for name in AXES if name in value}
    header = {"source": COMMANDER, "boot": opened.state.boot, "tick": opened.state.tick, "seq": seq}
    payload = msgspec.msgpack.encode({"linear_x": 0.0, **speeds, **header})
    try:
        return gate.Command(COMMAND.decode(payload))
    except ValueError:
        bad = any(isinstance(v, float) and not math.isfinite(v) for v in speeds.values())
        # what is neither a command nor a number that is none is dropped: nobody has said anything
        return gate.NotFinite(COMMANDER if bad else "", opened.state.boot)


def _possible(body: BodyDescription, before: Velocity, now: Velocity) -> bool:
    """Whether this is a speed of the body, and one that it may have a tick later, or rest."""
    limits = limits_of(body)
    most = (limits.linear_speed, limits.lateral_speed, limits.angular_speed)
    linear = max(limits.linear_acceleration, limits.linear_deceleration)
    steps = (linear, linear, limits.angular_acceleration)
    axes = zip(_axes(before), _axes(now), most, steps, strict=True)
    rest = not any(_axes(now))
    return all(
        abs(new) <= limit + ROUNDING and (rest or abs(new - old) <= by * 0.02 + ROUNDING)
        for old, new, limit, by in axes
    )


def _axes(of: Velocity) -> Axes:
    return of.linear_x, of.linear_y, of.angular_z


def sensed(body: BodyDescription, count: int) -> None:
    """Hostile scans and states, through all that reads them. Raises Failed for what breaks it."""
    config, memory = PerceptionConfig(), Memory()
    scans, states = codec_of(LaserScan), codec_of(RobotState)
    state: RobotState | None = None
    scan: LaserScan | None = None
    for plain_scan, plain_state in itertools.islice(
        zip(damaged(LaserScan), damaged(RobotState), strict=True), count
    ):
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
    """Stops of a driving robot, and speeds beyond its limits, while nonsense comes on each key.

    In lock-step, where time waits for the brain, however slow this machine is.
    """
    await rig.give_up()
    deployment = msgspec.structs.replace(
        deployment_of(rig.options, "sim"), speed=LOCKSTEP, lockstep_timeout_s=LOCKSTEP_TIMEOUT_S
    )
    async with rig.new(deployment) as subject:
        await subject.settle()
        onlooker = subject.onlooker
        await subject.drive()
        body = onlooker.bodies.current
        assert body
        start, most = onlooker.state, 1.2 * body.description.max_linear_speed
        await _pour(subject, ticks)
        states = [s for s in onlooker.states if s.boot == start.boot and s.tick > start.tick]
        await subject.check()
    fast = sum(not abs(s.velocity.linear_x) <= most for s in states)
    return fast + len(stops(onlooker, start))


async def _pour(subject: Subject, ticks: int) -> None:
    """Nonsense on each key, for so long."""
    onlooker, start = subject.onlooker, subject.onlooker.state
    endless = [(topic, hostile_payloads(topic.type, n)) for n, topic in enumerate(TOPICS)]
    async with forging(client_endpoint(subject.deployment)) as forger:
        while onlooker.state.tick - start.tick < ticks:
            for topic, payloads in endless:
                for payload in itertools.islice(payloads, PER_TICK):
                    forger.send_bytes(topic, payload)
            await onlooker.ticks(1)


async def _nan_of_commander(subject: Subject, speed: float) -> float:
    """Until the gate is at zero after a command of the brain that is no number [ms]."""
    onlooker = subject.onlooker
    await subject.drive()
    async with forging(client_endpoint(subject.deployment)) as forger:
        await onlooker.ticks(1)
        begin, said = onlooker.state.tick, len(subject.records)
        _send(forger, subject, speed)
        await until(lambda: onlooker.state.gate.mode != "enabled", "the gate shuts", 5.0)
    stopped = [r for r in subject.records[said:] if r.get("mode") == "stopping"]
    causes = {cause.code for s in onlooker.states if s.tick > begin for cause in s.gate.causes}
    if not stopped or "nan" not in causes:
        raise Failed(f"the gate has stopped for {causes}")
    await onlooker.still()
    return (int(stopped[0]["tick"]) - begin) * TICK_MS


def _send(forger: Forger, subject: Subject, speed: float) -> None:
    time = subject.onlooker.bus.time
    command = {
        "linear_x": speed, "angular_z": 0.0, "source": BRAIN,
        "boot": time.boot, "tick": time.tick, "basis": time.tick, "seq": 1_000_000,
    }  # fmt: skip
    forger.send_bytes(CMD_VEL, msgspec.msgpack.encode(command))
