"""Planar poses put together and taken apart. Pure functions, without numpy."""

import math

from gigabrain_schemas.base import Pose

ORIGIN = Pose(x=0.0, y=0.0, yaw=0.0)


def wrapped(angle: float) -> float:
    """`angle` [rad] within -pi and pi."""
    return math.remainder(angle, math.tau)


def compose(frame: Pose, pose: Pose) -> Pose:
    """`pose`, given in `frame`, in the frame that `frame` itself is given in."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    return Pose(
        x=frame.x + cosine * pose.x - sine * pose.y,
        y=frame.y + sine * pose.x + cosine * pose.y,
        yaw=wrapped(frame.yaw + pose.yaw),
    )


def relative(frame: Pose, pose: Pose) -> Pose:
    """`pose` as seen from `frame`, both given in one frame. Undoes `compose`."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    dx, dy = pose.x - frame.x, pose.y - frame.y
    return Pose(
        x=cosine * dx + sine * dy,
        y=cosine * dy - sine * dx,
        yaw=wrapped(pose.yaw - frame.yaw),
    )


def inverse(pose: Pose) -> Pose:
    """The frame that `pose` is given in, as seen from `pose`."""
    return relative(pose, ORIGIN)


def between(before: Pose, after: Pose, share: float) -> Pose:
    """The pose that lies `share` (0 to 1) of the way from `before` to `after`, the shorter way."""
    return Pose(
        x=before.x + share * (after.x - before.x),
        y=before.y + share * (after.y - before.y),
        yaw=wrapped(before.yaw + share * wrapped(after.yaw - before.yaw)),
    )
