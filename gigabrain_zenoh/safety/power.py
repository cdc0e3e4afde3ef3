"""The battery and the motors: low, hot, or no longer measured."""

import statistics

import msgspec

from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import Battery, RobotState, Thresholds
from gigabrain_zenoh.safety.sustain import held, ticks_of
from gigabrain_zenoh.safety.words import say

SHOWN = 3  # states in a row that measure something, before it counts as measured by this body
SAG_SAMPLES = 25  # the median of so many (0.5 s) knows nothing of a sag of 0.2 s, down or up
CLEAR_PERCENT, CLEAR_DEG_C = 2.0, 2.0  # better than the threshold by this before it is over
COLDEST, HOTTEST = -40.0, 150.0  # [deg C]; what a motor's sensor says beyond that is a fault


class Measured(msgspec.Struct, frozen=True):
    """What one state has measured."""

    charge: bool
    volts: bool
    motors: frozenset[str]  # whose temperature


class Power(msgspec.Struct, frozen=True, kw_only=True):
    """What is remembered of battery and motors."""

    charges: tuple[float, ...] = ()  # newest percentages [%]
    low_ticks: tuple[int, int, int] = (0, 0, 0)  # below battery_warn, _return and _stop
    warm_ticks: int = 0
    hot_ticks: int = 0
    measured: tuple[Measured, ...] = ()  # of the newest states
    charged: bool = False  # the body has shown that it measures its battery
    volts: bool = False  # and its voltage
    motors: frozenset[str] = frozenset()  # whose temperature the body has shown
    charge_missing_ticks: int = 0
    motor_missing_ticks: int = 0

    @property
    def charge(self) -> float:
        """The battery's charge without its sags [%]."""
        return statistics.median(self.charges)


def look(limits: Thresholds, power: Power, state: RobotState, elapsed: int) -> Power:
    """One state more."""
    battery = state.battery if _believable(state.battery, power.volts) else None
    charges = (*power.charges, battery.percentage) if battery and elapsed else power.charges
    temperatures = _temperatures(state)
    power = msgspec.structs.replace(power, charges=charges[-SAG_SAMPLES:])
    if elapsed or not power.measured:
        volts = battery is not None and battery.voltage > 0
        power = _shown(power, Measured(battery is not None, volts, frozenset(temperatures)))
    lost = bool(power.motors - temperatures.keys())
    hottest = max(temperatures.values(), default=COLDEST)
    return msgspec.structs.replace(
        power,
        low_ticks=_low(limits, power, elapsed),
        warm_ticks=_over(limits, power.warm_ticks, hottest, limits.motor_warn, elapsed),
        hot_ticks=_over(limits, power.hot_ticks, hottest, limits.motor_stop, elapsed),
        charge_missing_ticks=held(
            power.charge_missing_ticks, power.charged and battery is None, elapsed
        ),
        motor_missing_ticks=held(power.motor_missing_ticks, lost, elapsed),
    )


def _shown(power: Power, now: Measured) -> Power:
    """What a body measures it has to show SHOWN times in a row: one message is no proof."""
    newest = (*power.measured, now)[-SHOWN:]
    power = msgspec.structs.replace(power, measured=newest)
    if len(newest) < SHOWN:
        return power
    motors = frozenset.intersection(*(one.motors for one in newest))
    return msgspec.structs.replace(
        power,
        charged=power.charged or all(one.charge for one in newest),
        volts=power.volts or all(one.volts for one in newest),
        motors=power.motors if motors <= power.motors else power.motors | motors,
    )


def _believable(battery: Battery | None, volts: bool) -> bool:
    """A battery that has shown a voltage and now has none does not run a robot."""
    return battery is not None and (battery.voltage > 0 or not volts)


def _temperatures(state: RobotState) -> dict[str, float]:
    """What can be a temperature, by motor [deg C]."""
    found = ((joint.name, joint.temperature) for joint in state.joints)
    return {name: t for name, t in found if t is not None and COLDEST < t < HOTTEST}


def _low(limits: Thresholds, power: Power, elapsed: int) -> tuple[int, int, int]:
    if not power.charges:
        return power.low_ticks
    charge, enough = power.charge, ticks_of(limits.battery_sustain)

    def count(ticks: int, threshold: float) -> int:
        clear = CLEAR_PERCENT if ticks >= enough else 0.0
        return held(ticks, charge <= threshold + clear, elapsed)

    warn, home, stop = power.low_ticks
    return (
        count(warn, limits.battery_warn),
        count(home, limits.battery_return),
        count(stop, limits.battery_stop),
    )


def _over(limits: Thresholds, ticks: int, hottest: float, threshold: float, elapsed: int) -> int:
    clear = CLEAR_DEG_C if ticks >= ticks_of(limits.motor_sustain) else 0.0
    return held(ticks, hottest >= threshold - clear, elapsed)


def causes(limits: Thresholds, power: Power) -> tuple[Cause, ...]:
    """Why the body must stop."""
    found = []
    if power.low_ticks[2] >= ticks_of(limits.battery_sustain):
        found.append(say("battery_empty", f"battery at or below {limits.battery_stop:g} %"))
    if power.hot_ticks >= ticks_of(limits.motor_sustain):
        found.append(say("motor_hot", f"a motor has {limits.motor_stop:g} °C or more"))
    if power.charge_missing_ticks >= ticks_of(limits.missing_after):
        found.append(say("battery_unknown"))
    if power.motor_missing_ticks >= ticks_of(limits.missing_after):
        found.append(say("motor_unknown"))
    return tuple(found)


def warnings(limits: Thresholds, power: Power, state: RobotState) -> tuple[Cause, ...]:
    """What will become a cause if nobody acts."""
    found = []
    low = [ticks >= ticks_of(limits.battery_sustain) for ticks in power.low_ticks]
    if low[1]:
        found.append(say("battery_return", f"battery at {power.charge:.0f} %; it comes to rest"))
    elif low[0]:
        found.append(say("battery_low", f"battery at {power.charge:.0f} %"))
    if power.warm_ticks >= ticks_of(limits.motor_sustain):
        temperatures = _temperatures(state)
        name = max(temperatures, key=temperatures.__getitem__, default="a motor")
        found.append(say("motor_warm", f"{name} has {temperatures.get(name, 0):.0f} °C"))
    return tuple(found)
