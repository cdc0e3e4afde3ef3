"""Hostile messages: replaced values, whole payloads, and an open gate to feed them to."""

import functools
import json
import math
import random
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
from msgspec import inspect

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import (
    ARM_MODEL,
    BODY,
    CMD_VEL,
    DESCRIBE,
    ESTOP_TOPIC,
    IMU,
    INTENT,
    MAP,
    PARAM,
    POSE,
    SAFETY,
    SCAN,
    SERVICES,
    SIM_SCENE,
    STATE,
    TOPICS,
    WORLD,
    Service,
    Topic,
)
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.qa.judging import Failed

Path = tuple[str | int, ...]  # fields and indices on the way to a value

NUMBERS: tuple[Any, ...] = (
    math.nan, -math.nan, math.inf, -math.inf, 1e308, -1e308, 1e300, 1e39, 3.5e38, 1e10, -1e10,
    5e-324, -0.0, 0, -1, 1.5, 2**31, -(2**31) - 1, 2**53 + 1, 2**63 - 1, 2**63, 2**64 - 1, -(2**63),
)  # fmt: skip
OTHERS: tuple[Any, ...] = (
    True, False, None, "", "0.3", "nan", b"", b"\x00" * 8, [], [0.1], {}, {"linear_x": 0.1},
    [[[]]], "\u202e\x1b[2J", "x" * 70, "x" * 501,
    msgspec.msgpack.Ext(5, b"x"), msgspec.msgpack.Ext(-1, b"\xff" * 12),
)  # fmt: skip
WHOLE = (
    b"", b" ", b"\xc1", b"\xc0", b"\x80", b"\x90", b"\x00" * 64, b"{", b"}", b"[]", b"null", b"0.3",
    b"[" * 5000, b'{"a":' * 5000, b"\x91" * 5000, b"\x81\xa1a" * 5000,
    b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff", b"\xd7\xff" + b"\xff" * 8, b"\xc7\x0c\xff" + b"\xff" * 12,
    b"\x81\x01\x02", b"\x81\xa1\xff\x01", b"\xef\xbb\xbf{}", "{}".encode("utf-16"),
    b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
    b'{"__proto__": {}}', b'{"linear_x": NaN}', b'{"linear_x": 1e999}',
    b'{"linear_x": ' + b"9" * 400 + b"}", b'{"source": "\\ud800"}',
)  # fmt: skip
TRAILING = (b"\x00", b"\xc0", b"{}", b"\n", b"x" * 100)
LONGEST_NOISE = 400  # bytes


BOOT, COMMANDER = 7, "script"
FIRST_TICKS = 30  # before the gate may be released
TINY, HUGE = 5e-324, 1e300
PARTNERS = 3  # number of other extremes that each valid extreme is paired with
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
    (ARM_MODEL, "mjcf empty"), (SIM_SCENE, "sizes inf"),
)  # fmt: skip
FLOATS = {"zeros": 0.0, "nan": math.nan, "inf": math.inf, "largest": 3.4e38}
NAMES = {PARAM.key: "decision", DESCRIBE.key: "safety"}  # process to ask, where there are many
STRANGER = "stranger"  # name on a topic that has many
MAPS = (  # cells along x and y, and their value
    (2800, 2800, 0), (2800, 2800, 255), (2800, 2800, 100), (100_000, 80, 0), (80, 100_000, 0),
    (1, 1, 0), (1, 1, 100), (0, 0, 0), (100, 100, 0), (100, 100, 255),
)  # fmt: skip
Change = tuple[Path, Any]


def hostile_values(message: type[Message], seed: int = 0) -> Iterator[dict[str, Any]]:
    """Yield endlessly the example of `message` as a plain map with one replaced value.

    Most are invalid, but some are valid: -0.0 is a number, and a name may be empty.
    """
    chance, whole = random.Random(seed), as_map(message)
    paths = [path for path, _ in leaves(whole)]
    while True:
        bad = chance.choice(NUMBERS if chance.random() < 0.7 else OTHERS)
        yield replaced(whole, chance.choice(paths), bad) if paths else {"x": bad}


def hostile_payloads(message: type[Message], seed: int = 0) -> Iterator[bytes]:
    """Yield endlessly bytes of every hostile kind; none is a valid `message`."""
    chance = random.Random(seed)
    values, codec = hostile_values(message, seed), codec_of(message)
    while True:
        payload = _payload(message, next(values), codec.max_bytes, chance)
        try:
            codec.decode(payload)
        except ValueError:
            yield payload


def _payload(
    message: type[Message], damaged: dict[str, Any], max_bytes: int, chance: random.Random
) -> bytes:
    example = EXAMPLES[message.__name__]
    encode = chance.choice((msgspec.msgpack.encode, msgspec.json.encode))
    good = encode(example)
    match chance.randrange(16):
        case 0:
            return chance.choice(WHOLE)
        case 1:
            return chance.randbytes(chance.randint(1, LONGEST_NOISE))
        case 2:
            return good[: chance.randrange(len(good))]
        case 3:
            return good + chance.choice(TRAILING)
        case 4:
            return encode({**as_map(message), chance.choice(("linear_xx", "", "x" * 500)): 1.0})
        case 5:
            return encode(_without_one(as_map(message), chance))
        case 6:
            return good[:1] + chance.randbytes(8) + good[1:]
        case 7 if chance.random() < 0.01:  # rarely: these are large
            return good * (1 + max_bytes // len(good))
        case _:
            return _encoded(damaged, chance)


def _encoded(damaged: dict[str, Any], chance: random.Random) -> bytes:
    """Encode as MessagePack, or as other JSON encoders do: with NaN and Infinity."""
    if chance.random() < 0.3:
        return json.dumps(damaged, default=repr).encode()
    return msgspec.msgpack.encode(damaged)


def _without_one(whole: dict[str, Any], chance: random.Random) -> dict[str, Any]:
    if not whole:
        return {"missing": None}
    gone = chance.choice(list(whole))
    return {name: value for name, value in whole.items() if name != gone}


def codec_of(message: type[Message]) -> Codec[Any]:
    """Return the codec of `message` on the bus."""
    limits: dict[type[Message], int] = {}
    for service in SERVICES:
        limits[service.request] = limits[service.reply] = service.max_bytes
    limits |= {topic.type: topic.max_bytes for topic in TOPICS}
    return Codec(message, limits[message])


def as_map(message: type[Message]) -> dict[str, Any]:
    """Return the example of `message` as plain maps, lists and values."""
    plain: dict[str, Any] = msgspec.msgpack.decode(
        msgspec.msgpack.encode(EXAMPLES[message.__name__])
    )
    return plain


def leaves(value: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield every value that is neither map nor list, with its path."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, (*path, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from leaves(inner, (*path, index))
    else:
        yield path, value


def replaced(plain: Any, path: Path, value: Any) -> Any:
    """Return a copy of `plain` with `value` at `path`."""
    if not path:
        return value
    copy: Any = dict(plain) if isinstance(plain, dict) else list(plain)
    copy[path[0]] = replaced(plain[path[0]], path[1:], value)
    return copy


class OpenGate:
    """An open gate, fed event by event: a million events take a minute."""

    def __init__(self, body: BodyDescription) -> None:
        self._config = gate.GateConfig(limits=limits_of(body))
        self.state = gate.GateState(boot=BOOT)
        self.tick(FIRST_TICKS)
        self._ask(gate.Release(0))
        self.open()

    def open(self) -> None:
        """Enable the commander as soon as the gate allows it."""
        while self.state.mode == "stopping":
            self.tick()
        self._ask(gate.Enable(COMMANDER))

    def tick(self, count: int = 1) -> None:
        """Advance by `count` ticks, with a verdict of safety in each."""
        for _ in range(count):
            self.feed(gate.Tick(Velocity()))
            verdict = SafetyState(verdict="ok", boot=self.state.boot, tick=self.state.tick)
            self.feed(gate.Safety(verdict))

    def command(self, linear_x: float, seq: int, angular_z: float = 0.0) -> CmdVel:
        """Return a command that echoes the newest tick."""
        return CmdVel(
            linear_x=linear_x,
            angular_z=angular_z,
            source=COMMANDER,
            boot=self.state.boot,
            tick=self.state.tick,
            seq=seq,
        )

    def feed(self, event: gate.Event) -> gate.Outcome:
        """Feed one event; returns the outcome."""
        self.state, outcome = gate.step(self._config, self.state, event)
        return outcome

    def _ask(self, event: gate.Event) -> None:
        outcome = self.feed(event)
        if not outcome.ok:
            raise Failed(f"the gate does not open: {outcome.text}")


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
        """`topic` if it is published, `service` if it is asked."""
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
    """Return KNOWN ones, and others that decode, evenly spread; at most CHOSEN."""
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
    return (*TOPICS, ESTOP_TOPIC, *SERVICES)


def _evenly(all_of: list[ExtremeMessage], count: int) -> list[ExtremeMessage]:
    step = max(1.0, len(all_of) / count)
    return [all_of[int(n * step)] for n in range(min(count, len(all_of)))]


def _singles(to: Topic[Any] | Service[Any, Any]) -> Iterator[tuple[str, Change]]:
    message = message_of(to)
    for path, name, value in _places(inspect.type_info(message), as_map(message), ()):
        yield f"{'.'.join(map(str, path))} {name}", (path, value)


def _maps() -> Iterator[tuple[str, tuple[Change, ...]]]:
    """Yield maps with consistent size and cells, for the smallest and the largest cells."""
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
    """Pair each extreme that decodes with some others of the same message; deterministic."""
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
    if isinstance(of, inspect.Metadata):  # notes for schemas
        of = of.type
    if isinstance(of, inspect.Metadata):  # notes for JSON Schema, as of arrays
        of = of.type
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
    """Yield the types within a type, and their keys in `value`; only the first of repeated ones."""
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
    """Yield equally many bytes of extreme floats, and as many of the present bytes as allowed."""
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
