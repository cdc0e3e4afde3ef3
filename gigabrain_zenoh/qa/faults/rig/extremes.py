"""Every field of every topic and service at the extremes of its type, singly and in pairs.

The messages are the same in every run, in the same order. A number names the same one until the
schemas change.
"""

import functools
import math
import random
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
from msgspec import inspect

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
    DESCRIBE,
    ESTOP_SAID,
    IMU,
    INTENT,
    MAP,
    PARAM,
    POSE,
    SAFETY,
    SCAN,
    SERVICES,
    STATE,
    TOPICS,
    WORLD,
    Service,
    Topic,
)
from gigabrain_zenoh.qa.faults.rig.hostile import Path, as_map, codec_of, replaced

TINY, HUGE = 5e-324, 1e300
PARTNERS = 3  # other extremes of the same message that each valid one is paired with
WORST = (BODY, MAP, SCAN, STATE, WORLD, POSE, CMD_VEL, INTENT, SAFETY, IMU)  # what a body moves by
CHOSEN = 200  # messages in the suite, and those of them that have once stopped a robot:
KNOWN = (
    (CMD_VEL, "linear_x most"), (CMD_VEL, "tick most"), (CMD_VEL, "seq most"),
    (STATE, "tick most"), (STATE, "boot 1"), (STATE, "velocity.linear_x most"),
    (SCAN, "tick most"), (SCAN, "boot 1"), (SCAN, "ranges nan"), (SCAN, "range_max most"),
    (BODY, "description.footprint.0.0 most"), (BODY, "description.lidar none"),
    (BODY, "description.max_linear_deceleration least"),
    (MAP, "resolution least"), (MAP, "cells empty"), (MAP, "100000 x 80 of 0 at 0.001 m"),
    (MAP, "2800 x 2800 of 100 at 0.05 m"), (MAP, "0 x 0 of 0 at 0.05 m"),
    (MAP, "1 x 1 of 100 at 1 m"), (WORLD, "hits nan"), (WORLD, "hits largest"),
    (WORLD, "obstacles longest"), (WORLD, "tick most"), (POSE, "x most"), (POSE, "tick most"),
    (INTENT, "tick most"), (SAFETY, "tick most"), (IMU, "tick most"),
)  # fmt: skip
FLOATS = {"zeros": 0.0, "nan": math.nan, "inf": math.inf, "largest": 3.4e38}
NAMES = {PARAM.key: "decision", DESCRIBE.key: "safety"}  # process to ask, where there are many
STRANGER = "stranger"  # name on a topic that has many
MAPS = (  # cells along x and y, and their value
    (2800, 2800, 0), (2800, 2800, 255), (2800, 2800, 100), (100_000, 80, 0), (80, 100_000, 0),
    (1, 1, 0), (1, 1, 100), (0, 0, 0), (100, 100, 0), (100, 100, 255),
)  # fmt: skip

Change = tuple[Path, Any]


@dataclass(frozen=True)
class ExtremeMessage:
    """A message that is extreme in one field, or in two."""

    number: int
    to: Topic[Any] | Service[Any, Any]
    what: str  # the fields and their values, in words
    changes: tuple[Change, ...]

    @property
    def key(self) -> str:
        """The key to which it is sent."""
        return self.to.at(NAMES.get(self.to.key, STRANGER))

    @property
    def kind(self) -> Literal["topic", "service"]:
        """Whether it is published or asked."""
        return "topic" if isinstance(self.to, Topic) else "service"

    def payload(self, base: Mapping[str, Any] | None, header: Mapping[str, int]) -> bytes:
        """Encode `base`, or the example, with the `header` and the changes."""
        plain: Any = {**(base or as_map(message_of(self.to))), **header}
        for path, value in self.changes:
            plain = replaced(plain, path, value) if _has(plain, path) else plain
        return msgspec.msgpack.encode(plain)

    def __str__(self) -> str:
        return f"{self.number}: {self.key} {self.what}"


def message_of(to: Topic[Any] | Service[Any, Any]) -> type[Message]:
    """Return the type of a topic's messages, or of a service's requests."""
    found: type[Message] = to.type if isinstance(to, Topic) else to.request
    return found


@functools.cache
def all_extremes() -> tuple[ExtremeMessage, ...]:
    """Return all of them: each extreme alone, whole maps, then pairs of those that decode."""
    found: list[tuple[Any, str, tuple[Change, ...]]]
    found = [(to, what, (change,)) for to in _all() for what, change in _singles(to)]
    found += [(MAP, what, changes) for what, changes in _maps()]
    found += [(to, what, changes) for to in WORST for what, changes in _pairs(to)]
    return tuple(ExtremeMessage(number, *each) for number, each in enumerate(found))


@functools.cache
def chosen_extremes() -> tuple[ExtremeMessage, ...]:
    """Return those that are known, and others that decode, evenly spread; CHOSEN at most."""
    known = [one for one in all_extremes() if (one.to, one.what) in KNOWN]
    numbers = {one.number for one in known}
    valid = [one for one in all_extremes() if one.number not in numbers and decodes(one)]
    worst = [one for one in valid if one.to in WORST]
    others = [one for one in valid if one.to not in WORST]
    half = (CHOSEN - len(known)) // 2
    chosen = [*known, *_evenly(worst, half), *_evenly(others, half)]
    return tuple(sorted(chosen, key=lambda one: one.number))


def decodes(message: ExtremeMessage) -> bool:
    """Return whether the example with these changes is a valid message."""
    try:
        codec_of(message_of(message.to)).decode(message.payload(None, {}))
    except ValueError:
        return False
    return True


def _all() -> tuple[Topic[Any] | Service[Any, Any], ...]:
    return (*TOPICS, ESTOP_SAID, *SERVICES)


def _evenly(all_of: list[ExtremeMessage], count: int) -> list[ExtremeMessage]:
    step = max(1.0, len(all_of) / count)
    return [all_of[int(n * step)] for n in range(min(count, len(all_of)))]


def _singles(to: Topic[Any] | Service[Any, Any]) -> Iterator[tuple[str, Change]]:
    message = message_of(to)
    for path, name, value in _places(inspect.type_info(message), as_map(message), ()):
        yield f"{'.'.join(map(str, path))} {name}", (path, value)


def _maps() -> Iterator[tuple[str, tuple[Change, ...]]]:
    """Yield maps whose size and cells agree, with the least and the largest cells."""
    for width, height, cell in MAPS:
        for resolution in (0.001, 0.05, 1.0):
            yield (
                f"{width} x {height} of {cell} at {resolution:g} m",
                (
                    (("width",), width), (("height",), height), (("resolution",), resolution),
                    (("cells",), bytes([cell]) * (width * height)),
                ),
            )  # fmt: skip


def _pairs(to: Topic[Any]) -> Iterator[tuple[str, tuple[Change, ...]]]:
    """Pair each extreme that decodes with some others of the same message, always the same ones."""
    singles = [
        (what, change)
        for what, change in _singles(to)
        if decodes(ExtremeMessage(0, to, what, (change,)))
    ]
    chance = random.Random(to.key)
    for what, change in singles:
        others = [one for one in singles if one[1][0] != change[0]]
        for other_what, other in chance.sample(others, min(PARTNERS, len(others))):
            yield f"{what}, {other_what}", (change, other)


def _places(of: Any, value: Any, path: Path) -> Iterator[tuple[Path, str, Any]]:
    """Yield the path to every field of `value`, and each of its extremes with a name."""
    if isinstance(of, inspect.UnionType):
        if of.includes_none:
            yield path, "none", None
        chosen = next((one for one in of.types if _fits(one, value)), None)
        if chosen is not None:
            yield from _places(chosen, value, path)
        return
    for name, extreme in _extremes(of, value):
        yield path, name, extreme
    for inner, at in _inside(of, value):
        yield from _places(inner, value[at], (*path, at))


def _inside(of: Any, value: Any) -> Iterator[tuple[Any, str | int]]:
    """Yield the types within a type, and their keys in `value`; only the first of what repeats."""
    if isinstance(of, inspect.StructType):
        for index, field in enumerate(of.fields):
            at: str | int = index if of.array_like else field.encode_name
            if isinstance(value, list) or at in value:
                yield field.type, at
    elif isinstance(of, inspect.TupleType):
        yield from ((one, index) for index, one in enumerate(of.item_types))
    elif isinstance(of, inspect.VarTupleType) and value:
        yield of.item_type, 0
    elif isinstance(of, inspect.DictType) and value:
        yield of.value_type, next(iter(value))


def _extremes(of: Any, value: Any) -> Iterator[tuple[str, Any]]:
    match of:
        case inspect.FloatType():
            least = TINY if of.ge is None else of.ge
            yield from (("0", 0.0), ("tiny", TINY), ("huge", HUGE), ("-huge", -HUGE))
            yield from (("least", least), ("most", of.le), ("nan", math.nan))
        case inspect.IntType():
            yield from (("0", 0), ("1", 1), ("-1", -1), ("huge", 2**64 - 1))
            yield from (("least", of.ge), ("most", of.le))
        case inspect.BoolType():
            yield "other", not value
        case inspect.StrType():
            yield from (("empty", ""), ("longest", "x" * (of.max_length or 0)))
        case inspect.LiteralType():
            yield from ((str(other), other) for other in of.values if other != value)
        case inspect.BytesType():
            yield "empty", b""
            yield from _bytes(value, of.max_length or 0)
        case inspect.VarTupleType():
            yield "empty", []
            if value:
                yield "longest", [value[0]] * (of.max_length or 0)
        case inspect.DictType():
            yield "empty", {}
            if value:
                one = next(iter(value.values()))
                yield "longest", {f"key {n}": one for n in range(of.max_length or 0)}


def _bytes(value: bytes, most: int) -> Iterator[tuple[str, bytes]]:
    """Yield as many bytes of the same floats, and as many as there may be of the present ones."""
    for name, number in FLOATS.items():
        yield name, (struct.pack("<f", number) * (len(value) // 4 + 1))[: len(value)]
    yield "longest", (value * (most // max(1, len(value)) + 1))[:most]


def _fits(of: Any, value: Any) -> bool:
    kinds: tuple[tuple[Any, type | tuple[type, ...]], ...] = (
        (inspect.StructType, (dict, list)), (inspect.DictType, dict), (inspect.VarTupleType, list),
        (inspect.TupleType, list), (inspect.FloatType, float), (inspect.IntType, int),
        (inspect.StrType, str), (inspect.LiteralType, str), (inspect.BytesType, bytes),
        (inspect.BoolType, bool),
    )  # fmt: skip
    return any(isinstance(of, kind) and isinstance(value, held) for kind, held in kinds)


def _has(plain: Any, path: Path) -> bool:
    """Return whether a robot's own message has such a field."""
    for at in path:
        try:
            plain = plain[at]
        except (KeyError, IndexError, TypeError):
            return False
    return True
