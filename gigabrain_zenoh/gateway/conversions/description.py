"""A URDF of the body, from the footprint, wheels and sensors of its file."""

import math
from typing import Any, NamedTuple
from xml.etree import ElementTree as xml

from gigabrain_schemas.body import Body, BodyDescription
from gigabrain_zenoh.gateway.conversions.frames import BASE, FOOTPRINT, Make, Placed, static_frames

WHEEL_WIDTH = 0.15  # of its diameter; files do not give it
ROUND_CORNERS, ROUND_SHARE = 8, 0.03  # a footprint of so many corners, so equally far, is round
LEAST_HEIGHT = 0.02  # [m] of the hull that is drawn


class Wheel(NamedTuple):
    """A wheel of a differential base."""

    joint: str
    link: str
    y: float  # [m], left of the base's middle
    radius: float  # [m]


def wheels(about: BodyDescription) -> tuple[Wheel, ...]:
    """Return the two wheels of a differential base whose file has their sizes; else none."""
    if about.drive_type != "differential" or not about.wheel_radius or not about.wheel_separation:
        return ()
    half, radius = about.wheel_separation / 2, about.wheel_radius
    sides = (("left", half), ("right", -half))
    return tuple(Wheel(f"wheel_{s}_joint", f"wheel_{s}_link", y, radius) for s, y in sides)


def urdf(body: Body) -> str:
    """Return the URDF: the hull on `base_link`, wheels where they are known, sensor frames."""
    about = body.description
    robot = xml.Element("robot", name=about.robot_type)
    _link(robot, FOOTPRINT)
    _hull(_link(robot, BASE), about)
    for placed in static_frames(body):
        if placed.child != BASE:
            _link(robot, placed.child)
        _joint(robot, f"{placed.child}_joint", "fixed", placed)
    for wheel in wheels(about):
        _wheel(robot, wheel)
    xml.indent(robot)
    return xml.tostring(robot, "unicode", xml_declaration=True)


def robot_description(make: Make, body: Body) -> Any:
    """Return std_msgs/String with the URDF."""
    return make("std_msgs/msg/String", data=urdf(body))


def _link(robot: xml.Element, name: str) -> xml.Element:
    return xml.SubElement(robot, "link", name=name)


def _hull(link: xml.Element, about: BodyDescription) -> None:
    """Draw the footprint up to the body's height: a cylinder where it is round, else a box."""
    xs, ys = zip(*about.footprint, strict=True)
    middle = (max(xs) + min(xs)) / 2, (max(ys) + min(ys)) / 2
    lift = about.wheel_radius if wheels(about) else 0.0
    height = max(about.body_height - lift, LEAST_HEIGHT)
    reaches = [math.hypot(x - middle[0], y - middle[1]) for x, y in about.footprint]
    is_round = max(reaches) - min(reaches) <= ROUND_SHARE * max(reaches)
    for part in ("visual", "collision"):
        drawn = xml.SubElement(link, part)
        _origin(drawn, (*middle, lift + height / 2), (0.0, 0.0, 0.0))
        shape = xml.SubElement(drawn, "geometry")
        if is_round and len(reaches) >= ROUND_CORNERS:
            xml.SubElement(shape, "cylinder", radius=f"{max(reaches):g}", length=f"{height:g}")
        else:
            size = max(xs) - min(xs), max(ys) - min(ys), height
            xml.SubElement(shape, "box", size=_numbers(size))


def _wheel(robot: xml.Element, wheel: Wheel) -> None:
    link = _link(robot, wheel.link)
    for part in ("visual", "collision"):
        drawn = xml.SubElement(link, part)
        _origin(drawn, (0.0, 0.0, 0.0), (math.pi / 2, 0.0, 0.0))
        shape, length = xml.SubElement(drawn, "geometry"), 2 * WHEEL_WIDTH * wheel.radius
        xml.SubElement(shape, "cylinder", radius=f"{wheel.radius:g}", length=f"{length:g}")
    placed = Placed(BASE, wheel.link, 0.0, wheel.y, wheel.radius)
    joint = _joint(robot, wheel.joint, "continuous", placed)
    xml.SubElement(joint, "axis", xyz="0 1 0")


def _joint(robot: xml.Element, name: str, kind: str, placed: Placed) -> xml.Element:
    joint = xml.SubElement(robot, "joint", name=name, type=kind)
    _origin(joint, (placed.x, placed.y, placed.z), _angles(placed))
    xml.SubElement(joint, "parent", link=placed.parent)
    xml.SubElement(joint, "child", link=placed.child)
    return joint


def _origin(
    element: xml.Element, xyz: tuple[float, float, float], rpy: tuple[float, float, float]
) -> None:
    xml.SubElement(element, "origin", xyz=_numbers(xyz), rpy=_numbers(rpy))


def _angles(placed: Placed) -> tuple[float, float, float]:
    """Return roll, pitch and yaw [rad] of a rotation."""
    x, y, z, w = placed.rotation
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.6g}" for value in values)
