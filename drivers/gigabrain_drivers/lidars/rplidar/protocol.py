"""Slamtec RPLIDAR: requests to the lidar, its answers, and the stream of samples that follows.

Request `A5 cmd`, with a payload (commands from 0x80) `A5 cmd size payload xor`. An answer begins
with a descriptor of 7 bytes: `A5 5A`, u32 (size: 30 bits, endless: bit 30), type. Little-endian.
Sources: Slamtec's interface protocol document and the public rplidar_sdk.
"""

import struct
from typing import NamedTuple, Self

from gigabrain_drivers.lidars.rplidar.scan_formats import FORMATS, Samples, ScanFormat
from gigabrain_drivers.links.frames import xor_of

STOP, RESET, SCAN, FORCE_SCAN = 0x25, 0x40, 0x20, 0x21
GET_INFO, GET_HEALTH, GET_SAMPLERATE = 0x50, 0x52, 0x59
EXPRESS_SCAN, GET_CONF, SET_SPEED, SET_PWM, GET_BOARD = 0x82, 0x84, 0xA8, 0xF0, 0xFF

INFO, HEALTH, SAMPLERATE, CONF, BOARD = 0x04, 0x06, 0x15, 0x20, 0xFF  # types of answers
STANDARD, EXPRESS, DENSE = 0x81, 0x82, 0x85

MODE_COUNT, MODE_MICROSECONDS, MODE_DISTANCE = 0x70, 0x71, 0x74  # keys of GET_CONF
MODE_ANSWER, MODE_TYPICAL, MODE_NAME = 0x75, 0x7C, 0x7F

_SIZES = {INFO: 20, HEALTH: 3, SAMPLERATE: 4, BOARD: 4}
_MAX_CONF_BYTES = 64  # bytes
_DESCRIPTOR = struct.Struct("<2sIB")
_ENDLESS = 1 << 30
_SYNC = b"\xa5\x5a"

REQUESTS = {
    STOP: "stop", RESET: "reset",
    SCAN: "scan", FORCE_SCAN: "force scan", EXPRESS_SCAN: "express scan",
    GET_INFO: "get info", GET_HEALTH: "get health",
    GET_SAMPLERATE: "get sample rate", GET_BOARD: "get board",
    GET_CONF: "get setting", SET_SPEED: "set speed", SET_PWM: "set motor",
}  # fmt: skip
_BEFORE_CHECKSUM = 3  # bytes of a request with a payload before the payload


def request(command: int, payload: bytes = b"") -> bytes:
    """Return the bytes of a request. Commands from 0x80 carry a payload and a checksum."""
    if command < 0x80:
        return bytes([0xA5, command])
    head = bytes([0xA5, command, len(payload)]) + payload
    return head + bytes([xor_of(head)])


def express_request(mode: int = 0) -> bytes:
    """Request the stream of scan mode `mode`; 0 is the express mode of old firmware."""
    return request(EXPRESS_SCAN, struct.pack("<BHH", mode, 0, 0))


def conf_request(key: int, mode: int | None = None) -> bytes:
    """Request a setting, some of which belong to a scan mode."""
    payload = struct.pack("<I", key) if mode is None else struct.pack("<IH", key, mode)
    return request(GET_CONF, payload)


def answer(kind: int, data: bytes) -> bytes:
    """Return a single answer with its descriptor."""
    return descriptor(kind, len(data)) + data


def descriptor(kind: int, size: int, *, endless: bool = False) -> bytes:
    """Return the descriptor of an answer, or of a stream of blocks of `size` bytes."""
    return _DESCRIPTOR.pack(_SYNC, size | endless * _ENDLESS, kind)


class Info(NamedTuple):
    """Model, versions and serial number of a lidar."""

    model: int  # high nibble: 1 A1, 2 A2, 3 A3, 4 C1, 6 S1, 7 S2, 8 S3
    firmware: tuple[int, int]  # major, minor
    hardware: int
    serial: str  # 32 hex digits

    @classmethod
    def read(cls, data: bytes) -> Self:
        """Decode the 20 bytes of its answer."""
        return cls(data[0], (data[2], data[1]), data[3], data[4:].hex().upper())

    def pack(self) -> bytes:
        """Encode it as the lidar does."""
        major, minor = self.firmware
        return bytes([self.model, minor, major, self.hardware]) + bytes.fromhex(self.serial)


class Health(NamedTuple):
    """The lidar's judgement of itself."""

    status: int  # 0 good, 1 warning, 2 error: it will not scan
    code: int

    @classmethod
    def read(cls, data: bytes) -> Self:
        """Decode the 3 bytes of its answer."""
        return cls(*struct.unpack("<BH", data))

    def pack(self) -> bytes:
        """Encode it as the lidar does."""
        return struct.pack("<BH", *self)


class Answer(NamedTuple):
    """A single answer."""

    kind: int
    data: bytes


class RplidarDecoder:
    """The host's side: answers and samples in a stream of bytes. Keeps less than 200 bytes."""

    def __init__(self) -> None:
        self.errors = 0  # how often something was thrown away
        self.clear()

    def clear(self) -> None:
        """Expect a descriptor next: after a stop request, or on another connection."""
        self._buffer = bytearray()
        self._answer: tuple[int, int] | None = None  # kind and size of the one that is coming
        self._format: ScanFormat | None = None  # of the stream that has begun
        self._in_step = True

    def feed(self, data: bytes) -> list[Answer | Samples]:
        """Return the answers and samples that `data` completes, in order."""
        self._buffer += data
        found: list[Answer | Samples] = []
        while self._format is None and self._next_answer(found):
            pass
        if self._format is not None:
            self._blocks(self._format, found)
        return found

    def _next_answer(self, found: list[Answer | Samples]) -> bool:
        """Read one descriptor or announced answer. Return False if more has to come."""
        buffer = self._buffer
        if self._answer:
            kind, size = self._answer
            if len(buffer) < size:
                return False
            found.append(Answer(kind, bytes(buffer[:size])))
            del buffer[:size]
            self._answer = None
            return True
        at = buffer.find(_SYNC)
        if at < 0:
            del buffer[: len(buffer) - buffer.endswith(_SYNC[:1])]
            return False
        del buffer[:at]  # text of a reboot, the rest of a stream that was stopped
        if len(buffer) < _DESCRIPTOR.size:
            return False
        self._announced(*_DESCRIPTOR.unpack_from(buffer))
        return True

    def _announced(self, _: bytes, word: int, kind: int) -> None:
        size, endless = word & (_ENDLESS - 1), word >> 30
        if endless == 1 and kind in FORMATS and FORMATS[kind].size == size:
            self._format = FORMATS[kind]()
        elif endless == 0 and (
            _SIZES.get(kind) == size or (kind == CONF and 4 <= size <= _MAX_CONF_BYTES)
        ):
            self._answer = kind, size
        else:
            self.errors += 1
            del self._buffer[:1]
            return
        del self._buffer[: _DESCRIPTOR.size]

    def _blocks(self, format: ScanFormat, found: list[Answer | Samples]) -> None:
        """Read all whole blocks of the stream; out of step, several in a row must agree."""
        buffer, size, at = self._buffer, format.size, 0
        while len(buffer) - at >= size * (1 if self._in_step else format.confirm):
            block = bytes(buffer[at : at + size])
            if format.is_block(block) and (self._in_step or self._confirmed(format, at)):
                self._in_step = True
                if samples := format.decode(block):
                    found.append(samples)
                at += size
            else:
                self.errors += self._in_step
                self._in_step = False
                format.resync()
                at += 1
        del buffer[:at]

    def _confirmed(self, format: ScanFormat, at: int) -> bool:
        """Return whether the blocks from `at` on follow each other, by a fresh format."""
        trial, size = type(format)(), format.size
        for n in range(format.confirm):
            block = bytes(self._buffer[at + n * size : at + (n + 1) * size])
            if not trial.is_block(block):
                return False
            trial.decode(block)
        return True


def describe(item: "Answer | Samples") -> str:
    """Describe an answer or samples for the log; samples are those of the block before."""
    if isinstance(item, Samples):
        seen = [distance for distance in item.distances if distance]
        span = f"{min(seen):.0f} to {max(seen):.0f} mm" if seen else "no return"
        return f"{len(item.angles)} samples from {item.angles[0]:.2f} deg clockwise, {span}"
    if item.kind == INFO:
        info = Info.read(item.data)
        return f"info: model {info.model:#04x}, firmware {info.firmware[0]}.{info.firmware[1]:02}"
    if item.kind == HEALTH:
        return f"health: status {Health.read(item.data).status}"
    return f"answer of type {item.kind:#04x}, {len(item.data)} bytes"


class Request(NamedTuple):
    """A host's request."""

    command: int
    payload: bytes = b""


def describe_request(request: Request) -> str:
    """Describe a request for the log."""
    name = REQUESTS.get(request.command, f"request {request.command:#04x}")
    return f"{name} {request.payload.hex(' ')}".strip()


class RequestDecoder:
    """The lidar's side: requests in a stream of bytes. Keeps less than 260 bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.errors = 0

    def feed(self, data: bytes) -> list[Request]:
        """Return the requests that `data` completes."""
        buffer, found = self._buffer, list[Request]()
        buffer += data
        while True:
            self._skip()
            if len(buffer) < 2:
                return found
            if buffer[1] < 0x80:
                found.append(Request(buffer[1]))
                del buffer[:2]
                continue
            if len(buffer) < _BEFORE_CHECKSUM or len(buffer) < buffer[2] + 4:
                return found
            whole = bytes(buffer[: buffer[2] + 4])
            if xor_of(whole) == 0:
                found.append(Request(whole[1], whole[_BEFORE_CHECKSUM:-1]))
                del buffer[: len(whole)]
            else:
                self.errors += 1
                del buffer[:1]

    def _skip(self) -> None:
        at = self._buffer.find(0xA5)
        del self._buffer[: at if at >= 0 else len(self._buffer)]
