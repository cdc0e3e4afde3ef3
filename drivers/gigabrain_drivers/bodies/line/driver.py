"""Driver of a base on a text line, which the robot's file describes: it needs no code.

The driver sends only commands that it receives. When they end, the firmware stops the body
(docs/reference/firmware_line.md).
"""

import logging
import time
from collections.abc import Mapping

import serial
from msgspec.structs import replace

from gigabrain_drivers.bodies.line.conversion import LineCommand, LineReport, SentWording
from gigabrain_drivers.bodies.line.options import (
    BITS_PER_BYTE,
    LineOptions,
    base_of,
    check_lines,
    velocity_fields,
)
from gigabrain_drivers.bodies.line.protocol import LineDecoder, describe
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.lidars.base import ScanSource, open_lidar
from gigabrain_drivers.links.frames import Spelling, Wording
from gigabrain_drivers.links.link import Liveness
from gigabrain_drivers.links.recent import Recent
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

MISSED_LINES = 3  # the body counts as lost after this many missing state lines in a row,
MIN_TIMEOUT_NS = 100_000_000  # but not before this time
MAX_TIMEOUT_NS = 500_000_000  # of a slower line with a part of the velocity
REPEAT_SHARE = 0.9  # commands repeat after this share of the period, because ticks are uneven
NO_VALID_LINE = (
    "no valid lines arrive, or the one with a part of the velocity is missing: "
    "check firmware, baud rate and wiring"
)
BUMPER = "bumper"  # part of the names of bumper flags
PROBE_S = 2.5  # opening the port resets an Arduino, which sends two seconds later
FLUSH_NS = 10_000_000  # pause before a port is closed, plus the duration of the written bytes
SEQUENCES = 1 << 16


class LineDriver(Driver):
    """Sends nothing before the body reports. Its first command is zero, also after a loss."""

    Options = LineOptions

    def __init__(
        self, robot: RobotFile, options: LineOptions, run: Run, *, clock: Clock | None = None
    ) -> None:
        super().__init__(robot, options, run)
        base = base_of(options, robot)
        self._command = LineCommand(options.command_template(), base)
        self._decoder = LineDecoder(options.state_templates())
        self._clock = clock or Clock()
        self.link = SerialLink(options.port, options.baud, self._clock, probe=self._is_right_port)
        self.link.wording = Wording(
            Spelling(SentWording(self._command.template, options.strings()).feed, str),
            Spelling(LineDecoder(options.state_templates()).feed, describe),
        )
        self.link.on_bytes, self.link.on_open = self._received, self._opened
        self.link.on_lost = self._lost
        self._report = LineReport(options, robot, base)
        silent_ns = max(round(MISSED_LINES / options.state_hz * 1e9), MIN_TIMEOUT_NS)
        self._parts = {  # newest parts of the velocity
            name: Recent[float](silent_ns, max(silent_ns, MAX_TIMEOUT_NS))
            for name in velocity_fields(options, robot)
        }
        self._liveness = Liveness(self.link, self._clock, silent_ns, NO_VALID_LINE, log)
        self._repeat_ns = round(REPEAT_SHARE / options.command_hz * 1e9)
        self._started = False  # True from the start string to the stop string
        self._wanted = self._rounded = self._sent = ZERO  # commanded, rounded by the line, executed
        self._sent_ns = self._seq = 0
        self._open = False
        self._logged_flags = 0
        self._no_flags = Fault(log)
        self._flags = {bit: Fault(log) for bit in range(len(options.flags))}
        self._lidar: ScanSource | None = None
        self.sensors = {"scan": None} if robot.lidar else {}

    @classmethod
    def check(cls, robot: RobotFile, options: LineOptions) -> None:
        """Raise ValueError if the lines do not fit the body."""
        check_lines(options, robot)

    async def open(self) -> None:
        """Start to connect to the body and its lidar, which may appear later."""
        self._open = True
        self.link.open()
        self._lidar = open_lidar(self, self._clock)

    async def close(self) -> None:
        """Stop the body, and close the ports."""
        if self._open:
            await self.stop()
            if self.link.connected:  # closing drops unsent bytes
                await self._clock.sleep_ns(FLUSH_NS + self._longest_write_ns())
        self._open = False
        await self.link.close()
        if self._lidar:
            await self._lidar.close()

    async def stop(self) -> None:
        """Send zero, and the stop string if the body has one and may be started."""
        self._send_zero()

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Drive. All speeds are zero if one is not a number, or while the body is lost."""
        if not self._open:
            raise BodyLost("the line is not open")
        self._send(self.bounded(linear_x, linear_y, angular_z))
        return self._sent

    async def read_state(self) -> RobotState:
        """Return the newest values; `link.connected` is False if they are too old."""
        report, now_ns = self._report, self._clock.now_ns()
        alive, overdue = self._liveness.alive(), report.flags_overdue(now_ns)
        if alive and overdue:
            self._no_flags.begin(
                f"{self.link}: its flags no longer arrive: check firmware and wiring"
            )
        elif alive:
            self._no_flags.end(f"{self.link}: its flags arrive again")
        return RobotState(
            robot_type=self.robot.robot_type,
            pose=report.pose,
            velocity=report.velocity(),
            joints=report.joints(now_ns),
            battery=report.battery(now_ns),
            bumpers=self._bumpers(),
            link=replace(self.link.health, connected=alive and not overdue),
        )

    def _longest_write_ns(self) -> int:
        """Return how long the line needs for start string, commands and stop string [ns]."""
        options: LineOptions = self.options
        command = self._command.template.longest()
        bits = (2 * command + len(options.start) + len(options.stop)) * BITS_PER_BYTE
        return round(bits / options.baud * 1e9)

    def _send_zero(self) -> None:
        self._send(ZERO)
        if self._started and self._liveness.received:
            stop = self.options.stop.encode()
            self._started = bool(stop) and not self.link.write(stop)

    def _send(self, wanted: Velocity) -> None:
        """Write a command that is new or due, and store the velocity that the body executes."""
        if not self._liveness.received:  # do not disturb its boot
            self._sent = ZERO
            return
        now_ns = self._clock.now_ns()
        if wanted != self._wanted:
            self._wanted, self._rounded = wanted, self._command.sent(wanted)
        rounded = self._rounded
        if rounded == self._sent and now_ns - self._sent_ns < self._repeat_ns:
            return
        if rounded != ZERO and not self._started:
            self._start()
        self._seq = (self._seq + 1) % SEQUENCES
        line = self._command.line(wanted, self._seq)
        self._sent, self._sent_ns = (rounded if self.link.write(line) else ZERO), now_ns

    def _start(self) -> None:
        start = self.options.start.encode()
        self._started = not start or self.link.write(start)

    def _opened(self) -> None:
        """Reset all state for a new line; send nothing before the body reports."""
        self._decoder.clear()
        self._report.restart()
        self._liveness.reset()

    def _lost(self, why: str) -> None:
        self._liveness.reset()
        self._sent = ZERO

    def _received(self, data: bytes) -> None:
        now_ns = self._clock.now_ns()
        for values in self._decoder.feed(data):
            self._report.update(values, now_ns)
            if self._reports_motion(values, now_ns) and self._liveness.mark_received():
                # it starts at rest after a boot or a loss
                self._sent_ns = 0
                self._send_zero()
            self._log_flags()
        self.link.errors = self._decoder.errors

    def _reports_motion(self, values: Mapping[str, float], now_ns: int) -> bool:
        """Return whether a line has a part of the velocity, and no other part is overdue."""
        in_line = self._parts.keys() & values.keys()
        for name in in_line:
            self._parts[name].put(values[name], now_ns)
        return bool(in_line) and all(part.get(now_ns) is not None for part in self._parts.values())

    def _bumpers(self) -> tuple[bool, ...]:
        """Return the flags whose names contain `bumper`."""
        names = enumerate(self.options.flags)
        return tuple(bool(self._report.flags >> bit & 1) for bit, name in names if BUMPER in name)

    def _log_flags(self) -> None:
        """Log once when a flag is set, and once when it is cleared."""
        if self._report.flags == self._logged_flags:
            return
        self._logged_flags = self._report.flags
        for bit, name in enumerate(self.options.flags):
            if BUMPER in name:
                continue
            if self._report.flags >> bit & 1:
                self._flags[bit].begin(f"the firmware reports: {name}")
            else:
                self._flags[bit].end(f"the firmware no longer reports: {name}")

    def _is_right_port(self, port: serial.Serial) -> bool:
        """Return whether this port sends a valid line. Runs in a thread."""
        decoder, until = LineDecoder(self.options.state_templates()), time.monotonic() + PROBE_S
        while time.monotonic() < until:
            if decoder.feed(port.read(max(1, port.in_waiting))):
                return True
        return False
