"""What must hold for every payload that the bus may be handed."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_schemas.topics import messages
from gigabrain_zenoh.codec import MAX_ERROR_CHARS
from gigabrain_zenoh.qa.faults.hostile import codec_of, hostile_payloads, leaves
from tests.fuzz.harness import split

CODECS = {message.__name__: codec_of(message) for message in messages()}
NAMES = sorted(CODECS)


def check(data: bytes) -> None:
    """Refused with a sentence, or a message that is finite, means the same again, and is usable."""
    name, payload = split(data, NAMES)
    codec = CODECS[name]
    try:
        message = codec.decode(payload)
    except ValueError as error:
        told(str(error))
        return
    assert len(payload) <= codec.max_bytes
    assert type(message).__name__ == name
    finite(message)
    for encode in (msgspec.msgpack.encode, msgspec.json.encode):
        again = encode(message)
        if len(again) <= codec.max_bytes:  # JSON may need more room than MessagePack
            assert codec.decode(again) == message
    used(message)


def told(complaint: str) -> None:
    """A sentence, and a short one: it quotes the sender."""
    assert 0 < len(complaint) <= MAX_ERROR_CHARS


def finite(message: Message) -> None:
    """No number in it is anything else."""
    plain: Any = msgspec.msgpack.decode(msgspec.msgpack.encode(message))
    assert all(math.isfinite(value) for _, value in leaves(plain) if isinstance(value, float))


def used(message: Message) -> None:
    """Its arrays can be looked at."""
    if isinstance(message, LaserScan):
        assert len(message.ranges_m) > 0
    elif isinstance(message, OccupancyGrid):
        assert message.array().shape == (message.height, message.width)
    elif isinstance(message, Image) and message.encoding != "jpeg":
        assert message.array().shape[:2] == (message.height, message.width)


def seeds() -> Iterator[bytes]:
    """Every example both ways, and a little of what is hostile."""
    for name in NAMES:
        head = f"{name}\n".encode()
        yield head + msgspec.msgpack.encode(EXAMPLES[name])
        yield head + msgspec.json.encode(EXAMPLES[name])
        for payload in itertools.islice(hostile_payloads(type(EXAMPLES[name]), 1), 20):
            if len(payload) < 1000:
                yield head + payload
