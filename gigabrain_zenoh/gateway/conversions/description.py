"""A URDF of the body: footprint, wheels and sensors from its file, and its arm's model."""

import math
from typing import Any, NamedTuple
from xml.etree import ElementTree as xml

from gigabrain_schemas.body import Body, BodyDescription
from gigabrain_zenoh.gateway.conversions import urdf_elements as elements
from gigabrain_zenoh.gateway.conversions.arm_description import add_arm
from gigabrain_zenoh.gateway.conversions.arm_frames import ArmFrames
from gigabrain_zenoh.gateway.conversions.frames import (
    BASE,
    FOOTPRINT,
    Make,
    Placed,
    camera_link,
    optical_frame,
    static_frames,
)
from gigabrain_zenoh.geometry.link_model import LinkModel

WHEEL_WIDTH = 0.15  # of its diameter; robots' files do not contain it
ROUND_CORNERS, ROUND_SHARE = 8, 0.03  # a round footprint: least corners, largest radius error
MIN_HEIGHT = 0.02  # [m] of the hull that is drawn


class Wheel(NamedTuple):
    """A wheel of a differential base."""

    joint: str
    link: str
    y: float  # [m], left of the base's middle
    radius: float  # [m]


def wheels(about: BodyDescription) -> tuple[Wheel, ...]:
    """Return the two wheels of a differential base with known sizes; empty for others."""
    if about.drive_type != "differential" or not about.wheel_radius or not about.wheel_separation:
        return ()
    half, radius = about.wheel_separation / 2, about.wheel_radius
    sides = (("left", half), ("right", -half))
    return tuple(Wheel(f"wheel_{s}_joint", f"wheel_{s}_link", y, radius) for s, y in sides)


def arm_frames(model: LinkModel, body: Body) -> ArmFrames:
    """Return the frames of the arm on a body."""
    taken = {frame.child for frame in static_frames(body)} | {FOOTPRINT}
    for camera in body.description.cameras:
        taken |= {camera_link(camera.name), optical_frame(camera.name)}
    taken |= {wheel.link for wheel in wheels(body.description)}
    return ArmFrames(model, body.description, taken)


def urdf(body: Body, arm: ArmFrames | None = None) -> str:
    """Return the URDF: the hull or the arm's model, wheels where known, sensor frames."""
    about = body.description
    robot = xml.Element("robot", name=about.robot_type)
    elements.link(robot, FOOTPRINT)
    base = elements.link(robot, BASE)
    if arm is None:
        _hull(base, about)
    for placed in static_frames(body):
        if placed.child != BASE:
            elements.link(robot, placed.child)
        elements.joint(robot, f"{placed.child}_joint", "fixed", placed)
    for wheel in wheels(about):
        _wheel(robot, wheel)
    if arm:
        add_arm(robot, base, arm)
    xml.indent(robot)
    return xml.tostring(robot, "unicode", xml_declaration=True)


def robot_description(make: Make, body: Body, arm: ArmFrames | None = None) -> Any:
    """Return std_msgs/String with the URDF."""
    return make("std_msgs/msg/String", data=urdf(body, arm))


def _hull(link: xml.Element, about: BodyDescription) -> None:
    """Draw the footprint up to the body's height: a cylinder if it is round, else a box."""
    xs, ys = zip(*about.footprint, strict=True)
    middle = (max(xs) + min(xs)) / 2, (max(ys) + min(ys)) / 2
    lift = about.wheel_radius if wheels(about) else 0.0
    height = max(about.body_height - lift, MIN_HEIGHT)
    reaches = [math.hypot(x - middle[0], y - middle[1]) for x, y in about.footprint]
    is_round = max(reaches) - min(reaches) <= ROUND_SHARE * max(reaches)
    for part in ("visual", "collision"):
        _, shape = elements.drawn(link, part, (*middle, lift + height / 2), elements.NOWHERE)
        if is_round and len(reaches) >= ROUND_CORNERS:
            xml.SubElement(shape, "cylinder", radius=f"{max(reaches):g}", length=f"{height:g}")
        else:
            size = max(xs) - min(xs), max(ys) - min(ys), height
            xml.SubElement(shape, "box", size=elements.numbers(size))


def _wheel(robot: xml.Element, wheel: Wheel) -> None:
    link = elements.link(robot, wheel.link)
    for part in ("visual", "collision"):
        _, shape = elements.drawn(link, part, elements.NOWHERE, (math.pi / 2, 0.0, 0.0))
        length = 2 * WHEEL_WIDTH * wheel.radius
        xml.SubElement(shape, "cylinder", radius=f"{wheel.radius:g}", length=f"{length:g}")
    placed = Placed(BASE, wheel.link, 0.0, wheel.y, wheel.radius)
    joint = elements.joint(robot, wheel.joint, "continuous", placed)
    xml.SubElement(joint, "axis", xyz="0 1 0")
