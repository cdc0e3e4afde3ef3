"""The shapes that messages are drawn with."""

import math

import numpy as np
from foxglove import messages as fox

from gigabrain_schemas import arrays
from gigabrain_schemas.base import Message, Pose
from gigabrain_schemas.brain import Obstacle, WorldModel

AMBER = fox.Color(r=0.96, g=0.62, b=0.04, a=0.6)
TALL = 0.3  # [m], how high an obstacle is drawn
THICK = 0.08  # [m], and how thick a line is
AHEAD_S = 1.0  # how far its arrow reaches
SLOW = 0.05  # [m/s], below it no arrow is drawn
LARGE = 0.3  # [m], radius above which a thing that stands is drawn as what was seen of it
GAP = 0.25  # [m], between two beams on one thing
GONE = fox.Duration(sec=1)  # after so long without news an obstacle is no longer drawn


def stamp(message: Message) -> fox.Timestamp:
    """When `message` was valid."""
    return fox.Timestamp(message.stamp_ns // 1_000_000_000, message.stamp_ns % 1_000_000_000)


def turn(yaw: float) -> fox.Quaternion:
    """A heading [rad] as a quaternion."""
    return fox.Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def pose_of(x: float, y: float, yaw: float) -> fox.Pose:
    """A planar pose [m, m, rad]."""
    return fox.Pose(position=fox.Vector3(x=x, y=y), orientation=turn(yaw))


def things(world: WorldModel, odometry: Pose, odom: str, base: str) -> list[fox.SceneEntity]:
    """All obstacles: cylinders in the frame `odom`, what is large and stands in the frame `base`.

    `odometry` is where the robot was when it saw them.
    """
    return [
        _seen(world, one, odometry, base)
        if one.radius > LARGE and _speed(one) <= SLOW and world.hits
        else _cylinder(world, one, odom)
        for one in world.obstacles
    ]


def _speed(one: Obstacle) -> float:
    return math.hypot(one.velocity_x, one.velocity_y)


def _seen(world: WorldModel, one: Obstacle, odometry: Pose, base: str) -> fox.SceneEntity:
    """Lines along the beams that hit it, such as a wall."""
    hits = arrays.hits(world)
    dx, dy = one.x - odometry.x, one.y - odometry.y
    c, s = math.cos(odometry.yaw), math.sin(odometry.yaw)
    off = np.hypot(hits[:, 0] - (c * dx + s * dy), hits[:, 1] - (c * dy - s * dx))
    near = hits[off < one.radius + GAP]
    joined = np.hypot(*np.diff(near, axis=0).T) < GAP
    ends = np.hstack((near[:-1], near[1:]))[joined].reshape(-1, 2).tolist()
    lines = fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineList,
        points=[fox.Point3(x=x, y=y, z=TALL / 2) for x, y in ends],
        thickness=THICK, color=AMBER,
    )  # fmt: skip
    return fox.SceneEntity(
        timestamp=stamp(world), frame_id=base, id=str(one.id), lifetime=GONE, lines=[lines]
    )


def _cylinder(world: WorldModel, one: Obstacle, frame: str) -> fox.SceneEntity:
    """A cylinder, and an arrow to where it will be."""
    here = pose_of(one.x, one.y, 0.0)
    wide = 2 * max(one.radius, 0.01)
    body = fox.CylinderPrimitive(
        pose=here, size=fox.Vector3(x=wide, y=wide, z=TALL), color=AMBER,
        top_scale=1.0, bottom_scale=1.0,
    )  # fmt: skip
    speed = _speed(one)
    arrow = fox.ArrowPrimitive(
        pose=pose_of(one.x, one.y, math.atan2(one.velocity_y, one.velocity_x)),
        shaft_length=AHEAD_S * speed, shaft_diameter=0.03,
        head_length=0.08, head_diameter=0.08, color=AMBER,
    )  # fmt: skip
    return fox.SceneEntity(
        timestamp=stamp(world), frame_id=frame, id=str(one.id), lifetime=GONE,
        cylinders=[body], arrows=[arrow] if speed > SLOW else [],
    )  # fmt: skip
