"""Faults of a link: their commands, and their effect on the link's bytes."""

import math
import random
from typing import Annotated, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from gigabrain_schemas.base import NonNegative
from gigabrain_zenoh.config.name_words import plain
from gigabrain_zenoh.errors import ConfigError, unknown

Chance = Annotated[float, Meta(ge=0.0, le=1.0)]
Way = Literal["up", "down"]  # towards the target of the proxy, and back

WAYS: tuple[Way, ...] = ("up", "down")
S = TypeVar("S", bound=Struct)


class Chaos(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Faults of one direction of a link. A piece is the bytes of one read."""

    hole: bool = False  # nothing is read from the sender; its bytes arrive when this ends
    delay_ms: NonNegative = 0.0  # of each piece
    jitter_ms: NonNegative = 0.0  # largest random addition to the delay; pieces keep their order
    loss: Chance = 0.0  # per piece: it arrives 200 ms late, as TCP resends it
    bytes_s: NonNegative = 0.0  # limit [bytes/s]; 0 for none
    corrupt: Chance = 0.0  # per byte: one of its bits is flipped
    drop: Chance = 0.0  # per piece: it is lost
    garbage: Chance = 0.0  # per piece: random bytes precede it
    split: Chance = 0.0  # per piece: it arrives in two halves, 2 ms apart
    merge_ms: NonNegative = 0.0  # pieces within this time are forwarded as one


CALM = Chaos()


class ProxyCommand(Struct, frozen=True, kw_only=True):
    """A parsed command line."""

    ways: tuple[Way, ...] = ()
    chaos: Chaos = CALM
    cut: Literal["", "fin", "rst"] = ""  # close all open connections
    unplugged: bool | None = None  # no client can connect; None changes nothing
    figures: bool = False  # print the counters


COMMANDS = ("cut", "cut=rst", "unplug", "plug", "figures", "off", *WAYS)


def parse_command(line: str) -> ProxyCommand:
    """Parse `[up|down] FAULT[=VALUE] ...`, `cut`, `unplug`, `plug`, `figures` or `off`.

    Raises ConfigError, which lists the valid words.
    """
    words = line.split()
    if words in (["cut"], ["cut=fin"], ["cut=rst"]):
        return ProxyCommand(cut="rst" if words == ["cut=rst"] else "fin")
    if words in (["unplug"], ["plug"]):
        return ProxyCommand(unplugged=words == ["unplug"])
    if words == ["figures"]:
        return ProxyCommand(figures=True)
    ways = tuple(way for way in WAYS if words[:1] == [way])
    return ProxyCommand(ways=ways or WAYS, chaos=parse_struct(words[len(ways) :], Chaos, COMMANDS))


def parse_struct(words: list[str], kind: type[S], others: tuple[str, ...] = ()) -> S:
    """Return `NAME[=VALUE] ...` as a `kind`; `off` is its default. Raises ConfigError."""
    values = dict(word.partition("=")[::2] for word in words if word != "off")
    for name in values:
        if name not in kind.__struct_fields__:
            raise unknown("fault", name, [*kind.__struct_fields__, *others])
    try:
        return msgspec.convert({n: v or "true" for n, v in values.items()}, kind, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{' '.join(words)!r}: {plain(error)}") from None


MAX_GARBAGE_BYTES = 64
RESEND_S = 0.2  # least time until Linux resends a lost segment
HALVES_S = 0.002  # between the halves of a piece
MAX_INTACT_BYTES = 1e15
THROTTLED_PIECE_S = 0.02  # duration of a piece on a throttled line


class WayCounters(Struct, kw_only=True):
    """Counters of one direction of a link, since the start of the proxy."""

    taken: int = 0  # bytes from the sender
    handed_on: int = 0  # bytes to the receiver, with damage and garbage
    waiting: int = 0  # bytes received and not yet forwarded
    flipped: int = 0  # bits
    dropped: int = 0  # bytes
    garbage: int = 0  # bytes
    late: int = 0  # resent pieces


class LinkDamage:
    """Damages one direction of one connection, and sets the arrival times of its pieces."""

    def __init__(self, chance: random.Random, figures: WayCounters) -> None:
        self._chance, self.figures = chance, figures
        self._newest_s = 0.0  # arrival time of the newest piece; later ones keep the order
        self._free_s = 0.0  # time at which a throttled line is free
        self._rate = 0.0  # chance of a flipped bit for which `_clean` was drawn
        self._clean = 0  # bytes until the next flipped bit

    def damaged(self, data: bytes, chaos: Chaos, now_s: float) -> list[tuple[float, bytes]]:
        """Return the damaged pieces of `data` from time `now_s`: (arrival time [s], piece)."""
        self.figures.taken += len(data)
        if self._happens(chaos.drop):
            self.figures.dropped += len(data)
            return []
        if self._happens(chaos.garbage):
            noise = self._chance.randbytes(self._chance.randint(1, MAX_GARBAGE_BYTES))
            self.figures.garbage += len(noise)
            data = noise + data
        data = self._flipped(data, chaos.corrupt)
        arrival_s = now_s + (chaos.delay_ms + self._chance.random() * chaos.jitter_ms) / 1e3
        if self._happens(chaos.loss):
            self.figures.late += 1
            arrival_s += RESEND_S
        half = len(data) // 2
        if half and self._happens(chaos.split):
            return [
                *self._sent(data[:half], chaos, arrival_s),
                *self._sent(data[half:], chaos, arrival_s + HALVES_S),
            ]
        return self._sent(data, chaos, arrival_s)

    def _sent(self, data: bytes, chaos: Chaos, arrival_s: float) -> list[tuple[float, bytes]]:
        """Split and delay `data` by the line's rate and by merging; pieces keep their order."""
        size = max(1, int(chaos.bytes_s * THROTTLED_PIECE_S)) if chaos.bytes_s else len(data)
        pieces = []
        for start in range(0, len(data), size):
            piece = data[start : start + size]
            due_s = max(arrival_s, self._newest_s)
            if chaos.bytes_s:
                self._free_s = max(due_s, self._free_s) + len(piece) / chaos.bytes_s
                due_s = self._free_s
            if chaos.merge_ms:
                slot_s = chaos.merge_ms / 1e3
                due_s = max(due_s, math.ceil(due_s / slot_s) * slot_s)
            self._newest_s = due_s
            pieces.append((due_s, piece))
        return pieces

    def _flipped(self, data: bytes, rate: float) -> bytes:
        if rate != self._rate:
            self._rate, self._clean = rate, self._draw_intact(rate)
        if not rate:
            return data
        noisy = bytearray(data)
        while self._clean < len(noisy):
            noisy[self._clean] ^= 1 << self._chance.randrange(8)
            self.figures.flipped += 1
            self._clean += 1 + self._draw_intact(rate)
        self._clean -= len(noisy)
        return bytes(noisy)

    def _draw_intact(self, rate: float) -> int:
        """Return the number of intact bytes before the next damaged one."""
        if rate in (0.0, 1.0):
            return 0
        sample = 1.0 - self._chance.random()  # in (0, 1]
        return int(min(MAX_INTACT_BYTES, math.log(sample) / math.log1p(-rate)))

    def _happens(self, chance: float) -> bool:
        return chance > 0 and self._chance.random() < chance
