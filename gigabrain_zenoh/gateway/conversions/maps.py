"""Conversions of map, path, and poses from ROS."""

import itertools
import math
from typing import Any

import numpy as np

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gateway.conversions.frames import (
    MAP,
    ODOM,
    Make,
    header,
    pose,
    pose_stamped,
    time,
    yaw_of,
)
from gigabrain_zenoh.geometry.pose import compose

MAX_COORDINATE = 1e5  # [m]
PLANAR = (0, 1, 5)  # indices of x, y, yaw among x, y, z, roll, pitch, yaw


def occupancy_grid(make: Make, grid: OccupancyGrid) -> Any:
    """Return nav_msgs/OccupancyGrid: 0 free to 100 occupied, -1 unknown, as in ours."""
    return make(
        "nav_msgs/msg/OccupancyGrid",
        header=header(make, grid.stamp_ns, MAP),
        info=make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=time(make, grid.stamp_ns),
            resolution=grid.resolution,
            width=grid.width,
            height=grid.height,
            origin=pose(make, Pose(x=grid.origin_x, y=grid.origin_y, yaw=0.0)),
        ),
        data=grid.array().ravel(),
    )


def plan(make: Make, status: TaskStatus) -> Any:
    """Return nav_msgs/Path to the goal, headed along it; empty without a path."""
    points = status.path
    yaws = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in itertools.pairwise(points)]
    yaws.append(yaws[-1] if yaws else 0.0)
    if status.goal and status.goal.yaw is not None:
        yaws[-1] = status.goal.yaw
    poses = [
        pose_stamped(make, status.stamp_ns, MAP, Pose(x=x, y=y, yaw=yaw))
        for (x, y), yaw in zip(points, yaws, strict=False)
    ]
    return make("nav_msgs/msg/Path", header=header(make, status.stamp_ns, MAP), poses=poses)


def planar(ros_pose: Any) -> Pose:
    """Return a geometry_msgs/Pose as a pose on the floor. Raises Refused if it is not one."""
    x, y = float(ros_pose.position.x), float(ros_pose.position.y)
    yaw = yaw_of(ros_pose.orientation)
    if not (abs(x) <= MAX_COORDINATE and abs(y) <= MAX_COORDINATE):
        raise Refused(f"the position ({x:g}, {y:g}) is outside any map; expected metres")
    if yaw is None:
        raise Refused("the orientation is not a unit quaternion; expected w: 1.0 for straight")
    return Pose(x=x, y=y, yaw=yaw)


def in_map(frame: str, at: Pose, odom_in_map: Pose | None) -> Pose:
    """Return a pose in the map, from the frame `map` or `odom`. Raises Refused for others."""
    if frame == MAP:
        return at
    if frame != ODOM:
        raise Refused(f"frame {frame[:60]!r} is not valid for goals; expected {MAP} or {ODOM}")
    if odom_in_map is None:
        raise Refused(
            f"a goal in {ODOM} needs a localized robot; localize it, or send the goal in {MAP}"
        )
    return compose(odom_in_map, at)


def planar_covariance(values: Any) -> tuple[float, ...]:
    """Return the covariance of x, y and yaw, 9 values by row, of a ROS covariance of 36.

    Empty for an unknown one, which is all zero. Raises Refused if it is no covariance.
    """
    full = np.asarray(values, np.float64).reshape(6, 6)
    part = full[np.ix_(PLANAR, PLANAR)]
    bounded = (np.abs(part) <= MAX_COORDINATE**2).all()  # false for NaN
    if not bounded or np.linalg.eigvalsh((part + part.T) / 2).min() < -1e-9:
        raise Refused("invalid covariance: expected finite, symmetric values, none negative")
    if not part.any():
        return ()
    return tuple(float(value) for value in ((part + part.T) / 2).ravel())
