"""Faults of battery and motors: what safety makes of them, and what the robot does."""

import asyncio
import itertools
from collections.abc import Iterator
from typing import NamedTuple

from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Battery, BodyDescription, Joint, RobotState
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.qa.faults.bodies import description_of
from gigabrain_zenoh.qa.faults.fault import Measured
from gigabrain_zenoh.qa.faults.hostile import as_map, codec_of
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.tampered import go_on, tampered
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.safety.step import Inputs, Memory, step

NEAR = 0.01  # of a threshold, on either side
FULL, COOL, VOLTS = 80.0, 40.0, 12.0  # [%], [deg C], [V]
LONG_TICKS = 250  # 5 s, more than any threshold must be held
SAG_TICKS, SPIKE_TICKS, EVERY_TICKS = 5, 9, 50  # 100 ms, 180 ms; once a second
MISSING_TICKS = 100  # 2 s, then it counts as missing
SLACK_TICKS = 30  # the median of half a second, and a tick or two

Moment = tuple[Battery | None, float | None]  # and the motor's temperature [deg C]


class Case(NamedTuple):
    """What a body says, tick by tick, and what safety has to say at its end."""

    name: str
    moments: list[Moment]
    expected: set[str]  # codes of causes and warnings


def _battery(percentage: float, voltage: float = VOLTS) -> Battery:
    return Battery(voltage=voltage, percentage=percentage)


def _steady(
    percentage: float = FULL, temperature: float = COOL, ticks: int = LONG_TICKS
) -> list[Moment]:
    return [(_battery(percentage), temperature)] * ticks


def _now_and_then(bad: Moment, ticks: int) -> list[Moment]:
    """For so long in each second, for five."""
    good = _steady(ticks=EVERY_TICKS - ticks)
    return [*good, *([bad] * ticks)] * 5 + _steady(ticks=1)


def cases(body: BodyDescription) -> Iterator[Case]:
    """Ramps, sags, spikes, nonsense and nothing at all, to one per cent of each threshold."""
    limits = body.thresholds
    levels = {
        "battery_low": limits.battery_warn,
        "battery_return": limits.battery_return,
        "battery_empty": limits.battery_stop,
    }
    above: set[str] = set()
    for code, level in levels.items():
        yield Case(f"just above {code}", _steady(level * (1 + NEAR)), above)
        above = {code} if code != "battery_empty" else {"battery_return", code}
        yield Case(f"just below {code}", _steady(level * (1 - NEAR)), above)
    warm = {"motor_warm"}
    for code, level, below in (
        ("motor_warm", limits.motor_warn, set[str]()),
        ("motor_hot", limits.motor_stop, warm),
    ):
        yield Case(f"just below {code}", _steady(temperature=level * (1 - NEAR)), below)
        yield Case(f"just above {code}", _steady(temperature=level * (1 + NEAR)), warm | {code})
    yield Case("sags of 100 ms", _now_and_then((_battery(0.0), COOL), SAG_TICKS), set())
    yield Case("peaks of 0.18 s", _now_and_then((_battery(FULL), 120.0), SPIKE_TICKS), set())
    yield Case("40 degrees at once", _steady() + _steady(temperature=85.0), warm | {"motor_hot"})
    none: list[Moment] = [(None, COOL)]
    flat: list[Moment] = [(_battery(FULL, 0.0), COOL)]
    deaf: list[Moment] = [(_battery(FULL), None)]
    for name, gone, code in (
        ("no battery", none, "battery_unknown"),
        ("0 V", flat, "battery_unknown"),
        ("no temperature", deaf, "motor_unknown"),
    ):
        yield Case(f"{name}, not for long", _steady() + gone * (MISSING_TICKS - 5), set())
        yield Case(f"{name} for 2 s", _steady() + gone * (MISSING_TICKS + 5), {code})


def said(body: BodyDescription, moments: list[Moment]) -> set[str]:
    """The codes of safety's causes and warnings at the end."""
    memory = Memory()
    example = EXAMPLES[RobotState.__name__]
    assert isinstance(example, RobotState)
    for tick, (battery, temperature) in enumerate(moments, 1):
        wheel = Joint(name="wheel", position=0.0, temperature=temperature)
        state = replace(
            example, velocity=Velocity(), battery=battery, joints=(wheel,), imu=None, bumpers=(),
            boot=1, tick=tick, basis=tick,
        )  # fmt: skip
        memory, verdict = step(body, memory, Inputs(state=state))
    return {cause.code for cause in (*verdict.causes, *verdict.warnings)}


def wrong_ramp(body: BodyDescription) -> int:
    """Of a battery that loses 1 % a second: what was told too early, too late, or not at all."""
    limits, wrong = body.thresholds, 0
    late = limits.battery_sustain + SLACK_TICKS * 0.02
    for code, level in (
        ("battery_low", limits.battery_warn),
        ("battery_return", limits.battery_return),
        ("battery_empty", limits.battery_stop),
    ):
        for percentage, expected in ((level, False), (level - late, True)):
            ticks = round((FULL / 4 - percentage) * 50)
            fall = [(_battery(FULL / 4 - tick / 50), COOL) for tick in range(ticks)]
            wrong += (code in said(body, list(fall))) != expected
    return wrong


def _accepted(field: str, value: float) -> int:
    """Whether a state with such a battery decodes."""
    plain = as_map(RobotState)
    plain["battery"] = {**plain["battery"], field: value}
    try:
        codec_of(RobotState).decode(encode(plain))
    except ValueError:
        return 0
    return 1


async def battery_and_temperature(rig: Rig) -> Measured:
    """Every case in safety's own step, and the worst of them in a robot that drives."""
    body = replace(description_of(rig), lidar=None)
    wrong = await asyncio.to_thread(wrong_ramp, body)
    for case in cases(body):
        wrong += await asyncio.to_thread(said, body, case.moments) != case.expected
    bad = itertools.product(("percentage", "voltage"), (-1.0, float("nan"), float("inf")))
    wrong += sum(_accepted(field, value) for field, value in bad)
    return {"wrong actions": wrong + await _unnoticed(rig)}


async def _unnoticed(rig: Rig) -> int:
    """How many of a flat battery and a hot motor have not latched the driving robot."""
    wrong = 0
    async with tampered(rig, "empty-battery", "hot") as subject:
        onlooker = subject.onlooker
        for code in ("battery_empty", "motor_hot"):
            await subject.drive(0.8)
            go_on(subject)
            await until(lambda: onlooker.state.gate.mode == "latched", f"latched for {code}")
            wrong += code not in {cause.code for cause in onlooker.state.gate.causes}
            await onlooker.still()
            go_on(subject)
    return wrong
