"""Measurements of sensors."""

from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta

from gigabrain_schemas.base import Message, Milliseconds, Name, Range, Record, array_meta

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

RangeMax = Annotated[float, Meta(ge=0.01, le=1000.0)]  # [m]
BeamAngle = Annotated[float, Meta(ge=-100.0, le=100.0)]  # [rad]
BeamStep = Annotated[float, Meta(ge=-6.3, le=6.3)]  # [rad]
Turning = Annotated[float, Meta(ge=-1000.0, le=1000.0)]  # [rad/s]
Acceleration = Annotated[float, Meta(ge=-10_000.0, le=10_000.0)]  # [m/s2]
Turnings = tuple[Turning, Turning, Turning]
Accelerations = tuple[Acceleration, Acceleration, Acceleration]
Part = Annotated[float, Meta(ge=-2.0, le=2.0)]  # component of a quaternion of about unit length
Quaternion = tuple[Part, Part, Part, Part]
Pixels = Annotated[int, Meta(ge=0, le=16_384)]
MIN_STEP = 1e-6  # [rad], between beams


class LaserScan(Message, frozen=True, kw_only=True):
    """One turn of a planar lidar, counter-clockwise, in the sensor's frame."""

    frame_id: Name = "base_scan"
    angle_min: BeamAngle  # [rad], angle of the first beam
    angle_increment: BeamStep  # [rad]
    range_min: Range  # [m]
    range_max: RangeMax  # [m]
    # float32 little-endian [m], (n,); inf without a hit, nan if unknown
    ranges: Annotated[bytes, array_meta(64 * 1024, "float32", ("n",), "m")]
    late_ms: Milliseconds = 0.0  # delay beyond the shortest one; 0 without stamps

    def __post_init__(self) -> None:
        if not self.ranges or len(self.ranges) % 4:
            raise ValueError(f"ranges must be float32 values, got {len(self.ranges)} bytes")
        if abs(self.angle_increment) < MIN_STEP:
            raise ValueError("angle_increment must not be 0")
        if self.range_max <= self.range_min:
            raise ValueError("range_max must be larger than range_min")

    @property
    def ranges_m(self) -> "NDArray[np.float32]":
        """The ranges [m], (n,), as a read-only view."""
        import numpy as np

        return np.frombuffer(self.ranges, "<f4")

    @property
    def angles(self) -> "NDArray[np.float64]":
        """The angles of the beams [rad], (n,), counter-clockwise from the sensor's x axis."""
        import numpy as np

        beams = np.arange(len(self.ranges) // 4, dtype=np.float64)
        return self.angle_min + self.angle_increment * beams

    def points(self) -> "NDArray[np.float64]":
        """Return the points that beams hit [m], (k, 2), in the sensor's frame."""
        import numpy as np

        ranges, angles = self.ranges_m.astype(np.float64), self.angles
        hit = np.isfinite(ranges) & (ranges >= self.range_min) & (ranges <= self.range_max)
        x, y = ranges[hit] * np.cos(angles[hit]), ranges[hit] * np.sin(angles[hit])
        return np.column_stack((x, y))


class ImuData(Record, frozen=True, kw_only=True):
    """Attitude, turn rate and acceleration of the body."""

    orientation: Quaternion  # x, y, z, w; all 0 if unknown
    angular_velocity: Turnings  # [rad/s]
    linear_acceleration: Accelerations  # [m/s2], +9.81 on z at rest


class Imu(Message, frozen=True, kw_only=True):
    """One reading of the inertial measurement unit."""

    frame_id: Name = "imu_link"
    orientation: Quaternion  # x, y, z, w; all 0 if unknown
    angular_velocity: Turnings  # [rad/s]
    linear_acceleration: Accelerations  # [m/s2]


PIXEL_TYPES = {
    "jpeg": None, "rgb8": "uint8", "bgr8": "uint8", "mono8": "uint8", "depth16": "uint16",
    "depth32f": "float32",
}  # fmt: skip
IMAGE_SHAPE: tuple[str | int, ...] = ("height", "width")
IMAGE_SHAPES = {
    "jpeg": None, "rgb8": (*IMAGE_SHAPE, 3), "bgr8": (*IMAGE_SHAPE, 3), "mono8": IMAGE_SHAPE,
    "depth16": IMAGE_SHAPE, "depth32f": IMAGE_SHAPE,
}  # fmt: skip
PIXEL_BYTES = {"rgb8": 3, "bgr8": 3, "mono8": 1, "depth16": 2, "depth32f": 4}


class Image(Message, frozen=True, kw_only=True):
    """One picture of a camera; depth16 is in millimetres, depth32f in metres."""

    frame_id: Name
    encoding: Literal["jpeg", "rgb8", "bgr8", "mono8", "depth16", "depth32f"]
    height: Pixels  # [px]
    width: Pixels  # [px]
    # row by row, little-endian
    data: Annotated[bytes, array_meta(1024 * 1024, PIXEL_TYPES, IMAGE_SHAPES)]

    def __post_init__(self) -> None:
        if not self.data:
            raise ValueError("an image holds at least one pixel")
        if self.encoding == "jpeg":
            return
        expected = self.height * self.width * PIXEL_BYTES[self.encoding]
        if len(self.data) != expected:
            raise ValueError(f"{self.encoding} needs {expected} bytes, got {len(self.data)}")

    def array(self) -> "NDArray[np.generic]":
        """Return the pixels, (height, width) or (height, width, 3), as a read-only view.

        Raises ValueError for a JPEG, which must be decoded first.
        """
        import numpy as np

        if self.encoding == "jpeg":
            raise ValueError("a JPEG must be decoded first, for example by cv2.imdecode")
        channels = (3,) if self.encoding in ("rgb8", "bgr8") else ()
        view = np.frombuffer(self.data, np.dtype(PIXEL_TYPES[self.encoding]).newbyteorder("<"))
        return view.reshape(self.height, self.width, *channels)
