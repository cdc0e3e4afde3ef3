"""The base of all messages, and the bounded types that they share.

A bound on a float also refuses NaN and infinity, so decoded messages contain finite numbers only.
Every number has bounds of its kind, and every text and list a maximum length. So no message can
exhaust a reader's memory or time.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta

Finite = Annotated[float, Meta(ge=-1e9, le=1e9)]  # figures that do not move a body
NonNegative = Annotated[float, Meta(ge=0.0, le=1e9)]
Positive = Annotated[float, Meta(gt=0.0, le=1e9)]  # settings
Coordinate = Annotated[float, Meta(ge=-1e5, le=1e5)]  # [m], in a map or the odometry
Distance = Annotated[float, Meta(ge=0.0, le=1e5)]  # [m]
Range = Annotated[float, Meta(ge=0.0, le=1000.0)]  # [m], of a sensor
Offset = Annotated[float, Meta(ge=-10.0, le=10.0)]  # [m], on a body
Angle = Annotated[float, Meta(ge=-1e6, le=1e6)]  # [rad]; sums of turns may be large
LinearSpeed = Annotated[float, Meta(ge=-100.0, le=100.0)]  # [m/s]
AngularSpeed = Annotated[float, Meta(ge=-100.0, le=100.0)]  # [rad/s]
SpeedLimit = Annotated[float, Meta(ge=0.001, le=100.0)]  # [m/s] or [rad/s]
SpeedCap = Annotated[float, Meta(ge=0.0, le=100.0)]  # [m/s] or [rad/s]
AccelerationLimit = Annotated[float, Meta(ge=0.001, le=1000.0)]  # [m/s2] or [rad/s2]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Percentage = Annotated[float, Meta(ge=0.0, le=100.0)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Tick = Annotated[int, Meta(ge=0, le=2**38)]  # 170 years; fits 64 bits in nanoseconds
Milliseconds = Annotated[float, Meta(ge=0.0, le=1e12)]  # up to decades of silence
Name = Annotated[str, Meta(max_length=64)]
JointName = Annotated[str, Meta(min_length=1, max_length=64)]
Text = Annotated[str, Meta(max_length=500)]
Key = Annotated[str, Meta(max_length=256)]  # key on the bus, or name of a figure

Shape = tuple[str | int, ...]  # of an array: sizes, or names of sizes that vary


def array_meta(
    max_bytes: int,
    dtype: str | Mapping[str, str | None],
    shape: Shape | Mapping[str, Shape | None],
    unit: str = "",
) -> Meta:
    """Return the bounds of a field that holds an array as bytes, with notes for JSON Schema.

    The notes are `x-dtype` (numpy's name), `x-byte-order`, `x-shape` and `x-unit`. If they depend
    on another field, they are mappings from its values; null means that there is no array.
    """
    notes: dict[str, Any] = {"x-dtype": dtype, "x-byte-order": "little", "x-shape": shape}
    if unit:
        notes["x-unit"] = unit
    return Meta(max_length=max_bytes, extra_json_schema=notes)


TICK_NS = 20_000_000  # one tick of the robot's clock: 20 ms of the body's time
TICK_S, TICK_MS = TICK_NS / 1e9, TICK_NS / 1e6


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of a message."""


class Message(Record, frozen=True, kw_only=True):
    """A value sent between processes, in SI units. The bus fills in these five fields."""

    stamp_ns: Count = 0  # Unix time of validity, for people and recordings; never for safety
    seq: Count = 0  # number of this message, by sender and key
    boot: Count = 0  # random number of the driver's start that the tick belongs to
    tick: Tick = 0  # newest tick of the robot's clock that the sender knew
    basis: Tick = 0  # tick of the sensor data that the content is based on; 0 for none


class Pose(Record, frozen=True, kw_only=True):
    """A planar pose (REP-103: x forward, y left, yaw counter-clockwise)."""

    x: Coordinate  # [m]
    y: Coordinate  # [m]
    yaw: Angle  # [rad]


class Velocity(Record, frozen=True, kw_only=True):
    """A planar velocity in the body's own frame."""

    linear_x: LinearSpeed = 0.0  # [m/s], forward
    linear_y: LinearSpeed = 0.0  # [m/s], left
    angular_z: AngularSpeed = 0.0  # [rad/s], counter-clockwise


class Cause(Record, frozen=True, kw_only=True):
    """A reason why the robot is stopped or slowed."""

    code: Name  # see gigabrain_zenoh.gate.causes
    text: Text  # a sentence for people
    latching: bool = False  # lasts until a person releases it
    remedy: Text = ""  # a request to the person, such as: charge it soon


Causes = Annotated[tuple[Cause, ...], Meta(max_length=64)]
