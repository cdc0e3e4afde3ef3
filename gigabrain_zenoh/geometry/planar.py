"""Composition and inversion of planar poses. Pure functions, without numpy."""

import math

from gigabrain_schemas.base import Pose

ORIGIN = Pose(x=0.0, y=0.0, yaw=0.0)


def wrapped(angle: float) -> float:
    """Return `angle` [rad] wrapped to -pi to pi."""
    return math.remainder(angle, math.tau)


def compose(frame: Pose, pose: Pose) -> Pose:
    """Transform `pose` from `frame` to the parent frame, in which `frame` itself is given."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    return Pose(
        x=frame.x + cosine * pose.x - sine * pose.y,
        y=frame.y + sine * pose.x + cosine * pose.y,
        yaw=wrapped(frame.yaw + pose.yaw),
    )


def relative(frame: Pose, pose: Pose) -> Pose:
    """Return `pose` relative to `frame`, both given in the same frame. Inverse of `compose`."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    dx, dy = pose.x - frame.x, pose.y - frame.y
    return Pose(
        x=cosine * dx + sine * dy,
        y=cosine * dy - sine * dx,
        yaw=wrapped(pose.yaw - frame.yaw),
    )


def inverse(pose: Pose) -> Pose:
    """Return the inverse transform: the parent frame as seen from `pose`."""
    return relative(pose, ORIGIN)


def between(before: Pose, after: Pose, share: float) -> Pose:
    """Interpolate from `before` (`share` 0) to `after` (1); yaw takes the shorter direction."""
    return Pose(
        x=before.x + share * (after.x - before.x),
        y=before.y + share * (after.y - before.y),
        yaw=wrapped(before.yaw + share * wrapped(after.yaw - before.yaw)),
    )
