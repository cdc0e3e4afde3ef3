"""Faults of lidar, battery and motors: readings that are impossible, missing or dangerous."""

import asyncio
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import Battery, BodyDescription, Joint, RobotState
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.geometry.scan import Floats
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.faults.fault import FaultRow
from gigabrain_zenoh.qa.faults.rig.hostile import as_map, codec_of
from gigabrain_zenoh.qa.faults.rig.rig import BRAKES, ZERO, Rig, Stop, next_step, stop_by, tampered
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured
from gigabrain_zenoh.qa.probe import until
from gigabrain_zenoh.safety.step import Inputs, Memory, step

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
    example, memory = EXAMPLES[RobotState.__name__], Memory()
    assert isinstance(example, RobotState)
    for tick in range(5, 25, 5):
        state = replace(example, boot=1, tick=tick, basis=tick)
        scan = replace(blind, boot=1, tick=tick, basis=tick)
        memory, verdict = step(body, memory, Inputs(state=state, scan=scan, scan_age_ns=TICK_NS))
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
    memory = Memory()
    example = EXAMPLES[RobotState.__name__]
    assert isinstance(example, RobotState)
    for tick, (battery, temperature) in enumerate(readings, 1):
        wheel = Joint(name="wheel", position=0.0, temperature=temperature)
        state = replace(
            example, velocity=Velocity(), battery=battery, joints=(wheel,), imu=None, bumpers=(),
            boot=1, tick=tick, basis=tick,
        )  # fmt: skip
        memory, verdict = step(body, memory, Inputs(state=state))
    return {cause.code for cause in (*verdict.causes, *verdict.warnings)}


def wrong_ramp(body: BodyDescription) -> int:
    """Drain a battery by 1 % a second; count codes that come too early, too late, or never."""
    wrong, late = 0, body.thresholds.battery_sustain + SLACK_TICKS * 0.02
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
            await robot.drive(0.8)
            next_step(robot)
            await until(lambda: probe.state.gate.mode == "latched", f"latched for {code}")
            wrong += code not in probe.causes
            await probe.at_rest()
            next_step(robot)
    return {WRONG_ACTIONS: wrong}


ROWS = (
    FaultRow(28, blind_lidar, "", (BRAKES.at_most(300), ZERO.at_most(660))),
    FaultRow(31, battery_and_temperature, "", (WRONG_ACTIONS.at_most(0),)),
)
