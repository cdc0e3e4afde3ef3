"""The arm's part of a URDF: links with inertia and primitive shapes, and joints with limits."""

from collections.abc import Iterator
from xml.etree import ElementTree as xml

from gigabrain_zenoh.gateway.conversions import urdf_elements as urdf
from gigabrain_zenoh.gateway.conversions.arm_frames import ArmFrame, ArmFrames, ArmJoint
from gigabrain_zenoh.gateway.conversions.frames import Placed
from gigabrain_zenoh.geometry.link_model import Place, Shape

Geometry = tuple[str, dict[str, str], Place]  # element, attributes, where


def add_arm(robot: xml.Element, base: xml.Element, arm: ArmFrames) -> None:
    """Add the links of an arm to a URDF; `base` is its link `base_link`."""
    colours = sorted({shape.colour for shape in arm.model.shapes})
    for number, colour in enumerate(colours):
        material = xml.SubElement(robot, "material", name=f"colour{number}")
        xml.SubElement(material, "color", rgba=urdf.numbers(colour))
    names = {colour: f"colour{number}" for number, colour in enumerate(colours)}
    _fill(base, arm, 0, names)
    for frame in arm.frames:
        link = urdf.link(robot, frame.name)
        if frame.link >= 0:
            _fill(link, arm, frame.link, names)
        _join(robot, frame)
    for placed in arm.cameras:
        urdf.link(robot, placed.child)
        urdf.joint(robot, f"{placed.child}_joint", "fixed", placed)


def _fill(
    link: xml.Element, arm: ArmFrames, number: int, names: dict[tuple[float, ...], str]
) -> None:
    """Add inertia and shapes of a link of the model."""
    if found := arm.model.inertial(number):
        inertial = xml.SubElement(link, "inertial")
        urdf.origin(inertial, tuple(found.centre.tolist()), urdf.NOWHERE)
        xml.SubElement(inertial, "mass", value=f"{found.mass:.9g}")
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = found.tensor.tolist()
        entries = {"ixx": xx, "ixy": xy, "ixz": xz, "iyy": yy, "iyz": yz, "izz": zz}
        xml.SubElement(inertial, "inertia", {key: f"{one:.9g}" for key, one in entries.items()})
    for shape in arm.model.every_shape:
        if shape.link == number:
            for part, wanted in (("visual", shape.seen), ("collision", shape.solid)):
                for element in _draw(link, part, shape) if wanted else ():
                    if part == "visual":
                        xml.SubElement(element, "material", name=names[shape.colour])


def _draw(link: xml.Element, part: str, shape: Shape) -> Iterator[xml.Element]:
    for kind, attributes, place in _geometries(shape):
        w, x, y, z = place.rotation
        made, geometry = urdf.drawn(link, part, place.position, urdf.angles((x, y, z, w)))
        xml.SubElement(geometry, kind, attributes)
        yield made


def _geometries(shape: Shape) -> Iterator[Geometry]:
    """Yield a shape's URDF geometries; an ellipsoid becomes its outer sphere."""
    a, b, _ = shape.size
    if shape.kind == "box":
        yield "box", {"size": urdf.numbers(2 * side for side in shape.size)}, shape.place
    elif shape.kind in ("sphere", "ellipsoid"):
        radius = a if shape.kind == "sphere" else max(shape.size)
        yield "sphere", {"radius": f"{radius:.9g}"}, shape.place
    else:
        yield "cylinder", {"radius": f"{a:.9g}", "length": f"{2 * b:.9g}"}, shape.place
        for end in (-b, b) if shape.kind == "capsule" else ():
            yield "sphere", {"radius": f"{a:.9g}"}, shape.place @ Place((0.0, 0.0, end))


def _join(robot: xml.Element, frame: ArmFrame) -> None:
    """Add the joint between a frame and its parent."""
    w, x, y, z = frame.place.rotation
    placed = Placed(frame.parent, frame.name, *frame.place.position, (x, y, z, w))
    if frame.joint is None:
        urdf.joint(robot, f"{frame.name}_fixed", "fixed", placed)
        return
    kind = "prismatic" if frame.joint.about.slides else "revolute"
    joint = urdf.joint(robot, frame.joint.about.name, kind, placed)
    xml.SubElement(joint, "axis", xyz=urdf.numbers(frame.joint.about.axis))
    xml.SubElement(joint, "limit", _limits(frame.joint))
    if mimic := frame.joint.mimic:
        xml.SubElement(
            joint, "mimic", joint=mimic.joint, multiplier=f"{mimic.multiplier:.9g}",
            offset=f"{mimic.offset:.9g}",
        )  # fmt: skip


def _limits(joint: ArmJoint) -> dict[str, str]:
    """Return the limits; an effort of 0 is unknown, as in the robot's file."""
    about = joint.limits
    slope, offset = (joint.mimic.multiplier, joint.mimic.offset) if joint.mimic else (1.0, 0.0)
    lower, upper = sorted((slope * about.lower + offset, slope * about.upper + offset))
    speed = abs(slope) * about.max_speed
    found = {"lower": lower, "upper": upper, "effort": about.max_effort, "velocity": speed}
    return {name: f"{value:.9g}" for name, value in found.items()}
