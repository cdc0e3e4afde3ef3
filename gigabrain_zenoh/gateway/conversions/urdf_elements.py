"""Elements of a URDF."""

import math
from collections.abc import Iterable
from xml.etree import ElementTree as xml

from gigabrain_zenoh.gateway.conversions.frames import Placed, Rotation

Vector = tuple[float, float, float]
NOWHERE: Vector = (0.0, 0.0, 0.0)


def link(robot: xml.Element, name: str) -> xml.Element:
    """Add a link."""
    return xml.SubElement(robot, "link", name=name)


def joint(robot: xml.Element, name: str, kind: str, placed: Placed) -> xml.Element:
    """Add a joint between two links."""
    made = xml.SubElement(robot, "joint", name=name, type=kind)
    origin(made, (placed.x, placed.y, placed.z), angles(placed.rotation))
    xml.SubElement(made, "parent", link=placed.parent)
    xml.SubElement(made, "child", link=placed.child)
    return made


def drawn(
    link: xml.Element, part: str, place: Vector, rpy: Vector
) -> tuple[xml.Element, xml.Element]:
    """Add a `visual` or a `collision` to a link; return it, and its empty geometry."""
    made = xml.SubElement(link, part)
    origin(made, place, rpy)
    return made, xml.SubElement(made, "geometry")


def origin(element: xml.Element, xyz: Vector, rpy: Vector) -> None:
    """Add the origin of an element: position [m] and rotation [rad]."""
    xml.SubElement(element, "origin", xyz=numbers(xyz), rpy=numbers(rpy))


def angles(rotation: Rotation) -> Vector:
    """Return roll, pitch and yaw [rad] of a quaternion x, y, z, w; at a pitch of 90° roll is 0."""
    x, y, z, w = rotation
    sin, cos = 2 * (w * y - z * x), math.hypot(1 - 2 * (y * y + z * z), 2 * (w * z + x * y))
    pitch = math.atan2(sin, cos)
    if cos < 1e-9:
        return 0.0, pitch, math.atan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def numbers(values: Iterable[float]) -> str:
    """Return numbers in URDF syntax."""
    return " ".join(f"{value + 0.0:.9g}" for value in values)
