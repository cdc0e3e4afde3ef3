"""Monitors of the body, of the computer, and of the brain's processes.

Each process must answer the one before it: a world per scan, an intent per world, a command per
intent. A process that only repeats itself counts as silent.
"""

import math
import statistics

from msgspec import Struct
from msgspec.structs import astuple, replace

from gigabrain_schemas.base import TICK_NS, Cause
from gigabrain_schemas.body import Battery, BodyDescription, RobotState, Thresholds
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_schemas.sensors import Accelerations, Quaternion
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.safety.catalogue import cause, lasting, ticks_of

CONFIRM_STATES = 3  # in a row with a value, before the body is known to measure it
MEDIAN_STATES = 25  # with a charge; the median of 0.5 s ignores a sag of 0.2 s
CLEAR_PERCENT, CLEAR_DEG_C = 2.0, 2.0  # hysteresis of the thresholds
MIN_DEG_C, MAX_DEG_C = -40.0, 150.0  # beyond these a motor's sensor is faulty
TILT_TICKS = 10  # 0.2 s, longer than a bump in the floor
UNIT_TOLERANCE = 0.1  # error of an orientation quaternion's length
SYSTEMS = ("perception", "decision", "control")
MAX_AGES = 100  # newest commands, two seconds
AGE_PERCENTILE = 0.99
SILENT_TICKS = 50  # 1 s without commands, after which earlier ages are forgotten
HALF_SPEED = 0.5
HOST_CODES = ("disk_low", "cpu_busy", "memory_low")  # depend on the computer, not on messages


class Measured(Struct, frozen=True):
    """Values that one state contained."""

    charge: bool
    volts: bool
    motors: frozenset[str]  # with a temperature


class Power(Struct, frozen=True, kw_only=True):
    """Monitors battery and motors: low, hot, or no longer measured."""

    charges: tuple[float, ...] = ()  # newest percentages [%]
    low_ticks: tuple[int, int, int] = (0, 0, 0)  # below battery_warn, _return and _stop
    warm_ticks: int = 0
    hot_ticks: int = 0
    measured: tuple[Measured, ...] = ()  # of the newest states
    charged: bool = False  # the body measures its charge
    volts: bool = False  # the body measures its voltage
    motors: frozenset[str] = frozenset()  # whose temperature the body measures
    charge_missing_ticks: int = 0
    motor_missing_ticks: int = 0

    @property
    def charge(self) -> float:
        """The battery's charge without short sags [%]."""
        return statistics.median(self.charges)

    def then(self, limits: Thresholds, state: RobotState, elapsed: int) -> "Power":
        """Return the monitor after one more state."""
        battery = state.battery if _plausible(state.battery, self.volts) else None
        charges = (*self.charges, battery.percentage) if battery and elapsed else self.charges
        temperatures = _temperatures(state)
        now = replace(self, charges=charges[-MEDIAN_STATES:])
        if elapsed or not now.measured:
            volts = battery is not None and battery.voltage > 0
            now = now._confirmed(Measured(battery is not None, volts, frozenset(temperatures)))
        lost = bool(now.motors - temperatures.keys())
        hottest = max(temperatures.values(), default=MIN_DEG_C)
        missing = now.charged and battery is None
        return replace(
            now,
            low_ticks=now._count_low(limits, elapsed),
            warm_ticks=_count_hot(limits, now.warm_ticks, hottest, limits.motor_warn, elapsed),
            hot_ticks=_count_hot(limits, now.hot_ticks, hottest, limits.motor_stop, elapsed),
            charge_missing_ticks=lasting(now.charge_missing_ticks, missing, elapsed),
            motor_missing_ticks=lasting(now.motor_missing_ticks, lost, elapsed),
        )

    def causes(self, limits: Thresholds) -> tuple[Cause, ...]:
        """Return the causes that stop the body."""
        found = []
        if self.low_ticks[2] >= ticks_of(limits.battery_sustain):
            found.append(cause("battery_empty", f"battery at or below {limits.battery_stop:g} %"))
        if self.hot_ticks >= ticks_of(limits.motor_sustain):
            found.append(cause("motor_hot", f"a motor has {limits.motor_stop:g} °C or more"))
        if self.charge_missing_ticks >= ticks_of(limits.missing_after):
            found.append(cause("battery_unknown"))
        if self.motor_missing_ticks >= ticks_of(limits.missing_after):
            found.append(cause("motor_unknown"))
        return tuple(found)

    def warnings(self, limits: Thresholds, state: RobotState) -> tuple[Cause, ...]:
        """Return warnings before battery or motors stop the body."""
        found = []
        low = [ticks >= ticks_of(limits.battery_sustain) for ticks in self.low_ticks]
        if low[1]:
            text = f"battery at {self.charge:.0f} %; the robot stops"
            found.append(cause("battery_return", text))
        elif low[0]:
            found.append(cause("battery_low", f"battery at {self.charge:.0f} %"))
        if self.warm_ticks >= ticks_of(limits.motor_sustain):
            temperatures = _temperatures(state)
            name = max(temperatures, key=temperatures.__getitem__, default="a motor")
            found.append(cause("motor_warm", f"{name} has {temperatures.get(name, 0):.0f} °C"))
        return tuple(found)

    def _confirmed(self, now: Measured) -> "Power":
        """Add the values that the last CONFIRM_STATES states contained to the measured ones."""
        newest = (*self.measured, now)[-CONFIRM_STATES:]
        power = replace(self, measured=newest)
        if len(newest) < CONFIRM_STATES:
            return power
        motors = frozenset.intersection(*(each.motors for each in newest))
        return replace(
            power,
            charged=power.charged or all(each.charge for each in newest),
            volts=power.volts or all(each.volts for each in newest),
            motors=power.motors if motors <= power.motors else power.motors | motors,
        )

    def _count_low(self, limits: Thresholds, elapsed: int) -> tuple[int, int, int]:
        if not self.charges:
            return self.low_ticks
        charge, sustain = self.charge, ticks_of(limits.battery_sustain)

        def count(ticks: int, threshold: float) -> int:
            clear = CLEAR_PERCENT if ticks >= sustain else 0.0
            return lasting(ticks, charge <= threshold + clear, elapsed)

        warn, home, stop = self.low_ticks
        return (
            count(warn, limits.battery_warn),
            count(home, limits.battery_return),
            count(stop, limits.battery_stop),
        )


def _plausible(battery: Battery | None, volts: bool) -> bool:
    """Return whether battery data are valid; 0 V is not, once `volts` are measured."""
    return battery is not None and (battery.voltage > 0 or not volts)


def _temperatures(state: RobotState) -> dict[str, float]:
    """Return the plausible temperatures by motor [deg C]."""
    found = ((joint.name, joint.temperature) for joint in state.joints)
    return {name: t for name, t in found if t is not None and MIN_DEG_C < t < MAX_DEG_C}


def _count_hot(
    limits: Thresholds, ticks: int, hottest: float, threshold: float, elapsed: int
) -> int:
    clear = CLEAR_DEG_C if ticks >= ticks_of(limits.motor_sustain) else 0.0
    return lasting(ticks, hottest >= threshold - clear, elapsed)


class Attitude(Struct, frozen=True, kw_only=True):
    """Monitors tilt and shocks."""

    tilted_ticks: int = 0
    hit: bool = False  # in this state

    def then(self, limits: Thresholds, state: RobotState, shock: float, elapsed: int) -> "Attitude":
        """Return the monitor after one more state.

        `shock` is the largest horizontal acceleration since the last state [m/s2].
        """
        tilt = tilt_deg(state.imu.orientation) if state.imu else None
        if state.imu:
            shock = max(shock, horizontal(state.imu.linear_acceleration))
        tilted = tilt is not None and tilt > limits.tilt_stop
        return Attitude(
            tilted_ticks=lasting(self.tilted_ticks, tilted, elapsed),
            hit=any(state.bumpers) or shock > limits.shock_stop,
        )

    @property
    def causes(self) -> tuple[Cause, ...]:
        """Return the causes that stop the body until a person releases it."""
        found = [("tilted", self.tilted_ticks >= TILT_TICKS), ("collision", self.hit)]
        return tuple(cause(code) for code, wrong in found if wrong)


def tilt_deg(orientation: Quaternion) -> float | None:
    """Return the angle between the body's z axis and the vertical [deg]; None if invalid."""
    x, y, z, w = orientation
    if abs(math.hypot(x, y, z, w) - 1.0) > UNIT_TOLERANCE:
        return None
    return math.degrees(math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y)))))


def horizontal(acceleration: Accelerations) -> float:
    """Return the acceleration across the body's z axis [m/s2]."""
    return math.hypot(acceleration[0], acceleration[1])


class Host(Struct, frozen=True, kw_only=True):
    """Resources of the computer that safety runs on; None if unknown."""

    disk_mb: float | None = None  # [MB] free
    cpu: float | None = None  # [%] of all cores, used
    memory: float | None = None  # [%] used

    def warnings(self, limits: Thresholds) -> tuple[Cause, ...]:
        """Return warnings of scarce resources; none of them stops the body."""
        found = []
        if self.disk_mb is not None and self.disk_mb < limits.disk_warn:
            found.append(cause("disk_low", f"{self.disk_mb:.0f} MB left on the disk"))
        if self.cpu is not None and self.cpu > limits.cpu_warn:
            found.append(cause("cpu_busy"))
        if self.memory is not None and self.memory > limits.memory_warn:
            found.append(cause("memory_low"))
        return tuple(found)


class Bases(Struct, frozen=True, kw_only=True):
    """Ticks of the sensor data that the newest messages are based on; 0 for none."""

    scan: int = 0
    world: int = 0
    intent: int = 0
    command: int = 0


class PipelineProgress(Struct, frozen=True, kw_only=True):
    """Monitors whether each system answers the one before it."""

    bases: Bases = Bases()
    behind_ticks: tuple[int, int, int] = (0, 0, 0)  # since the last progress of each system

    def then(self, bases: Bases, elapsed: int) -> "PipelineProgress":
        """Return the monitor after one more state."""
        now, last = astuple(bases), astuple(self.bases)
        perception, decision, control = (
            lasting(ticks, now[i + 1] < now[i] and now[i + 1] == last[i + 1], elapsed)
            for i, ticks in enumerate(self.behind_ticks)
        )
        return PipelineProgress(bases=bases, behind_ticks=(perception, decision, control))

    def causes(
        self,
        limits: Thresholds,
        state: RobotState,
        silent: tuple[str, ...],
        *,
        first: bool,
        needed: tuple[str, ...] = SYSTEMS,
    ) -> tuple[Cause, ...]:
        """Return the causes that stop the body; `silent` are the systems without fresh messages.

        The brain only matters while it drives, or may drive next. If nobody drives and all systems
        that the body needs are silent, there is no brain, and a script need not wait for one. At
        the `first` scan this is not known yet.
        """
        commander = state.gate.commander
        brainless = not commander and set(silent) >= set(needed) and not first
        if commander not in ("", BRAIN) or brainless:
            return ()
        found = [cause(f"{name}_silent") for name in silent if name in needed]
        for name, ticks in zip(SYSTEMS, self.behind_ticks, strict=True):
            if name not in silent and ticks >= ticks_of(limits.heartbeat):
                found.append(cause(f"{name}_silent", f"{name} does not react to new data"))
        return tuple(found)


class RoundTrip(Struct, frozen=True, kw_only=True):
    """Monitors the age of commands: from the tick that they echo to their arrival."""

    commander: str = ""
    ages: tuple[int, ...] = ()  # of its newest commands [ticks]
    late_ticks: int = 0  # up to the newest command
    silent_ticks: int = 0  # since the newest command

    def then(
        self, limits: Thresholds, commander: str, ages: tuple[int, ...], elapsed: int
    ) -> "RoundTrip":
        """Return the monitor after one more state, with the ages of new commands [ticks].

        It starts again with another commander, and after a second without commands.
        """
        last = self if commander == self.commander else RoundTrip(commander=commander)
        silent = last.silent_ticks + elapsed
        if not ages:
            ended = silent >= SILENT_TICKS
            return RoundTrip(commander=commander) if ended else replace(last, silent_ticks=silent)
        newest = (*last.ages, *ages)[-MAX_AGES:]
        slowest = percentile(sorted(newest), AGE_PERCENTILE) or 0
        late = slowest * TICK_NS > limits.round_trip * 1e9
        passed = silent if last.late_ticks else max(1, elapsed)  # two verdicts may share a tick
        late_ticks = lasting(last.late_ticks, late, passed)
        return RoundTrip(commander=commander, ages=newest, late_ticks=late_ticks)

    def causes(self, limits: Thresholds) -> tuple[Cause, ...]:
        """Return the cause that halves the speed."""
        if self.late_ticks < ticks_of(limits.round_trip_sustain):
            return ()
        text = f"commands take more than {limits.round_trip * 1e3:.0f} ms"
        return (cause("round_trip", text),)


def halved(body: BodyDescription, caps: SpeedCaps) -> SpeedCaps:
    """Return `caps`, limited to half the body's speed in each direction."""

    def lower(cap: float | None, limit: float) -> float:
        return HALF_SPEED * limit if cap is None else min(cap, HALF_SPEED * limit)

    return SpeedCaps(
        forward=lower(caps.forward, body.max_linear_speed),
        backward=lower(caps.backward, body.max_linear_speed),
        left=lower(caps.left, body.max_lateral_speed),
        right=lower(caps.right, body.max_lateral_speed),
        rotation=lower(caps.rotation, body.max_angular_speed),
        turn_left=caps.turn_left,
        turn_right=caps.turn_right,
    )
