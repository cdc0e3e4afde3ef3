"""What sensors measure."""

from typing import Literal

from gigabrain_schemas.base import Count, Finite, Message, Name, NonNegative, Positive, Record

Vector = tuple[Finite, Finite, Finite]
Quaternion = tuple[Finite, Finite, Finite, Finite]


class LaserScan(Message, frozen=True, kw_only=True):
    """One turn of a planar lidar, counter-clockwise, in the sensor's frame."""

    frame_id: Name = "base_scan"
    angle_min: Finite  # [rad], angle of the first beam
    angle_increment: Finite  # [rad]
    range_min: NonNegative  # [m]
    range_max: Positive  # [m]
    ranges: bytes  # float32 little-endian [m], (n,); inf where nothing was hit, nan where unknown

    def __post_init__(self) -> None:
        if not self.ranges or len(self.ranges) % 4:
            raise ValueError(f"ranges must be float32 values, got {len(self.ranges)} bytes")
        if self.angle_increment == 0:
            raise ValueError("angle_increment must not be 0")
        if self.range_max <= self.range_min:
            raise ValueError("range_max must be larger than range_min")


class ImuData(Record, frozen=True, kw_only=True):
    """Attitude, turn rate and acceleration of the body."""

    orientation: Quaternion  # x, y, z, w
    angular_velocity: Vector  # [rad/s]
    linear_acceleration: Vector  # [m/s2], +9.81 on z at rest


class Imu(Message, frozen=True, kw_only=True):
    """One reading of the inertial measurement unit."""

    frame_id: Name = "imu_link"
    orientation: Quaternion  # x, y, z, w
    angular_velocity: Vector  # [rad/s]
    linear_acceleration: Vector  # [m/s2]


PIXEL_BYTES = {"rgb8": 3, "bgr8": 3, "mono8": 1, "depth16": 2, "depth32f": 4}


class Image(Message, frozen=True, kw_only=True):
    """One picture of a camera; depth16 is in millimetres, depth32f in metres."""

    frame_id: Name
    encoding: Literal["jpeg", "rgb8", "bgr8", "mono8", "depth16", "depth32f"]
    height: Count  # [px]
    width: Count  # [px]
    data: bytes  # row by row, little-endian

    def __post_init__(self) -> None:
        if not self.data:
            raise ValueError("an image holds at least one pixel")
        if self.encoding == "jpeg":
            return
        expected = self.height * self.width * PIXEL_BYTES[self.encoding]
        if len(self.data) != expected:
            raise ValueError(f"{self.encoding} needs {expected} bytes, got {len(self.data)}")
