"""Emulated firmware of alpha, as in docs/reference/firmware_alpha.md: a TCP server, and a trot."""

from collections import deque
from pathlib import Path
from typing import Any, ClassVar

from gigabrain_drivers.bodies.alpha import protocol as alpha
from gigabrain_drivers.bodies.alpha.driver import AlphaOptions
from gigabrain_drivers.bodies.alpha.protocol import AlphaDecoder, AlphaFrame, State
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Port, Snapshot, Wire
from gigabrain_drivers.emulators.ports import TcpPort
from gigabrain_drivers.kinematics.legs import WALKER, Gait, Senses, by_leg, is_valid_gait
from gigabrain_drivers.kinematics.wheels import Twist

LYING_M = 0.13  # height of the hips of a lying body
REST = WALKER.to_gait(Twist(0.0, 0.0, 0.0))
RISE_NS = 1_800_000_000  # from lying to standing
LYING = REST._replace(height=LYING_M)
BROWN_OUT_SHARE = 0.6  # of the battery's voltage; the firmware is off below it
MAX_EXECUTED = 1000  # newest commands, kept for tests


class Alpha(Device):
    """Obeys valid commands that are newer than the last one, stops after silence, and reports.

    After silence, the first valid command starts a new sequence.
    """

    Options = AlphaOptions
    period_s: ClassVar[float] = 1 / alpha.STATE_HZ
    watchdog_ns = alpha.SILENCE_NS
    promised_in = "firmware_alpha.md"

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self.executed: deque[Gait] = deque(maxlen=MAX_EXECUTED)  # commands to the legs
        self.reset()

    @classmethod
    def port(cls, options: Any) -> Port:
        """Return a TCP port: the default one, if free. Its address is written to `options.port`."""
        return TcpPort(Path(options.port), alpha.PORT)

    def reset(self) -> None:
        """Power on: stand."""
        self._decoder = AlphaDecoder()
        self._echo = self._sent = self._refused = 0
        self._last: int | None = None  # sequence of the newest command
        self._obeyed_ns: int | None = None  # time of that command
        self._now_ns = 0
        self.body.take_snapshots()  # drop old measurements
        self._began_ns = self.body.snapshot.time_ns
        self._silent, self._on = True, True
        self._gait, self._stands_ns = REST, 0
        self.body.walk(REST)

    @property
    def parked(self) -> bool:
        """True while the body lies, or is lying down."""
        return self._gait == LYING

    def feed(self, data: bytes) -> None:
        """Obey commands; keep partial ones."""
        if not self._on:
            return
        errors = self._decoder.errors
        for frame in self._decoder.feed(data):
            gait = self._requested_gait(frame)
            if gait is None:
                self._refused += 1
            else:
                self._execute(gait, frame.sequence)
        self._refused += self._decoder.errors - errors

    def step(self, now_ns: int) -> None:
        """Stop the body after silence, and report."""
        supply = self.body.snapshot.battery.voltage
        on = supply - self.sag_volts >= BROWN_OUT_SHARE * supply
        if on != self._on:
            self.reset()
            self._on = on
        if not on:
            return
        self._now_ns = now_ns
        if self._obeyed_ns is None or now_ns - self._obeyed_ns >= self.watchdog_ns:
            self._silent, self._last = True, None
            self._walk(LYING if self.parked else REST)
        for sample in self.body.take_snapshots() or [self.body.snapshot]:
            self._sent += 1
            self.wire.write(alpha.encode_state(self._report(sample), self._sent))

    def _requested_gait(self, frame: AlphaFrame) -> Gait | None:
        """Return the gait of a command that is valid, new and fresh; else None."""
        if frame.type == alpha.STOP:
            return REST
        if frame.type == alpha.PARK:
            return LYING
        command = alpha.decode_walk(frame) if frame.type == alpha.WALK else None
        if command is None or not is_valid_gait(command.gait):
            return None
        if self._last is not None and not alpha.is_newer(frame.sequence, self._last):
            return None
        now_ms = self._milliseconds(self.body.snapshot)
        return None if alpha.is_stale(command.seen, now_ms) else command.gait

    def _milliseconds(self, sample: Snapshot) -> int:
        """Return the firmware's clock [ms]. It runs with the body's: a busy host delays both."""
        return max(0, sample.time_ns - self._began_ns) // 1_000_000

    def _execute(self, gait: Gait, sequence: int) -> None:
        self._last = self._echo = sequence
        self._obeyed_ns, self._silent = self._now_ns, False
        self.executed.append(gait)
        self._walk(gait)

    def _walk(self, gait: Gait) -> None:
        """Command the legs; a lying body stands up before its first step."""
        if self.parked and gait != LYING:
            self._stands_ns = self._now_ns + RISE_NS
        if gait != LYING and self._now_ns < self._stands_ns:
            gait = REST
        if gait != self._gait:
            self._gait = gait
            self.body.walk(gait)

    def _report(self, now: Snapshot) -> State:
        flags = alpha.SILENT if self._silent else 0
        flags |= alpha.PARKED if self.parked else 0
        flags |= alpha.FALLEN if now.fallen else 0
        flags |= alpha.WALKING if max(map(abs, WALKER.to_body(self._gait))) > 0 else 0
        return State(
            milliseconds=self._milliseconds(now),
            echo=self._echo,
            refused=self._refused,
            flags=flags,
            voltage=max(now.battery.voltage - self.sag_volts, 0.0),
            current=now.battery.current,
            percentage=now.battery.percentage,
            senses=Senses(
                joints=by_leg([motor.position for motor in now.wheels]),
                rates=by_leg([motor.velocity for motor in now.wheels]),
                contacts=now.contacts,
                orientation=now.imu.orientation,
                angular_velocity=now.imu.angular_velocity,
                linear_acceleration=now.imu.linear_acceleration,
            ),
            torques=tuple(motor.effort for motor in now.wheels),
            temperatures=tuple(motor.temperature for motor in now.wheels),
        )
