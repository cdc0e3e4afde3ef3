"""Protocol of Slamtec RPLIDARs: requests to the lidar, its answers, and its stream of samples.

A request is `A5 cmd`, or for commands from 0x80, `A5 cmd size payload xor`. An answer begins with
a descriptor of 7 bytes: `A5 5A`, u32 (size: 30 bits, endless: bit 30), type. Little-endian.
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
_MAX_CONF_BYTES = 64
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
_HEADER_BYTES = 3  # of a request with a payload


def request(command: int, payload: bytes = b"") -> bytes:
    """Return the bytes of a request. Commands from 0x80 carry a payload and a checksum."""
    if command < 0x80:
        return bytes([0xA5, command])
    head = bytes([0xA5, command, len(payload)]) + payload
    return head + bytes([xor_of(head)])


def express_request(mode: int = 0) -> bytes:
    """Return a request for the stream of a scan mode; 0 is the express mode of old firmware."""
    return request(EXPRESS_SCAN, struct.pack("<BHH", mode, 0, 0))


def conf_request(key: int, mode: int | None = None) -> bytes:
    """Return a request for a setting, or for the setting of a scan mode."""
    payload = struct.pack("<I", key) if mode is None else struct.pack("<IH", key, mode)
    return request(GET_CONF, payload)


def answer(kind: int, data: bytes) -> bytes:
    """Return an answer with its descriptor."""
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
        """Decode the answer's 20 bytes."""
        return cls(data[0], (data[2], data[1]), data[3], data[4:].hex().upper())

    def pack(self) -> bytes:
        """Encode it as the lidar does."""
        major, minor = self.firmware
        return bytes([self.model, minor, major, self.hardware]) + bytes.fromhex(self.serial)


class Health(NamedTuple):
    """State of the lidar by its self-test."""

    status: int  # 0 good, 1 warning, 2 error; it does not scan after an error
    code: int

    @classmethod
    def read(cls, data: bytes) -> Self:
        """Decode the answer's 3 bytes."""
        return cls(*struct.unpack("<BH", data))

    def pack(self) -> bytes:
        """Encode it as the lidar does."""
        return struct.pack("<BH", *self)


class Answer(NamedTuple):
    """An answer without its descriptor."""

    kind: int
    data: bytes


class RplidarDecoder:
    """Finds answers and samples in the bytes from the lidar. Keeps less than 200 bytes."""

    def __init__(self) -> None:
        self.errors = 0  # number of times that bytes were dropped
        self.clear()

    def clear(self) -> None:
        """Expect a descriptor next: after a request, or for a new connection."""
        self._buffer = bytearray()
        self._answer: tuple[int, int] | None = None  # kind and size of the announced answer
        self._format: ScanFormat | None = None  # of the current stream
        self._in_step = True

    def feed(self, data: bytes) -> list[Answer | Samples]:
        """Return the answers and samples that `data` completes, in order."""
        self._buffer += data
        found: list[Answer | Samples] = []
        while self._format is None and self._next_answer(found):
            pass
        if self._format is not None:
            self._read_blocks(self._format, found)
        return found

    def _next_answer(self, found: list[Answer | Samples]) -> bool:
        """Read one descriptor or announced answer. Return False if bytes are missing."""
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
        del buffer[:at]  # text of a reboot, or the rest of a stopped stream
        if len(buffer) < _DESCRIPTOR.size:
            return False
        self._read_descriptor(*_DESCRIPTOR.unpack_from(buffer))
        return True

    def _read_descriptor(self, _: bytes, word: int, kind: int) -> None:
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

    def _read_blocks(self, format: ScanFormat, found: list[Answer | Samples]) -> None:
        """Read all complete blocks; out of step, `confirm` consecutive blocks must be valid."""
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
        """Return whether the blocks from `at` on follow each other."""
        trial, size = type(format)(), format.size
        for n in range(format.confirm):
            block = bytes(self._buffer[at + n * size : at + (n + 1) * size])
            if not trial.is_block(block):
                return False
            trial.decode(block)
        return True


def describe(item: "Answer | Samples") -> str:
    """Describe an answer or samples for the log; samples are those of the last block."""
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
    """A request to the lidar."""

    command: int
    payload: bytes = b""


def describe_request(request: Request) -> str:
    """Describe a request for the log."""
    name = REQUESTS.get(request.command, f"request {request.command:#04x}")
    return f"{name} {request.payload.hex(' ')}".strip()


class RequestDecoder:
    """Finds requests in the bytes to the lidar. Keeps less than 260 bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.errors = 0

    def feed(self, data: bytes) -> list[Request]:
        """Return the requests that `data` completes."""
        buffer, found = self._buffer, list[Request]()
        buffer += data
        while True:
            self._drop_before_request()
            if len(buffer) < 2:
                return found
            if buffer[1] < 0x80:
                found.append(Request(buffer[1]))
                del buffer[:2]
                continue
            if len(buffer) < _HEADER_BYTES or len(buffer) < buffer[2] + 4:
                return found
            frame = bytes(buffer[: buffer[2] + 4])
            if xor_of(frame) == 0:
                found.append(Request(frame[1], frame[_HEADER_BYTES:-1]))
                del buffer[: len(frame)]
            else:
                self.errors += 1
                del buffer[:1]

    def _drop_before_request(self) -> None:
        at = self._buffer.find(0xA5)
        del self._buffer[: at if at >= 0 else len(self._buffer)]
