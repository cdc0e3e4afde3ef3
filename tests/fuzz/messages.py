"""Fuzz checks of the payloads of the bus, for every type of message."""

import itertools
import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.base import Message, Pose
from gigabrain_schemas.body import Camera
from gigabrain_schemas.brain import OccupancyGrid, WorldModel
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_schemas.topics import messages
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.codec import MAX_ERROR_CHARS
from gigabrain_zenoh.decision.contours import ContourFilter
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.navigation.contours import ContourMemory, placed
from gigabrain_zenoh.qa.faults.hostile import codec_of, hostile_payloads, leaves
from gigabrain_zenoh.safety.cameras import MAX_POINTS, Cameras, Picture
from gigabrain_zenoh.testing.samples import WAFFLE, state
from tests.fuzz.harness import split

CODECS = {message.__name__: codec_of(message) for message in messages()}
NAMES = sorted(CODECS)
HERE = Pose(x=0.0, y=0.0, yaw=0.0)
MAX_PIXELS = 400  # of a side


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
    elif isinstance(message, DepthImage):
        looked_at(message)
    elif isinstance(message, WorldModel):
        planned_by(message)


def looked_at(picture: DepthImage) -> None:
    """It is unpacked or refused, and safety bears it from a camera of its size."""
    for unpack, shrunk in ((picture.array, 1), (picture.quarter, 2)):
        try:
            shape = unpack().shape
        except ValueError as error:
            told(str(error))
        else:
            assert shape == (picture.height // shrunk, picture.width // shrunk)
    if max(picture.width, picture.height) > MAX_PIXELS:
        return  # such a camera takes as long as it takes
    camera = Camera(name="front", depth=True, width=picture.width, height=picture.height, z=0.1)
    pictures = {"front": Picture(image=replace(picture, basis=1))}
    history = PoseHistory().then(state(1))
    seen = Cameras().then(replace(WAFFLE, cameras=(camera,)), pictures, state(1), history)
    assert seen.pictures == 1
    assert len(seen.obstacles(HERE)) <= MAX_POINTS


def planned_by(world: WorldModel) -> None:
    """Assert that its contours can be merged and remembered, and that all points are finite."""
    merged = ContourFilter(Counter()).merged(world, WAFFLE)
    assert len(merged.contours) <= len(world.contours)
    memory = ContourMemory()
    memory.update(1, HERE, WAFFLE, placed(merged.contours, HERE))
    assert np.isfinite(memory.points).all()


def seeds() -> Iterator[bytes]:
    """Every example both ways, and a little of what is hostile."""
    for name in NAMES:
        head = f"{name}\n".encode()
        yield head + msgspec.msgpack.encode(EXAMPLES[name])
        yield head + msgspec.json.encode(EXAMPLES[name])
        for payload in itertools.islice(hostile_payloads(type(EXAMPLES[name]), 1), 20):
            if len(payload) < 1000:
                yield head + payload
