"""What use does to a body: the battery drains and the motors warm up."""

from typing import NamedTuple

from gigabrain_drivers.sim.body import SimBattery, SimMotor
from gigabrain_drivers.sim.tick import TICK_S

HOUR_S = 3600.0


class Charge(NamedTuple):
    """The battery as the robot's board reports it."""

    voltage: float  # [V], at the terminals
    percentage: float  # 0-100
    current: float  # [A], positive when it drains


class Battery:
    """Counts charge; the voltage falls along two straight lines, less the drop inside the cells."""

    def __init__(self, config: SimBattery) -> None:
        self._config = config
        self._left_ah = config.capacity_ah * config.percentage / 100
        self._current = config.idle_current_a

    def drain(self, drive_current: float) -> None:
        """Take one tick of `drive_current` [A] and the idle current out of it."""
        self._current = self._config.idle_current_a + drive_current
        self._left_ah = max(self._left_ah - self._current * TICK_S / HOUR_S, 0.0)

    def read(self) -> Charge:
        """What the board reports now."""
        config, share = self._config, self._left_ah / self._config.capacity_ah
        if share > 0.5:
            rest = config.nominal_voltage
            rest += (2 * share - 1) * (config.full_voltage - config.nominal_voltage)
        else:
            rest = config.empty_voltage
            rest += 2 * share * (config.nominal_voltage - config.empty_voltage)
        return Charge(
            rest - self._current * config.internal_resistance_ohm, 100 * share, self._current
        )


class MotorHeat:
    """One motor's temperature: heated by its current squared, cooled by the air."""

    def __init__(self, config: SimMotor) -> None:
        self._config = config
        self.celsius = config.ambient_celsius

    def warm(self, free_current: float, torque: float) -> float:
        """One tick at a no-load current [A] and a torque [N m]; returns the whole current [A]."""
        config = self._config
        current = free_current + abs(torque) / config.torque_per_ampere
        cooling = (self.celsius - config.ambient_celsius) / config.thermal_resistance
        power = current * current * config.resistance_ohm - cooling
        self.celsius += power * TICK_S / config.heat_capacity
        return current
