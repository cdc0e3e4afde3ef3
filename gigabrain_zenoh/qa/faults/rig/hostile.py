"""Hostile messages: replaced values, whole payloads, and an open gate to feed them to."""

import json
import math
import random
from collections.abc import Iterator
from typing import Any

import msgspec

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import SERVICES, TOPICS
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


def hostile_values(message: type[Message], seed: int = 0) -> Iterator[dict[str, Any]]:
    """Yield, without end, the example of `message` as a plain map with one value replaced.

    Most are no longer valid, but some are: -0.0 is a number, and a name may be empty.
    """
    chance, whole = random.Random(seed), as_map(message)
    paths = [path for path, _ in leaves(whole)]
    while True:
        bad = chance.choice(NUMBERS if chance.random() < 0.7 else OTHERS)
        yield replaced(whole, chance.choice(paths), bad) if paths else {"x": bad}


def hostile_payloads(message: type[Message], seed: int = 0) -> Iterator[bytes]:
    """Yield, without end, bytes of every hostile kind, none of which is a valid `message`."""
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
    """Return the codec with which the bus would decode `message`."""
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


BOOT, COMMANDER = 7, "script"
FIRST_TICKS = 30  # until the gate may be released, and is calm


class OpenGate:
    """An open gate, fed event by event: a million events take a minute."""

    def __init__(self, body: BodyDescription) -> None:
        self._config = gate.GateConfig(limits=limits_of(body))
        self.state = gate.GateState(boot=BOOT)
        self.tick(FIRST_TICKS)
        self._ask(gate.Release(0))
        self.open()

    def open(self) -> None:
        """Enable the commander, as soon as the gate agrees."""
        while self.state.mode == "stopping":
            self.tick()
        self._ask(gate.Enable(COMMANDER))

    def tick(self, count: int = 1) -> None:
        """Let `count` ticks pass, with a verdict of safety in each."""
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
