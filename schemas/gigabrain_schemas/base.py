"""The base of all messages, and the bounded types that they share.

A bound on a float refuses NaN and infinity as well, so a message that decodes holds finite numbers.
"""

from typing import Annotated

import msgspec
from msgspec import Meta

Finite = Annotated[float, Meta(ge=-1e9, le=1e9)]
NonNegative = Annotated[float, Meta(ge=0.0, le=1e9)]
Positive = Annotated[float, Meta(gt=0.0, le=1e9)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Percentage = Annotated[float, Meta(ge=0.0, le=100.0)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Name = Annotated[str, Meta(max_length=64)]
Text = Annotated[str, Meta(max_length=500)]

TICK_NS = 20_000_000  # one tick of the robot's clock is 20 ms of the body's own time


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of a message."""


class Message(Record, frozen=True, kw_only=True):
    """A value sent between processes, in SI units. The bus fills in these five fields."""

    stamp_ns: Count = 0  # Unix time of validity, for people and recordings; never for safety
    seq: Count = 0  # counts what this sender sent on this key
    boot: Count = 0  # which start of the driver the tick belongs to
    tick: Count = 0  # newest tick of the robot's clock that the sender had seen
    basis: Count = 0  # tick of the sensor data that the content rests on; 0 for none


class Pose(Record, frozen=True, kw_only=True):
    """A planar pose (REP-103: x forward, y left, yaw counter-clockwise)."""

    x: Finite  # [m]
    y: Finite  # [m]
    yaw: Finite  # [rad]


class Velocity(Record, frozen=True, kw_only=True):
    """A planar velocity in the body's own frame."""

    linear_x: Finite = 0.0  # [m/s], forward
    linear_y: Finite = 0.0  # [m/s], left
    angular_z: Finite = 0.0  # [rad/s], counter-clockwise


class Cause(Record, frozen=True, kw_only=True):
    """Why the robot is held back."""

    code: Name  # see gigabrain_zenoh.causes
    text: Text  # a sentence for people
    latching: bool = False  # stays until a person releases it
    remedy: Text = ""  # what to do about it, in the imperative
