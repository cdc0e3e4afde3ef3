"""Headers, poses and transforms of ROS, and the names of the frames."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Body, Camera

Make = Callable[..., Any]
Rotation = tuple[float, float, float, float]  # quaternion x, y, z, w

MAP, ODOM, FOOTPRINT, BASE = "map", "odom", "base_footprint", "base_link"
IMU_LINK, SCAN_LINK = "imu_link", "base_scan"
PARTS = ("base", "imu", "wheel_left", "wheel_right")  # of a body, with frames `..._link`
SECOND_NS = 1_000_000_000
END_NS = 2**31 * SECOND_NS  # of builtin_interfaces/Time
STRAIGHT: Rotation = (0.0, 0.0, 0.0, 1.0)
LENS: Rotation = (-0.5, 0.5, -0.5, 0.5)  # of a lens (z forward, x right) on its mount (x forward)


class Placed(NamedTuple):
    """A frame in its parent frame."""

    parent: str
    child: str
    x: float  # [m]
    y: float  # [m]
    z: float  # [m]
    rotation: Rotation = STRAIGHT


def seconds(stamp_ns: int) -> tuple[int, int]:
    """Return seconds and nanoseconds of a Unix time. Raises ValueError if ROS cannot hold it."""
    if stamp_ns >= END_NS:
        raise ValueError(f"its stamp is {stamp_ns} ns; ROS ends at {END_NS} ns, in 2038")
    return divmod(stamp_ns, SECOND_NS)


def time(make: Make, stamp_ns: int) -> Any:
    """Return builtin_interfaces/Time of a Unix time. Raises ValueError like `seconds`."""
    sec, nanosec = seconds(stamp_ns)
    return make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def stamp_ns(stamp: Any) -> int:
    """Return a ROS time or duration [ns]."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def header(make: Make, at_ns: int, frame: str) -> Any:
    """Return std_msgs/Header."""
    return make("std_msgs/msg/Header", stamp=time(make, at_ns), frame_id=frame)


def turned(yaw: float) -> Rotation:
    """Return the rotation by `yaw` [rad] about z."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


def rotated(roll: float, pitch: float, yaw: float) -> Rotation:
    """Return the rotation by roll, then pitch, then yaw [rad], about fixed axes."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a / 2), math.cos(a / 2)) for a in (roll, pitch, yaw))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def yaw_of(quaternion: Any) -> float | None:
    """Return the heading [rad] of a ROS quaternion; None if it is no rotation."""
    x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    length = x * x + y * y + z * z + w * w
    if not 0.5 < length < 2.0:  # also false for NaN, and for zeros of an empty message
        return None
    return math.atan2(2 * (w * z + x * y), length - 2 * (y * y + z * z))


def quaternion(make: Make, rotation: Rotation) -> Any:
    """Return geometry_msgs/Quaternion."""
    x, y, z, w = rotation
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def vector(make: Make, x: float, y: float, z: float) -> Any:
    """Return geometry_msgs/Vector3."""
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def pose(make: Make, at: Pose) -> Any:
    """Return geometry_msgs/Pose of a pose on the floor."""
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=at.x, y=at.y, z=0.0),
        orientation=quaternion(make, turned(at.yaw)),
    )


def pose_stamped(make: Make, at_ns: int, frame: str, at: Pose) -> Any:
    """Return geometry_msgs/PoseStamped."""
    return make(
        "geometry_msgs/msg/PoseStamped", header=header(make, at_ns, frame), pose=pose(make, at)
    )


def on_floor(parent: str, child: str, at: Pose) -> Placed:
    """Return a frame on the floor of its parent."""
    return Placed(parent, child, at.x, at.y, 0.0, turned(at.yaw))


def transforms(make: Make, at_ns: int, placed: Iterable[Placed]) -> Any:
    """Return tf2_msgs/TFMessage of frames at one time."""
    return make("tf2_msgs/msg/TFMessage", transforms=[_transform(make, at_ns, p) for p in placed])


def _transform(make: Make, at_ns: int, placed: Placed) -> Any:
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(make, at_ns, placed.parent),
        child_frame_id=placed.child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=vector(make, placed.x, placed.y, placed.z),
            rotation=quaternion(make, placed.rotation),
        ),
    )


def camera_link(camera: str) -> str:
    """Return the frame of a camera's mount (x forward), different from all body parts."""
    return f"{camera}_camera_link" if camera in PARTS else f"{camera}_link"


def optical_frame(camera: str) -> str:
    """Return the frame of a camera's pictures (z forward)."""
    return f"{camera}_optical_frame"


def static_frames(body: Body) -> list[Placed]:
    """Return the static frames: sensors on the base, and the base on the floor.

    The lidar counts as the highest part, because robots' files contain no height of it.
    """
    about = body.description
    frames = [Placed(FOOTPRINT, BASE, 0.0, 0.0, 0.0), Placed(BASE, IMU_LINK, 0.0, 0.0, 0.0)]
    if about.lidar:
        x, y, yaw = about.lidar.x, about.lidar.y, about.lidar.yaw
        frames.append(Placed(BASE, SCAN_LINK, x, y, about.body_height, turned(yaw)))
    for camera in about.fixed_cameras:
        frames += camera_frames(camera, BASE)
    return frames


def camera_frames(camera: Camera, parent: str) -> list[Placed]:
    """Return the frames of a camera on the frame `parent`."""
    link, rotation = camera_link(camera.name), rotated(camera.roll, camera.pitch, camera.yaw)
    return [
        Placed(parent, link, camera.x, camera.y, camera.z, rotation),
        Placed(link, optical_frame(camera.name), 0.0, 0.0, 0.0, LENS),
    ]


def tf_static(make: Make, body: Body, of_arm: Sequence[Placed] = ()) -> Any:
    """Return tf2_msgs/TFMessage of the static frames of the body and its arm."""
    return transforms(make, body.stamp_ns, [*static_frames(body), *of_arm])
