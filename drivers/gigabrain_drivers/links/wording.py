"""What goes over a line, in words: each frame's bytes, and beside them what they mean."""

from collections.abc import Callable, Sequence
from typing import Any

from gigabrain_schemas.base import Velocity

LONGEST = 512  # bytes without a frame, after which they are shown as they are

Feed = Callable[[bytes], Sequence[Any]]  # of a protocol's decoder
Describe = Callable[[Any], str]  # a frame of that decoder


class Spelling:
    """One way of a line. The decoder gets byte after byte, so that each frame's own are known.

    A decoder that waits for what follows a frame shows it with those bytes.
    """

    def __init__(self, feed: Feed, describe: Describe) -> None:
        self._feed, self._describe = feed, describe
        self._held = bytearray()

    def spell(self, data: bytes) -> list[str]:
        """A line of text for each frame that `data` completes."""
        told = []
        for value in data:
            self._held.append(value)
            for frame in self._feed(bytes((value,))):
                told.append(_line(self._held, self._describe(frame)))
                self._held.clear()
        if len(self._held) > LONGEST:
            told.append(_line(self._held, "no frame"))
            self._held.clear()
        return told


class Wording:
    """Both ways of a line; without spellings, bytes alone."""

    def __init__(self, sent: Spelling | None = None, received: Spelling | None = None) -> None:
        self._ways = {"tx": sent, "rx": received}

    def lines(self, way: str, data: bytes) -> list[str]:
        """Lines of text for what went `tx` or came `rx`."""
        spelling = self._ways[way]
        return [f"{way} {line}" for line in (spelling.spell(data) if spelling else [data.hex(" ")])]


def whole(data: bytes) -> list[bytes]:
    """The feed of a line on which every byte is a command of its own."""
    return [data]


def of_command(asked: Velocity, sent: Velocity) -> str:
    """A command as it was received, and as it was converted for the body."""
    return f"command {_speeds(asked)} -> sent {_speeds(sent)}"


def _speeds(velocity: Velocity) -> str:
    return (
        f"linear_x {velocity.linear_x:.4f} m/s, linear_y {velocity.linear_y:.4f} m/s, "
        f"angular_z {velocity.angular_z:.4f} rad/s"
    )


def _line(data: bytearray, text: str) -> str:
    return f"{data.hex(' ')}  {text}"
