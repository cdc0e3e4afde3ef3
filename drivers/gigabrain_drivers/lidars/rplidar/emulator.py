"""Emulated RPLIDARs. They answer requests, and stream standard, express or dense samples."""

from pathlib import Path
from typing import NamedTuple

from gigabrain_drivers.emulators.base import Device, EmulatedBody, Port, Sample, Sweep, Wire
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.lidars.rplidar.protocol import (
    DENSE,
    EXPRESS,
    STANDARD,
    Health,
    Info,
    Request,
    RequestDecoder,
)
from gigabrain_drivers.lidars.rplidar.scan_formats import (
    FORMATS,
    encode_dense,
    encode_express,
    encode_node,
)
from gigabrain_drivers.lidars.rplidar.source import MODELS, RplidarOptions

SAMPLES = {STANDARD: 1, EXPRESS: 32, DENSE: 40}  # in a block
QUALITY = 47  # of a standard node with a return
SERIAL = "0123456789ABCDEF" * 2


class Mode(NamedTuple):
    """A scan mode, as in answers to GET_CONF."""

    name: str
    kind: int  # answer type
    period_us: float


class Unit(NamedTuple):
    """Properties of a model."""

    info: Info
    reach: tuple[float, float]  # [m], minimum and maximum range
    modes: tuple[Mode, ...]  # the last one is the typical mode
    board: bool = False  # True if an accessory board powers its motor


UNITS = {
    "a1": Unit(
        Info(0x18, (1, 29), 7, SERIAL),
        (0.15, 12.0),
        (Mode("Standard", STANDARD, 500), Mode("Express", EXPRESS, 250)),
    ),
    "a2m8": Unit(
        Info(0x28, (1, 29), 5, SERIAL),
        (0.15, 12.0),
        (Mode("Standard", STANDARD, 500), Mode("Express", EXPRESS, 250)),
        board=True,
    ),
    "c1": Unit(
        Info(0x41, (1, 1), 18, SERIAL),
        (0.05, 12.0),
        (Mode("Standard", STANDARD, 200), Mode("DenseBoost", DENSE, 200)),
    ),
    "s2": Unit(
        Info(0x71, (1, 1), 18, SERIAL),
        (0.05, 30.0),
        (Mode("Standard", STANDARD, 62.5), Mode("DenseBoost", DENSE, 31.25)),
    ),
}
LEGACY = Mode("Express", EXPRESS, 250)  # mode 0 of express requests, in all firmware


class RplidarDevice(Device):
    """An RPLIDAR of the model in the options; `auto` is an A1.

    A pty has no DTR line, so motors that it controls turn all the time.
    """

    Options = RplidarOptions

    def __init__(self, body: EmulatedBody, options: RplidarOptions, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self.unit = emulated_unit(options)
        self.health = Health(0, 0)
        self._requests = RequestDecoder()
        self._sweep = Sweep(body, *self.unit.reach)
        self._nominal_hz = body.robot.lidar.rate_hz if body.robot.lidar else 10.0
        self._mode: Mode | None = None  # None while it does not scan
        self._turn_hz = 0.0
        self._first = False  # True if the next block is the first of its stream
        self._last_angle = 0.0

    @classmethod
    def port(cls, options: RplidarOptions) -> Port:
        """Return a pty with the model's baud rate."""
        baud = MODELS["a1" if options.model == "auto" else options.model].baud
        return Pty(Path(options.port), baud)

    def feed(self, data: bytes) -> None:
        """Obey requests; keep partial ones."""
        for request in self._requests.feed(data):
            self._handle_request(request)

    def reset(self) -> None:
        """Boot: turn the motor, unless a board powers it, and send the banner."""
        self._halt()
        self.health = Health(0, 0)
        self._turn_hz = 0.0 if self.unit.board else self._nominal_hz
        major, minor = self.unit.info.firmware
        hardware = self.unit.info.hardware
        banner = f"RP LIDAR System.\r\nFirmware Ver {major}.{minor:02d}, HW Ver {hardware}\r\n"
        self.wire.write(banner.encode())

    def step(self, now_ns: int) -> None:
        """Send all complete blocks; standard nodes in one write."""
        mode = self._mode
        if mode is None:
            return
        nodes = b""
        while samples := self._sweep.next_samples(SAMPLES[mode.kind]):
            block = self._block(mode.kind, samples)
            if mode.kind == STANDARD:
                nodes += block
            else:
                self.wire.write(block)
        if nodes:
            self.wire.write(nodes)

    def _handle_request(self, request: Request) -> None:
        command, payload = request
        match command:
            case rplidar.STOP:
                self._halt()
            case rplidar.RESET:
                self.reset()
            case rplidar.SET_PWM | rplidar.SET_SPEED if len(payload) == 2:
                self._set_motor(command, int.from_bytes(payload, "little"))
            case _ if self._mode is None:  # while it scans, it ignores other requests
                self._answer(command, payload)

    def _answer(self, command: int, payload: bytes) -> None:
        match command:
            case rplidar.SCAN | rplidar.FORCE_SCAN:
                self._scan(self.unit.modes[0])
            case rplidar.EXPRESS_SCAN if payload and payload[0] < len(self.unit.modes):
                self._scan(self.unit.modes[payload[0]] if payload[0] else LEGACY)
            case rplidar.GET_INFO:
                self._send_answer(rplidar.INFO, self.unit.info.pack())
            case rplidar.GET_HEALTH:
                self._send_answer(rplidar.HEALTH, self.health.pack())
            case rplidar.GET_SAMPLERATE:
                periods = (round(self.unit.modes[0].period_us), round(LEGACY.period_us))
                self._send_answer(
                    rplidar.SAMPLERATE, b"".join(p.to_bytes(2, "little") for p in periods)
                )
            case rplidar.GET_BOARD:
                self._send_answer(rplidar.BOARD, int(self.unit.board).to_bytes(4, "little"))
            case rplidar.GET_CONF if len(payload) >= 4:
                value = self._conf(payload[0], int.from_bytes(payload[4:6], "little"))
                self._send_answer(rplidar.CONF, payload[:4] + value)

    def _send_answer(self, kind: int, data: bytes) -> None:
        self.wire.write(rplidar.answer(kind, data))

    def _conf(self, key: int, number: int) -> bytes:
        """Return the value of a setting; empty if there is none."""
        modes = self.unit.modes
        if key == rplidar.MODE_COUNT:
            return len(modes).to_bytes(2, "little")
        if key == rplidar.MODE_TYPICAL:
            return (len(modes) - 1).to_bytes(2, "little")
        if number >= len(modes):
            return b""
        mode = modes[number]
        values = {
            rplidar.MODE_MICROSECONDS: round(mode.period_us * 256).to_bytes(4, "little"),
            rplidar.MODE_DISTANCE: round(self.unit.reach[1] * 256).to_bytes(4, "little"),
            rplidar.MODE_ANSWER: bytes([mode.kind]),
            rplidar.MODE_NAME: mode.name.encode() + b"\0",
        }
        return values.get(key, b"")

    def _set_motor(self, command: int, value: int) -> None:
        if command == rplidar.SET_SPEED and self.unit.info.model >> 4 >= 6:
            self._turn_hz = value / 60
        elif command == rplidar.SET_PWM and self.unit.board:
            self._turn_hz = self._nominal_hz if value else 0.0
        self._sweep.turn_hz = self._turn_hz

    def _scan(self, mode: Mode) -> None:
        if self.health.status == 2:
            return
        size = FORMATS[mode.kind].size
        self.wire.write(rplidar.descriptor(mode.kind, size, endless=True))
        self._mode, self._first = mode, True
        self._sweep.start(1e6 / mode.period_us, self._turn_hz)

    def _halt(self) -> None:
        self._mode = None
        self._sweep.stop()

    def _block(self, kind: int, samples: list[Sample]) -> bytes:
        first, self._first = self._first, False
        start, distances = samples[0].angle, [sample.distance for sample in samples]
        if kind == DENSE:
            return encode_dense(start, distances, begins=first)
        if kind == EXPRESS:
            return encode_express(start, distances, begins=first)
        begins, self._last_angle = start < self._last_angle, start
        return encode_node(
            start, distances[0], quality=QUALITY if distances[0] else 0, begins=begins
        )


def emulated_unit(options: RplidarOptions) -> Unit:
    """Return the emulated model; models without an entry are emulated as A1 or S2."""
    if options.model in UNITS:
        return UNITS[options.model]
    return UNITS["s2" if options.model == "s3" else "a1"]
