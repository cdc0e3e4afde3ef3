"""Emulated firmware of a base on a text line, as in docs/reference/firmware_line.md.

It uses the driver's templates in the opposite direction.
"""

import math
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gigabrain_drivers.bodies.line.conversion import LineCommand
from gigabrain_drivers.bodies.line.options import SIDES, WHEEL_PARTS, LineOptions, base_of
from gigabrain_drivers.bodies.line.protocol import MAX_LINE_BYTES, Field
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Port, Wire
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.geometry.limits import clamp, limits_of

BOOT_NS = 300_000_000  # from power-on to the first state line
BROWN_OUT_SHARE = 0.6  # of the battery's voltage; the board is in reset below it
BANNER = b"\x00\xf8firmware of a base on a text line\r\nready\r\n"
MAX_EXECUTED = 1000  # newest commands, kept for tests
WATCHDOG = "watchdog"  # flag that is set while the motors are stopped after silence


class LineBase(Device):
    """Boots at rest, obeys valid lines within the body's limits, and stops after silence."""

    Options = LineOptions
    period_s = 0.005
    watchdog_ns = 150_000_000
    promised_in = "firmware_line.md"

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self._options: LineOptions = options
        self._command = options.command_template()
        self._converter = LineCommand(self._command, base_of(options, body.robot))
        self._state = options.state_templates()
        self._limits = limits_of(body.robot)
        self._state_ns = round(1e9 / options.state_hz)
        self._start = options.start.encode().strip()
        self._stop = options.stop.encode().strip()
        self.executed: deque[Velocity] = deque(maxlen=MAX_EXECUTED)  # commands to the motors
        self._now_ns = 0
        self.reset()

    @classmethod
    def port(cls, options: Any) -> Port:
        """Return a pty with the line's baud rate."""
        return Pty(Path(options.port), options.baud)

    def reset(self) -> None:
        """Boot: stop the motors, and restart the counters; the banner follows."""
        self._rest = b""
        self._enabled = not self._start
        self._obeyed_ns: int | None = None  # time of the last command
        self._booted_ns: int | None = None
        self._next_ns = 0
        wheels = self.body.snapshot.wheels
        self._start_angles = {wheel.name: wheel.position for wheel in wheels}
        self.body.command(0.0, 0.0, 0.0)

    def feed(self, data: bytes) -> None:
        """Handle lines; keep partial ones. Lines that are too long or invalid are dropped."""
        *lines, rest = (self._rest + data).split(self._command.end)
        self._rest = rest if len(rest) <= MAX_LINE_BYTES else rest[-MAX_LINE_BYTES:]
        if self._booted_ns is None or self._now_ns < self._booted_ns:
            return
        for line in lines:
            self._execute(line.strip(b"\r\n"))

    def step(self, now_ns: int) -> None:
        """Stop the body after silence, and report."""
        self._now_ns = now_ns
        if self._browned_out():
            self.reset()
            return
        if self._booted_ns is None:
            self._booted_ns = self._next_ns = now_ns + BOOT_NS
            self.wire.write(BANNER)
        if self._silent():
            self.body.command(0.0, 0.0, 0.0)
        if now_ns >= self._next_ns:
            self._next_ns = max(self._next_ns + self._state_ns, now_ns - self._state_ns)
            for template in self._state:
                self.wire.write(template.encode(self._measured(template.fields)))

    def _execute(self, line: bytes) -> None:
        if self._start and line == self._start:
            self._enabled = True
        elif self._stop and line == self._stop:
            self._enabled = not self._start
            self.body.command(0.0, 0.0, 0.0)
        elif self._enabled and (values := self._command.decode(line)) is not None:
            self._obeyed_ns = self._now_ns
            target = clamp(self._converter.means(values), self._limits)
            self.executed.append(target)
            self.body.command(target.linear_x, target.linear_y, target.angular_z)

    def _silent(self) -> bool:
        """Return whether the last command will be too old at the next step."""
        if self._obeyed_ns is None:
            return True
        return self._now_ns + self.period_s * 1e9 - self._obeyed_ns > self.watchdog_ns

    def _browned_out(self) -> bool:
        voltage = self.body.snapshot.battery.voltage
        return voltage - self.sag_volts < BROWN_OUT_SHARE * voltage

    def _measured(self, fields: tuple[Field, ...]) -> dict[str, float]:
        """Return the values of sensors in SI units, with wrapped counters."""
        snapshot = self.body.snapshot
        values: dict[str, float] = snapshot.odometry._asdict()
        values["yaw"] = math.remainder(values["yaw"], math.tau)
        for wheel in snapshot.wheels:
            name = wheel.name.removesuffix("_joint")
            values[f"{name}_position"] = wheel.position - self._start_angles[wheel.name]
            values[f"{name}_velocity"] = wheel.velocity
            values[f"{name}_effort"] = wheel.effort
            values[f"{name}_temperature"] = wheel.temperature
        values |= _sides(values)
        values["battery_voltage"] = snapshot.battery.voltage - self.sag_volts
        values["battery_percentage"] = snapshot.battery.percentage
        values["battery_current"] = snapshot.battery.current
        values["flags"] = float(self._flags())
        return {f.name: self._wrapped(f, values.get(f.name, 0.0)) for f in fields}

    def _flags(self) -> int:
        conditions = {WATCHDOG: self._silent(), "bumper": self.body.snapshot.bumper}
        names = enumerate(self._options.flags)
        return sum(1 << bit for bit, name in names if conditions.get(name, False))

    def _wrapped(self, field: Field, value: float) -> float:
        """Return the value; in ticks, it is wrapped as by a counter of `tick_bits`."""
        if not field.unit.endswith("tick"):
            return value
        span = 1 << self._options.tick_bits
        count = (round(value / field.factor) + span // 2) % span - span // 2
        return count * field.factor


def _sides(values: Mapping[str, float]) -> dict[str, float]:
    """Return the mean of the wheels on each side, for a board with one motor per side."""
    found = {}
    for side in SIDES:
        suffix = side.removeprefix("wheel")
        for part in WHEEL_PARTS:
            of_side = [value for name, value in values.items() if name.endswith(suffix + part)]
            if of_side and side + part not in values:
                found[side + part] = sum(of_side) / len(of_side)
    return found
