"""Fuzz checks of the bytes on a body's or a lidar's line, serial or TCP."""

import functools
import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gigabrain_drivers import LIDARS
from gigabrain_drivers.bodies.alpha import protocol as alpha
from gigabrain_drivers.bodies.alpha.driver import AlphaDriver
from gigabrain_drivers.bodies.line import protocol as line
from gigabrain_drivers.bodies.line.driver import LineDriver
from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.bodies.turtlebot3.driver import OpenCrDriver
from gigabrain_drivers.driver.catalog import load_link
from gigabrain_drivers.driver.process import clipped
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.lidars.base import source_class
from gigabrain_drivers.lidars.ld import protocol as ld
from gigabrain_drivers.lidars.lds import lds01, lds03
from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_schemas.base import Message
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.qa.faults.hostile import codec_of
from tests.fuzz.harness import split
from tests.fuzz.line_samples import samples
from tests.fuzz.messages import finite

CHUNK = 64  # bytes that come at once
CHUNK_NS = 20_000_000
REAL = Run(folder=Path(), link="real")
LIDAR = Lidar(beams=360, rate_hz=10, range_min=0.12, range_max=3.5)


def driver_of(name: str) -> Any:
    """A driver that is never opened: its bytes are handed to it here."""
    robot, driver, options, _ = loaded(name)
    return driver(robot, options, REAL)


@functools.cache
def loaded(name: str) -> Any:
    """A robot's file, read once."""
    return load_link(name, REAL)


@dataclass(frozen=True)
class Protocol:
    """A decoder, how to write again what it finds, and the most bytes that it may keep."""

    make: Callable[[], Any]
    describe: Callable[[Any], str]
    most: int
    again: Callable[[Any], bytes] | None = None
    kept: str = "_buffer"


CUSTOM = driver_of("mycustombot").options


def line_again(values: dict[str, float]) -> bytes:
    return CUSTOM.state_templates()[0].encode(values)


PROTOCOLS = {
    "alpha": Protocol(alpha.AlphaDecoder, alpha.describe, 400, alpha.encode),
    "dynamixel": Protocol(opencr.DynamixelDecoder, opencr.describe, 1100, opencr.encode),
    "ld": Protocol(ld.LdDecoder, ld.describe, 47, ld.encode),
    "lds01": Protocol(lds01.Lds01Decoder, lds01.describe, 44),
    "lds03": Protocol(lds03.Lds03Decoder, lds03.describe, 800),
    "line": Protocol(
        lambda: line.LineDecoder(CUSTOM.state_templates()), line.describe, 256, line_again, "_rest"
    ),
    "rplidar": Protocol(rplidar.RplidarDecoder, rplidar.describe, 420),
    "rplidar request": Protocol(rplidar.RequestDecoder, rplidar.describe_request, 260),
}


def protocol(name: str, data: bytes) -> None:
    """The same however the bytes are cut; what is found means the same when written again."""
    its = PROTOCOLS[name]
    whole, cut = its.make(), its.make()
    found = whole.feed(data)
    pieces = [item for at in range(len(data)) for item in cut.feed(data[at : at + 1])]
    assert pieces == found
    assert len(getattr(whole, its.kept)) <= its.most
    for item in found:
        assert its.describe(item)
        if its.again and len(its.again(item)) <= its.most:
            (same,) = its.make().feed(its.again(item))
            assert close(same, item), (same, item)


def close(one: Any, other: Any) -> bool:
    """Equal; numbers of a text line to the digits that it has."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(
            math.isclose(one[name], other[name], rel_tol=1e-9, abs_tol=1e-9) for name in one
        )
    return bool(one == other)


def source(name: str, data: bytes) -> None:
    """The scans of a lidar are valid messages, whatever it sends."""
    kind = source_class(name)
    made: Any = kind(kind.Options(driver=name, port="/dev/null"), LIDAR, FakeClock())
    made.emit = valid
    made.connected()
    for at in range(0, len(data), CHUNK):
        made.clock._now += CHUNK_NS
        made._on_bytes(data[at : at + CHUNK])


def body(name: str, data: bytes) -> None:
    """The state and the sensor data of a body are valid messages, whatever it sends."""
    driver = driver_of(name)
    driver.emit = lambda _topic, message: valid(message)
    for at in range(0, len(data), CHUNK):
        driver.link.on_bytes(data[at : at + CHUNK])
        valid(said(driver))


def sealed(name: str, data: bytes) -> None:
    """As `body`, with right checksums round all of it: what comes is well-formed nonsense."""
    frames = SEALS[name](data)
    driver = driver_of(name)
    driver.emit = lambda _topic, message: valid(message)
    for frame in frames:
        if isinstance(driver, OpenCrDriver):
            driver._take(opencr.decode_readings(frame))
        else:
            driver.link.on_bytes(frame)
        valid(said(driver))


def said(driver: Any) -> Message:
    """The state that a driver reports. OpenCR would ask its board first."""
    if isinstance(driver, OpenCrDriver):
        return driver._state
    assert isinstance(driver, (AlphaDriver, LineDriver))
    reading = driver.read_state()  # which never waits
    try:
        reading.send(None)
    except StopIteration as done:
        state: Message = done.value
        return state
    raise AssertionError("it waits")


def valid(message: Message) -> None:
    """Assert that a receiver could decode the message, and that its numbers are finite."""
    finite(codec_of(type(message)).decode(encode(clipped(message))))


def in_pieces(data: bytes, size: int) -> list[bytes]:
    """All whole pieces of `size`."""
    return [data[at : at + size] for at in range(0, len(data) - size + 1, size)]


def alpha_states(data: bytes) -> list[bytes]:
    size = alpha._STATE.size
    return [
        alpha.encode(alpha.AlphaFrame(alpha.STATE, number + 1, piece))
        for number, piece in enumerate(in_pieces(data, size))
    ]


def line_states(data: bytes) -> list[bytes]:
    template = CUSTOM.state_templates()[0]
    names, frames = [field.name for field in template.fields], []
    for piece in in_pieces(data, 4 * len(names)):
        values = struct.unpack(f"<{len(names)}f", piece)
        numbers = {n: v if math.isfinite(v) else 0.0 for n, v in zip(names, values, strict=True)}
        frames.append(template.encode({**numbers, "flags": abs(numbers["flags"]) % 2**32}))
    return frames


SEALS: dict[str, Callable[[bytes], Sequence[bytes]]] = {
    "alpha": alpha_states,
    "mycustombot": line_states,
    "turtlebot3_waffle": lambda data: in_pieces(data, opencr.LENGTH),
}
BODIES = ("alpha", "mycustombot")

TARGETS: dict[str, Callable[[bytes], None]] = {
    **{f"protocol {name}": (lambda data, name=name: protocol(name, data)) for name in PROTOCOLS},
    **{f"source {name}": (lambda data, name=name: source(name, data)) for name in LIDARS},
    **{f"body {name}": (lambda data, name=name: body(name, data)) for name in BODIES},
    **{f"sealed {name}": (lambda data, name=name: sealed(name, data)) for name in SEALS},
}  # fmt: skip
NAMES = sorted(TARGETS)


def check(data: bytes) -> None:
    """By the target that the first line names."""
    name, rest = split(data, NAMES)
    TARGETS[name](rest)


SENT_BY = {"lds02": "ld", "ld06": "ld", "ld19": "ld", "mycustombot": "line"}


def seeds() -> Iterator[bytes]:
    """Each target with what its device sends."""
    sent = samples(CUSTOM.state_templates()[0])
    for name in NAMES:
        kind, _, its = name.partition(" ")
        if kind == "sealed":
            yield f"{name}\n".encode() + bytes(800)
            yield f"{name}\n".encode() + bytes(range(256)) * 4
            continue
        for device, data in sent.items():
            if device.startswith(SENT_BY.get(its, its)):
                yield f"{name}\n".encode() + data
