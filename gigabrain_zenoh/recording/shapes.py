"""The shapes that messages are drawn with."""

import math

from foxglove import messages as fox

from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import Obstacle, WorldModel

AMBER = fox.Color(r=0.96, g=0.62, b=0.04, a=0.6)
TALL = 0.3  # [m], how high an obstacle is drawn
AHEAD_S = 1.0  # how far its arrow reaches
SLOW = 0.05  # [m/s], below it no arrow is drawn
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


def obstacle(world: WorldModel, one: Obstacle, frame: str) -> fox.SceneEntity:
    """A cylinder, and an arrow to where it will be."""
    here = pose_of(one.x, one.y, 0.0)
    wide = 2 * max(one.radius, 0.01)
    body = fox.CylinderPrimitive(
        pose=here, size=fox.Vector3(x=wide, y=wide, z=TALL), color=AMBER,
        top_scale=1.0, bottom_scale=1.0,
    )  # fmt: skip
    speed = math.hypot(one.velocity_x, one.velocity_y)
    arrow = fox.ArrowPrimitive(
        pose=pose_of(one.x, one.y, math.atan2(one.velocity_y, one.velocity_x)),
        shaft_length=AHEAD_S * speed, shaft_diameter=0.03,
        head_length=0.08, head_diameter=0.08, color=AMBER,
    )  # fmt: skip
    return fox.SceneEntity(
        timestamp=stamp(world), frame_id=frame, id=str(one.id), lifetime=GONE,
        cylinders=[body], arrows=[arrow] if speed > SLOW else [],
    )  # fmt: skip
