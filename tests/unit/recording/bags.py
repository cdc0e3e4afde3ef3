"""Recordings for tests, made without a robot."""

import itertools
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.bus.headers import header_of
from gigabrain_zenoh.bus.listening import topic_of
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.recording.bag_reader import Bag
from gigabrain_zenoh.recording.bag_writer import BagWriter, ReceivedMessage
from gigabrain_zenoh.recording.recorder import Recorder, Status

QUICK = RecorderConfig(viewers=False, flush_s=0.05, keep_free_mb=0)
BEGIN_NS = 1_767_225_600_000_000_000


def state(seq: int, boot: int = 7) -> bytes:
    """Return an encoded RobotState; its speed is a hundredth of its number."""
    message = RobotState(
        stamp_ns=BEGIN_NS + seq * 20_000_000,
        seq=seq,
        boot=boot,
        tick=seq,
        basis=seq,
        robot_type="mock",
        pose=Pose(x=seq * 0.01, y=0.0, yaw=0.0),
        velocity=Velocity(linear_x=seq * 0.01),
    )
    return msgspec.msgpack.encode(message)


def scan(seq: int) -> bytes:
    """Return an encoded LaserScan of 360 random beams; the number is the seed."""
    ranges = ranges_bytes(np.random.default_rng(seq).uniform(0.2, 3.4, 360))
    message = LaserScan(
        seq=seq, boot=7, tick=seq, basis=seq,
        angle_min=0.0, angle_increment=0.01745, range_min=0.1, range_max=3.5, ranges=ranges,
    )  # fmt: skip
    return msgspec.msgpack.encode(message)


def jpeg_head(width: int, height: int) -> bytes:
    """Return the beginning of a JPEG of that size; there are no pixels in it."""
    return b"\xff\xd8\xff\xc0\x00\x11\x08" + struct.pack(">HH", height, width) + bytes(10)


def arrival(at_ns: int, key: str, payload: bytes) -> ReceivedMessage:
    """Return a message as the recorder receives it."""
    topic = topic_of(key)
    kind = topic.type.__name__ if topic else ""
    encoding = f"application/msgpack;gigabrain.{kind}"
    return ReceivedMessage(BEGIN_NS + at_ns, key, encoding, payload, header_of(payload))


def drive(states: int) -> Iterator[ReceivedMessage]:
    """Yield states at 50 Hz, with a scan after every fifth."""
    scans = itertools.count(1)
    for seq in range(1, states + 1):
        yield arrival(seq * 20_000_000, "robot/state", state(seq))
        if seq % 5 == 0:
            yield arrival(seq * 20_000_000 + 1_000_000, "robot/scan", scan(next(scans)))


def write(
    path: Path, arrivals: Iterator[ReceivedMessage], *, flush_every: int = 12, end: bool = True
) -> int:
    """Write a recording of `arrivals`; return their number."""
    file, count = BagWriter(path, viewers=False, notes={}), 0
    for count, each in enumerate(arrivals, 1):
        file.add(each)
        if count % flush_every == 0:
            file.flush()
    if end:
        file.finish()
    else:
        file.flush()
    file.close()
    return count


def seqs(path: Path, key: str = "robot/state") -> list[int]:
    """Return the numbers of the readable messages on `key`."""
    return [sample.header.seq for sample in Bag(path) if sample.key == key]


def kept(*paths: Path) -> Counter[str]:
    """Count the readable messages of some files, by key."""
    return Counter(sample.key for path in paths for sample in Bag(path))


def wait(recorder: Recorder, condition: Callable[[Status], bool]) -> None:
    """Wait until the status of the recorder fulfils a condition."""
    for _ in range(6000):
        if condition(recorder.status()):
            return
        time.sleep(0.01)
    raise AssertionError(recorder.status())
