"""What may be wrong with a link, and how people write it down."""

from typing import Annotated, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from gigabrain_schemas.base import NonNegative
from gigabrain_zenoh.errors import ConfigError, unknown

Chance = Annotated[float, Meta(ge=0.0, le=1.0)]
Way = Literal["up", "down"]  # towards what the proxy stands in front of, and back from it

WAYS: tuple[Way, ...] = ("up", "down")
S = TypeVar("S", bound=Struct)


class Chaos(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is wrong with one way of a link at present. A piece is what was read at once."""

    hole: bool = False  # nothing is taken from the sender; what it sent comes when this ends
    delay_ms: NonNegative = 0.0  # later than it came
    jitter_ms: NonNegative = 0.0  # up to so much later still; pieces keep their order
    loss: Chance = 0.0  # of each piece to be lost and come 200 ms late, as TCP sends it again
    bytes_s: NonNegative = 0.0  # [bytes/s] at most; 0 for no limit
    corrupt: Chance = 0.0  # of each byte to arrive with one bit flipped
    drop: Chance = 0.0  # of each piece to vanish
    garbage: Chance = 0.0  # of each piece to be preceded by random bytes
    split: Chance = 0.0  # of each piece to come in two halves, 2 ms apart
    merge_ms: NonNegative = 0.0  # what comes within so long is handed on as one piece


CALM = Chaos()


class Told(Struct, frozen=True, kw_only=True):
    """What a line of words asks of a proxy."""

    ways: tuple[Way, ...] = ()
    chaos: Chaos = CALM
    cut: Literal["", "fin", "rst"] = ""  # end what is open now
    unplugged: bool | None = None  # nobody can connect; None leaves that as it is
    figures: bool = False  # say how it goes


COMMANDS = ("cut", "cut=rst", "unplug", "plug", "figures", "off", *WAYS)


def told(line: str) -> Told:
    """What `[up|down] FAULT[=VALUE] ...`, `cut`, `unplug`, `plug`, `figures` or `off` asks for.

    Raises ConfigError naming what there is.
    """
    words = line.split()
    if words in (["cut"], ["cut=fin"], ["cut=rst"]):
        return Told(cut="rst" if words == ["cut=rst"] else "fin")
    if words in (["unplug"], ["plug"]):
        return Told(unplugged=words == ["unplug"])
    if words == ["figures"]:
        return Told(figures=True)
    ways = tuple(way for way in WAYS if words[:1] == [way])
    return Told(ways=ways or WAYS, chaos=of_words(words[len(ways) :], Chaos, COMMANDS))


def of_words(words: list[str], kind: type[S], others: tuple[str, ...] = ()) -> S:
    """`NAME[=VALUE] ...` as a `kind`; nothing, or `off`, is its default. Raises ConfigError."""
    values = dict(word.partition("=")[::2] for word in words if word != "off")
    for name in values:
        if name not in kind.__struct_fields__:
            raise unknown("fault", name, [*kind.__struct_fields__, *others])
    try:
        return msgspec.convert({n: v or "true" for n, v in values.items()}, kind, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{' '.join(words)!r}: {error}") from None
