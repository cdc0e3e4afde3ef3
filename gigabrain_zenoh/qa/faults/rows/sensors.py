"""Faults of lidar, battery and motors: readings that are impossible, missing or dangerous."""

import asyncio
import itertools
import math
import random
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats, ranges_bytes
from gigabrain_schemas.base import TICK_NS, TICK_S, Velocity
from gigabrain_schemas.body import Battery, BodyDescription, Joint, RobotState
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.faults.hostile import as_map, codec_of
from gigabrain_zenoh.qa.faults.rig import BRAKES, ZERO, Rig, Stop, next_step, stop_by, tampered
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, fault_row
from gigabrain_zenoh.qa.probe import until
from gigabrain_zenoh.qa.simulated_drives import Ranges, SafetyTrack
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step

KINDS = ("nan", "half", "crooked")
LONG_KINDS = ("nan", "half", "crooked", "minus-inf", "zero", "most", "short")
NEAR = 0.01  # of a threshold, on either side
FULL, COOL, VOLTS = 80.0, 40.0, 12.0  # [%], [deg C], [V]
LONG_TICKS = 250  # 5 s, longer than any threshold must be exceeded
SAG_TICKS, SPIKE_TICKS, EVERY_TICKS = 5, 9, 50  # 100 ms, 180 ms; once a second
MISSING_TICKS = 100  # 2 s, then a reading counts as missing
SLACK_TICKS = 30  # the median of half a second, and a tick or two

WRONG_ACTIONS = Figure("wrong actions")
PowerReading = tuple[Battery | None, float | None]  # and the motor's temperature [deg C]


HALF_M = 5.0  # the walls are out of sight of most lidars
RADII_M = (0.035, 0.010)  # a leg of a person and one of a chair
FULL_SPEED, HALF_SPEED = 1.0, 0.5  # of the body's greatest speed
RUNS, LONG_RUNS = 6, 30  # of each direction and each speed
APPROACH_TICKS, TURN_TICKS = 200, 250
AHEAD_M = (0.35, 0.6)  # from the outline to a post
ASIDE_M = 0.01  # least room between a post and the outline of a body that will turn
SEEN_LATER_M = (0.0, 0.05)  # beyond the stop distance, where an obstacle appears
PHASES, LONG_PHASES = 5, 30  # of the lidar's turn in which it does
PILLAR_M = 0.15
GAP_M = 0.03
HOLD_TICKS = 100
CORRIDOR_M, NEAR_END_M = 40.0, 36.0
CORRIDOR_TICKS, LONG_CORRIDOR_TICKS = 1500, 30_000  # half a minute, ten
CONTACTS = Figure("contacts")
GAP_MISSING = Figure("missing to a gap of 3 cm", "m")
FALSE_STOPS = Figure("false stops", "%")
RESUMES = Figure("resumes after", "s")


@fault_row(28, "", BRAKES.at_most(300), ZERO.at_most(660))
async def blind_lidar(rig: Rig) -> Measured:
    """Feed blind scans to perception and safety; then to both while a robot drives."""
    body = rig.description
    for name, values in blindness(body).items():
        _check_noticed(body, name, values)
    kinds, stops = LONG_KINDS if rig.long else KINDS, list[Stop]()
    async with tampered(rig, *kinds) as robot:
        for _ in kinds:
            stops.append(await stop_by(robot, lambda: next_step(robot)))
            next_step(robot)
    return {
        BRAKES: max(stop.brakes_ms for stop in stops),
        ZERO: max(stop.zero_ms for stop in stops),
    }


def blindness(body: BodyDescription) -> dict[str, Floats]:
    """Return ranges (n,) [m] of scans that no working lidar can send."""
    assert body.lidar
    count = body.lidar.beams
    half = np.ones(count)
    half[: (count + 1) // 2] = np.nan
    return {
        "nan": np.full(count, np.nan),
        "inf": np.full(count, np.inf),
        "minus inf": np.full(count, -np.inf),
        "zero": np.zeros(count),
        "most": np.full(count, body.lidar.range_max),
        "half": half,
        "short": np.ones(count - 1),
        "long": np.ones(count + 1),
    }


def _check_noticed(body: BodyDescription, name: str, values: Floats) -> None:
    """Raise Failed where perception accepts such a scan, or safety does not stop for it.

    All-inf is blindness where the lidar cannot tell it from free space.
    """
    assert body.lidar
    if name == "inf":
        body = replace(body, lidar=replace(body.lidar, no_return="unknown"))
    blind = LaserScan(
        angle_min=0.0,
        angle_increment=math.tau / len(values),
        range_min=0.1,
        range_max=10.0,
        ranges=ranges_bytes(values),
    )
    if perception.step(PerceptionConfig(), body, blind).scan_ok:
        raise Failed(f"perception accepts a scan of all {name}")
    example, memory = EXAMPLES[RobotState.__name__], SafetyMemory()
    assert isinstance(example, RobotState)
    for tick in range(5, 25, 5):
        state = replace(example, boot=1, tick=tick, basis=tick)
        scan = replace(blind, boot=1, tick=tick, basis=tick)
        memory, verdict = step(
            body, memory, SafetyInputs(state=state, scan=scan, scan_age_ns=TICK_NS)
        )
    if "scan_blind" not in {cause.code for cause in verdict.causes}:
        raise Failed(f"safety accepts a scan of all {name}")


class PowerCase(NamedTuple):
    """Readings of battery and motor, tick by tick, and safety's expected codes at their end."""

    name: str
    readings: list[PowerReading]
    expected: set[str]  # codes of causes and warnings


def _battery(percentage: float, voltage: float = VOLTS) -> Battery:
    return Battery(voltage=voltage, percentage=percentage)


def _steady(
    percentage: float = FULL, temperature: float = COOL, ticks: int = LONG_TICKS
) -> list[PowerReading]:
    return [(_battery(percentage), temperature)] * ticks


def _once_a_second(bad: PowerReading, ticks: int) -> list[PowerReading]:
    """Return five seconds of good readings, with `ticks` bad ones in each."""
    good = _steady(ticks=EVERY_TICKS - ticks)
    return [*good, *([bad] * ticks)] * 5 + _steady(ticks=1)


def power_cases(body: BodyDescription) -> Iterator[PowerCase]:
    """Yield ramps, sags, spikes, impossible and missing readings, to 1 % of each threshold."""
    limits = body.thresholds
    above: set[str] = set()
    for code, level in _battery_levels(body):
        yield PowerCase(f"just above {code}", _steady(level * (1 + NEAR)), above)
        above = {code} if code != "battery_empty" else {"battery_return", code}
        yield PowerCase(f"just below {code}", _steady(level * (1 - NEAR)), above)
    warm = {"motor_warm"}
    for code, level, below in (
        ("motor_warm", limits.motor_warn, set[str]()),
        ("motor_hot", limits.motor_stop, warm),
    ):
        yield PowerCase(f"just below {code}", _steady(temperature=level * (1 - NEAR)), below)
        hotter = _steady(temperature=level * (1 + NEAR))
        yield PowerCase(f"just above {code}", hotter, warm | {code})
    sags = _once_a_second((_battery(0.0), COOL), SAG_TICKS)
    yield PowerCase("sags of 100 ms", sags, set())
    yield PowerCase("peaks of 0.18 s", _once_a_second((_battery(FULL), 120.0), SPIKE_TICKS), set())
    hot = _steady() + _steady(temperature=85.0)
    yield PowerCase("40 degrees at once", hot, warm | {"motor_hot"})
    missing: tuple[tuple[str, PowerReading, str], ...] = (
        ("no battery", (None, COOL), "battery_unknown"),
        ("0 V", (_battery(FULL, 0.0), COOL), "battery_unknown"),
        ("no temperature", (_battery(FULL), None), "motor_unknown"),
    )
    for name, gone, code in missing:
        yield PowerCase(f"{name}, briefly", _steady() + [gone] * (MISSING_TICKS - 5), set())
        yield PowerCase(f"{name} for 2 s", _steady() + [gone] * (MISSING_TICKS + 5), {code})


def _battery_levels(body: BodyDescription) -> tuple[tuple[str, float], ...]:
    limits = body.thresholds
    return (
        ("battery_low", limits.battery_warn),
        ("battery_return", limits.battery_return),
        ("battery_empty", limits.battery_stop),
    )


def codes_after(body: BodyDescription, readings: list[PowerReading]) -> set[str]:
    """Return the codes of safety's causes and warnings at the end."""
    memory = SafetyMemory()
    example = EXAMPLES[RobotState.__name__]
    assert isinstance(example, RobotState)
    for tick, (battery, temperature) in enumerate(readings, 1):
        wheel = Joint(name="wheel", position=0.0, temperature=temperature)
        state = replace(
            example, velocity=Velocity(), battery=battery, joints=(wheel,), imu=None, bumpers=(),
            boot=1, tick=tick, basis=tick,
        )  # fmt: skip
        memory, verdict = step(body, memory, SafetyInputs(state=state))
    return {cause.code for cause in (*verdict.causes, *verdict.warnings)}


def wrong_ramp(body: BodyDescription) -> int:
    """Drain a battery by 1 % a second; count codes that come too early, too late, or never."""
    wrong, late = 0, body.thresholds.battery_sustain + SLACK_TICKS * TICK_S
    for code, level in _battery_levels(body):
        for percentage, expected in ((level, False), (level - late, True)):
            ticks = round((FULL / 4 - percentage) * 50)
            drained: list[PowerReading] = [
                (_battery(FULL / 4 - tick / 50), COOL) for tick in range(ticks)
            ]
            wrong += (code in codes_after(body, drained)) != expected
    return wrong


def _accepted(field: str, value: float) -> int:
    """Return 1 where a state with such a battery decodes."""
    plain = as_map(RobotState)
    plain["battery"] = {**plain["battery"], field: value}
    try:
        codec_of(RobotState).decode(encode(plain))
    except ValueError:
        return 0
    return 1


@fault_row(31, "", WRONG_ACTIONS.at_most(0))
async def battery_and_temperature(rig: Rig) -> Measured:
    """Run every case through safety's own step, and the worst of them on a driving robot."""
    body = replace(rig.description, lidar=None)
    wrong = await asyncio.to_thread(wrong_ramp, body)
    for case in power_cases(body):
        wrong += await asyncio.to_thread(codes_after, body, case.readings) != case.expected
    bad = itertools.product(("percentage", "voltage"), (-1.0, float("nan"), float("inf")))
    wrong += sum(_accepted(field, value) for field, value in bad)
    async with tampered(rig, "empty-battery", "hot") as robot:
        probe = robot.probe
        for code in ("battery_empty", "motor_hot"):
            await robot.until_driving(0.8)
            next_step(robot)
            await until(lambda: probe.state.gate.mode == "latched", f"latched for {code}")
            wrong += code not in probe.causes
            await probe.at_rest()
            next_step(robot)
    return {WRONG_ACTIONS: wrong}


class PostApproach(NamedTuple):
    """A post, and the command that brings the body to it."""

    post: tuple[float, float, float]  # x, y and radius [m]
    linear_x: float  # [m/s]
    angular_z: float  # [rad/s]
    ticks: int


Draw = Callable[[BodyDescription, float, float, random.Random], PostApproach]


@fault_row(29, "", CONTACTS.at_most(0))
async def thin_obstacles(rig: Rig) -> Measured:
    """Drive at posts of 70 and 20 mm, seen well or badly, at half and full speed, every way."""
    contacts, chance = 0, random.Random(0)
    for share, number, draw in itertools.product(
        (HALF_SPEED, FULL_SPEED),
        range(LONG_RUNS if rig.long else RUNS),
        (_forward, _backward, _turning),
    ):
        contacts += await asyncio.to_thread(_contacts, rig.body, draw, share, number, chance)
    return {CONTACTS: contacts}


def _contacts(body: str, draw: Draw, share: float, number: int, chance: random.Random) -> int:
    """Count the contacts of one run; every other post returns one beam in two."""
    empty = SafetyTrack(body, HALF_M, HALF_M)
    approach = draw(empty.body, share, RADII_M[number // 2 % len(RADII_M)], chance)
    track = SafetyTrack(body, HALF_M, HALF_M, (approach.post,), number)
    if number % 2:
        track.sees = half_lost(np.random.default_rng(number))
    track.run(approach.ticks, approach.linear_x, approach.angular_z)
    return int(track.simulation.truth.contacts)


def half_lost(chance: np.random.Generator) -> Callable[[Ranges], Ranges]:
    """Return a lidar that loses half of its hits, as of dark obstacles."""

    def see(ranges: Ranges) -> Ranges:
        lost = chance.random(len(ranges)) < 0.5
        return np.where(lost, np.float32(np.inf), ranges)

    return see


def _forward(
    body: BodyDescription, share: float, radius: float, chance: random.Random
) -> PostApproach:
    front, half = max(x for x, _ in body.footprint), max(y for _, y in body.footprint)
    x = front + radius + chance.uniform(*AHEAD_M)
    post = (x, chance.uniform(-half, half), radius)
    return PostApproach(post, share * body.max_linear_speed, 0.0, round(APPROACH_TICKS / share))


def _backward(
    body: BodyDescription, share: float, radius: float, chance: random.Random
) -> PostApproach:
    rear = -min(x for x, _ in body.footprint)
    half = max(y for _, y in body.footprint)
    post = (-rear - radius - chance.uniform(*AHEAD_M), chance.uniform(-half, half), radius)
    return PostApproach(post, -share * body.max_linear_speed, 0.0, round(APPROACH_TICKS / share))


def _turning(
    body: BodyDescription, share: float, radius: float, chance: random.Random
) -> PostApproach:
    """Put the post aside the body, where only its corners can reach."""
    half = max(y for _, y in body.footprint)
    reach = max(math.hypot(x, y) for x, y in body.footprint)
    side = chance.choice((-1, 1))
    least = half + radius + ASIDE_M
    post = (0.0, side * chance.uniform(least, max(least, reach)), radius)
    turn = chance.choice((-1, 1)) * share * body.max_angular_speed
    return PostApproach(post, 0.0, turn, TURN_TICKS)


@fault_row(
    30, "", CONTACTS.at_most(0), GAP_MISSING.at_most(0), FALSE_STOPS.at_most(1),
    RESUMES.at_most(0.3),
)  # fmt: skip
async def obstacle_at_stopping_distance(rig: Rig) -> Measured:
    """Have a pillar appear where the body must begin to stop, and vanish again."""
    contacts, missing_m, resumed_s = 0, 0.0, 0.0
    phases = LONG_PHASES if rig.long else PHASES
    for later_m in SEEN_LATER_M:
        for phase in range(phases):
            track = await asyncio.to_thread(_surprised, rig.body, later_m, phase / phases)
            truth = track.simulation.truth
            contacts += truth.contacts
            missing_m = max(missing_m, GAP_M - truth.min_clearance_m)
            resumed_s = max(resumed_s, _resumes_after_s(track))
    return {
        CONTACTS: contacts,
        GAP_MISSING: missing_m,
        FALSE_STOPS: await asyncio.to_thread(_false_stops, rig),
        RESUMES: resumed_s,
    }


def _surprised(body: str, later_m: float, phase: float) -> SafetyTrack:
    """Stop a body before a pillar that appears at the stop distance plus `later_m`."""
    begin = 1.5 + phase * 0.1 * SafetyTrack(body, HALF_M, HALF_M).body.max_linear_speed
    track = SafetyTrack(body, HALF_M, HALF_M, ((begin + PILLAR_M, 0.0, PILLAR_M),))
    front = max(x for x, _ in track.body.footprint)
    speed = track.body.max_linear_speed
    seen_m = brakes(track.body)["forward"].distance(speed) + later_m
    track.sees = nothing
    while begin - track.simulation.truth.pose().x - front > seen_m:
        track.run(1, speed)
    track.sees = np.copy
    track.run(HOLD_TICKS, speed)
    for _ in range(HOLD_TICKS):
        track.run(1, speed)
        if track.output.linear_x:
            raise Failed("it did not hold in front of an obstacle")
    return track


def nothing(ranges: Ranges) -> Ranges:
    """Return the ranges of a lidar that sees nothing."""
    return np.full_like(ranges, np.inf)


def _resumes_after_s(track: SafetyTrack) -> float:
    """Return the time from the obstacle's vanishing until the body may drive on [s]."""
    track.sees = nothing
    for tick in range(HOLD_TICKS):
        track.run(1, track.body.max_linear_speed)
        if track.output.linear_x > 0:
            return tick * TICK_S
    raise Failed("it did not drive on when the obstacle was gone")


def _false_stops(rig: Rig) -> float:
    """Return the share of ticks in an empty corridor in which the body was held back [%]."""
    lab = SafetyTrack(rig.body, HALF_M, HALF_M)
    track = SafetyTrack(rig.body, CORRIDOR_M, 2 * lab.radius)
    ticks, held, way = LONG_CORRIDOR_TICKS if rig.long else CORRIDOR_TICKS, 0, 1.0
    for _ in range(ticks):
        x = track.simulation.truth.pose().x
        if abs(x) > NEAR_END_M:
            way = -math.copysign(1.0, x)
        track.run(1, way * track.body.max_linear_speed)
        held += bool(track.verdict.causes) or track.gate.mode != "enabled"
    if track.simulation.truth.distance_m < 0.8 * ticks * TICK_S * track.body.max_linear_speed:
        raise Failed("it did not get along in an empty corridor")
    return 100.0 * held / ticks
