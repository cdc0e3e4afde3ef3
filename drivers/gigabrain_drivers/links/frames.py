"""What binary protocols share: finding frames in a stream of bytes, whatever else is in it."""

import abc
from typing import ClassVar, Generic, TypeVar

Frame = TypeVar("Frame")


class FrameDecoder(abc.ABC, Generic[Frame]):
    """Finds frames by their header, length and check. `errors` counts stretches that were none.

    A broken frame costs no more than itself: the search goes on right behind its header.
    """

    HEADER: ClassVar[bytes]

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._lost = False  # inside a stretch that was counted
        self.errors = 0

    def clear(self) -> None:
        """Forget what has begun to come in."""
        self._buffer.clear()
        self._lost = False

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that `data` completes, in order."""
        buffer, frames = self._buffer, list[Frame]()
        buffer += data
        while self._at_header():
            size = self._size(buffer)
            if size is None or len(buffer) < size:
                break
            frame = self._frame(bytes(buffer[:size])) if size else None
            if frame is None:
                self._skip(len(self.HEADER))
                continue
            frames.append(frame)
            del buffer[:size]
            self._lost = False
        return frames

    @abc.abstractmethod
    def _size(self, buffer: bytearray) -> int | None:
        """Bytes of the frame that begins here; 0: it cannot be one, None: not known yet."""

    @abc.abstractmethod
    def _frame(self, data: bytes) -> Frame | None:
        """The frame in so many bytes, or None where its check is wrong."""

    def _at_header(self) -> bool:
        """Drop what is before the next header; whether there is one."""
        at = self._buffer.find(self.HEADER)
        if at < 0:
            at = len(self._buffer) - self._begun()
        if at:
            self._skip(at)
        return len(self._buffer) >= len(self.HEADER)

    def _begun(self) -> int:
        """How many bytes at the end may be the beginning of a header."""
        parts = range(len(self.HEADER) - 1, 0, -1)
        return next((n for n in parts if self._buffer.endswith(self.HEADER[:n])), 0)

    def _skip(self, count: int) -> None:
        del self._buffer[:count]
        self.errors += not self._lost
        self._lost = True
