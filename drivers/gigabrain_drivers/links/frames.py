"""Finds frames in a stream of bytes, for binary protocols, and describes them for the log."""

import abc
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Generic, TypeVar

from gigabrain_schemas.base import Velocity

Frame = TypeVar("Frame")

MAX_UNFRAMED_BYTES = 512  # bytes without a frame are logged when there are more
Feed = Callable[[bytes], Sequence[Any]]  # `feed` of a protocol's decoder
Describe = Callable[[Any], str]  # describes a frame of that decoder


def xor_of(data: bytes) -> int:
    """Return the exclusive or of all bytes."""
    return functools.reduce(operator.xor, data, 0)


def crc_table(polynomial: int, bits: int) -> tuple[int, ...]:
    """Return the table (256,) of a CRC of 8 or 16 bits that is not reflected."""
    top, table = 1 << bits - 1, []
    for byte in range(256):
        value = byte << bits - 8
        for _ in range(8):
            value = value << 1 ^ (polynomial if value & top else 0)
        table.append(value & (1 << bits) - 1)
    return tuple(table)


class FrameDecoder(abc.ABC, Generic[Frame]):
    """Finds frames by header, size and checksum. `errors` counts skipped stretches of bytes.

    The search continues inside an invalid frame, so no other frame is lost.
    """

    HEADER: ClassVar[bytes]

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._skipping = False  # True inside a stretch that is counted
        self.errors = 0

    def clear(self) -> None:
        """Drop a partial frame."""
        self._buffer.clear()
        self._skipping = False

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that `data` completes, in order."""
        buffer, frames = self._buffer, list[Frame]()
        buffer += data
        while self._at_header():
            size = self._size(buffer)
            if size is None or len(buffer) < size:
                break
            frame = self._frame(bytes(buffer[:size])) if size else None
            if frame is None:
                self._skip(1)  # a header may start inside a header
                continue
            frames.append(frame)
            del buffer[:size]
            self._skipping = False
        return frames

    @abc.abstractmethod
    def _size(self, buffer: bytearray) -> int | None:
        """Return the size of the frame at the start; 0 if it is none, None if not known yet."""

    @abc.abstractmethod
    def _frame(self, data: bytes) -> Frame | None:
        """Return the frame in these bytes, or None if its checksum is wrong."""

    def _at_header(self) -> bool:
        """Drop the bytes before the next header; return whether there is one."""
        at = self._buffer.find(self.HEADER)
        if at < 0:
            at = len(self._buffer) - self._partial_header()
        if at:
            self._skip(at)
        return len(self._buffer) >= len(self.HEADER)

    def _partial_header(self) -> int:
        """Return the number of bytes at the buffer's end that may start a header."""
        parts = range(len(self.HEADER) - 1, 0, -1)
        return next((n for n in parts if self._buffer.endswith(self.HEADER[:n])), 0)

    def _skip(self, count: int) -> None:
        del self._buffer[:count]
        self.errors += not self._skipping
        self._skipping = True


class Spelling:
    """Describes one direction of a line. It feeds single bytes, to know the bytes of each frame.

    If a decoder waits for bytes after a frame, the frame is shown with those bytes.
    """

    def __init__(self, feed: Feed, describe: Describe) -> None:
        self._feed, self._describe = feed, describe
        self._pending = bytearray()

    def spell(self, data: bytes) -> list[str]:
        """Return a line of text for each frame that `data` completes."""
        lines = []
        for value in data:
            self._pending.append(value)
            for frame in self._feed(bytes((value,))):
                lines.append(_line(self._pending, self._describe(frame)))
                self._pending.clear()
        if len(self._pending) > MAX_UNFRAMED_BYTES:
            lines.append(_line(self._pending, "no frame"))
            self._pending.clear()
        return lines


class Wording:
    """Describes both directions of a line; without a spelling, only the bytes."""

    def __init__(self, sent: Spelling | None = None, received: Spelling | None = None) -> None:
        self._spellings = {"tx": sent, "rx": received}

    def lines(self, way: str, data: bytes) -> list[str]:
        """Return lines of text for sent (`tx`) or received (`rx`) bytes."""
        spelling = self._spellings[way]
        return [f"{way} {line}" for line in (spelling.spell(data) if spelling else [data.hex(" ")])]


def as_one_frame(data: bytes) -> list[bytes]:
    """Return the bytes as one frame, for a line where each write is one command."""
    return [data]


def describe_command(asked: Velocity, sent: Velocity) -> str:
    """Describe a command: the received one, and the one sent to the body."""
    return f"command {_speeds(asked)} -> sent {_speeds(sent)}"


def _speeds(velocity: Velocity) -> str:
    return (
        f"linear_x {velocity.linear_x:.4f} m/s, linear_y {velocity.linear_y:.4f} m/s, "
        f"angular_z {velocity.angular_z:.4f} rad/s"
    )


def _line(data: bytearray, text: str) -> str:
    return f"{data.hex(' ')}  {text}"
