"""Reads the links of an arm, their shapes and masses, from its MJCF model.

It works without MuJoCo, so that viewers need not install it. It reads the elements body, frame,
inertial, joint, geom and site, with defaults, materials and joint equalities. Meshes are ignored.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, get_args
from xml.etree import ElementTree as xml

import numpy as np

from gigabrain_schemas.body import MAX_MODEL_CHARACTERS
from gigabrain_schemas.sim import ShapeKind
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.link_inertia import (
    DENSITY,
    Inertial,
    combined,
    moments,
    turned,
    volume,
)

MAX_LINKS, MAX_SHAPES = 200, 1000
MAX_NUMBER = 1e6
HIDDEN_GROUP = 3  # geoms of this group and above serve collisions and are not drawn
GREY = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default colour of a geom
PRIMITIVES: dict[str, ShapeKind] = {
    kind: kind for kind in get_args(ShapeKind) if kind not in ("plane", "mesh")
}
FREE_TYPES = ("free", "ball")  # joint types of more than one degree of freedom
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z
AXES: dict[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class Place(NamedTuple):
    """A pose in another frame."""

    position: Vector = (0.0, 0.0, 0.0)  # [m]
    rotation: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def __matmul__(self, other: "Place") -> "Place":
        """Transform `other` from this frame to the parent frame."""
        turned = rotated(self.rotation, other.position)
        return Place(_sum(self.position, turned), product(self.rotation, other.rotation))


class LinkJoint(NamedTuple):
    """A joint of one degree of freedom."""

    name: str
    axis: Vector
    anchor: Vector  # [m]
    slides: bool
    rest: float  # [rad] or [m], joint position in the pose that the model gives


class Link(NamedTuple):
    """A body of the model, or a site on one. Parents precede their children."""

    name: str
    parent: int  # index; -1: none
    place: Place  # in its parent, with its joints at rest
    joints: tuple[LinkJoint, ...] = ()


class Shape(NamedTuple):
    """A primitive shape on a link."""

    kind: ShapeKind
    link: int
    size: Vector  # [m]: half sides, half axes, radius and half length, or radius
    place: Place
    colour: tuple[float, ...]  # red, green, blue and alpha of 0 to 1
    mass: float  # [kg]
    seen: bool
    solid: bool  # takes part in collisions

    @property
    def inertial(self) -> Inertial:
        """Its inertia in the frame of its link."""
        tensor = turned(moments(self.kind, self.size, self.mass), self.place.rotation)
        return Inertial(self.mass, np.array(self.place.position), tensor)


class Follower(NamedTuple):
    """A joint that is coupled to another one by their displacements from rest."""

    name: str
    leader: str
    polynomial: list[float]  # of the leader's displacement, lowest power first


class LinkModel:
    """An arm as a tree of links. `links[0]` is the frame of the model: the robot's base.

    A root that can move freely, such as a driving base, has the pose of that frame.
    """

    def __init__(self, mjcf: str) -> None:
        """Read a model. Raises ConfigError, in one line, if the text is not a valid model."""
        self.links, self.every_shape = [Link("", -1, Place())], list[Shape]()
        self.followers = list[Follower]()
        self._inertials = dict[int, Inertial]()  # of `inertial` elements, by link
        try:
            root = _parsed(mjcf)
            reader = _Reader(root)
            for top in root.findall("worldbody"):
                self._add(top, reader)
            self._read_equalities(root)
        except (xml.ParseError, ValueError, RecursionError) as error:
            raise ConfigError(f"the arm's model cannot be drawn: {str(error)[:200]}") from None
        self._rests = {joint.name: joint.rest for link in self.links for joint in link.joints}

    @property
    def shapes(self) -> list[Shape]:
        """The shapes that are drawn."""
        return [shape for shape in self.every_shape if shape.seen]

    def inertial(self, link: int) -> Inertial | None:
        """Return the inertia of a link in its frame; None without mass."""
        if link in self._inertials:
            return self._inertials[link]
        return combined(shape.inertial for shape in self.every_shape if shape.link == link)

    def places(self, positions: Mapping[str, float]) -> list[Place]:
        """Return the pose of each link in its parent, at joint positions [rad] or [m].

        A joint without a position is at rest, or follows another joint by an equality.
        """
        at = {name: positions.get(name, rest) for name, rest in self._rests.items()}
        for follower, leader, polynomial in self.followers:
            if follower not in positions and follower in at and leader in at:
                displacement = at[leader] - self._rests[leader]
                shift = sum(factor * displacement**power for power, factor in enumerate(polynomial))
                at[follower] = self._rests[follower] + shift
        return [_link_place(link, at) for link in self.links]

    def places_in_base(self, positions: Mapping[str, float]) -> list[Place]:
        """Return the pose of each link in the frame of the model, at joint positions."""
        found = list[Place]()
        for link, place in zip(self.links, self.places(positions), strict=True):
            found.append(found[link.parent] @ place if link.parent >= 0 else place)
        return found

    def place_in_base(self, name: str, positions: Mapping[str, float]) -> Place:
        """Return the pose of the link `name` in that frame. Raises ValueError if there is none."""
        number = [link.name for link in self.links].index(name)
        return self.places_in_base(positions)[number]

    def _add(self, top: xml.Element, reader: "_Reader") -> None:
        """Add the links and shapes below an element. Not recursive: elements may nest deeply."""
        waiting: list[tuple[xml.Element, int, Place, str]] = [(top, 0, Place(), "")]
        while waiting:
            element, link, frame, class_name = waiting.pop()
            class_name = element.get("childclass", class_name)
            for child in element:
                if child.tag == "geom":
                    self.every_shape += reader.shapes(child, link, frame, class_name)
                elif child.tag == "inertial":
                    self._inertials[link] = reader.inertial(child)
                elif child.tag == "frame":
                    waiting.append((child, link, frame @ reader.place(child.attrib), class_name))
                elif child.tag in ("body", "site"):
                    self._add_link(child, link, frame, reader, class_name)
                    waiting.append((child, len(self.links) - 1, Place(), class_name))
            if len(self.links) > MAX_LINKS or len(self.every_shape) > MAX_SHAPES:
                raise ValueError(f"more than {MAX_LINKS} links or {MAX_SHAPES} shapes")

    def _add_link(
        self, element: xml.Element, parent: int, frame: Place, reader: "_Reader", class_name: str
    ) -> None:
        name = element.get("name") or f"{element.tag} {len(self.links)}"
        if any(link.name == name for link in self.links):
            name = f"{element.tag} {name}"  # a body and a site may share a name
        is_site = element.tag == "site"
        attributes = reader.attributes(element, class_name) if is_site else element.attrib
        place = frame @ reader.place(attributes)
        free = element.find("freejoint") is not None
        joints = []
        for child in element.iterfind("joint"):
            values = reader.attributes(child, element.get("childclass", class_name))
            free = free or values.get("type") in FREE_TYPES
            if values.get("type") not in FREE_TYPES:
                joints.append(reader.joint(values))
        self.links.append(Link(name, parent, Place() if free else place, tuple(joints)))

    def _read_equalities(self, root: xml.Element) -> None:
        for one in root.iterfind("equality/joint"):
            polynomial = _numbers(one.get("polycoef", "0 1 0 0 0"))
            names = one.get("joint1", ""), one.get("joint2", "")
            self.followers.append(Follower(*names, polynomial[:5]))


class _Reader:
    """Reads elements, with the defaults and units of their model."""

    def __init__(self, root: xml.Element) -> None:
        compiler = {k: v for one in root.iterfind("compiler") for k, v in one.attrib.items()}
        self._rad_per_unit = 1.0 if compiler.get("angle") == "radian" else math.pi / 180
        self._sequence = compiler.get("eulerseq", "xyz")
        self._defaults: dict[str, dict[str, dict[str, str]]] = {"": {}}  # by class and element
        for one in root.iterfind("default"):
            self._read_defaults(one, "")
        self._materials = {
            one.get("name", ""): self.attributes(one, "") for one in root.iterfind("asset/material")
        }

    def _read_defaults(self, element: xml.Element, inherited: str, depth: int = 0) -> None:
        name = element.get("class", "") if depth else ""
        merged = {tag: dict(values) for tag, values in self._defaults[inherited].items()}
        for child in element:
            if child.tag != "default":
                merged[child.tag] = merged.get(child.tag, {}) | child.attrib
        self._defaults[name] = merged
        if not depth:
            self._defaults[element.get("class", "main")] = merged
        for child in element.iterfind("default"):
            self._read_defaults(child, name, depth + 1)

    def attributes(self, element: xml.Element, class_name: str) -> dict[str, str]:
        """Return an element's attributes over the defaults of its class."""
        defaults = self._defaults.get(element.get("class", class_name))
        if defaults is None:
            raise ValueError(f"unknown class {element.get('class', class_name)!r}")
        return defaults.get(element.tag, {}) | element.attrib

    def place(self, values: Mapping[str, str]) -> Place:
        """Return the pose in an element's attributes."""
        return Place(_vector(values.get("pos", "0 0 0")), self._rotation(values))

    def _rotation(self, values: Mapping[str, str]) -> Quaternion:
        if "axisangle" in values:
            x, y, z, angle = _numbers(values["axisangle"], 4)
            return turn(_vector(_unit((x, y, z))), angle * self._rad_per_unit)
        if "xyaxes" in values:
            numbers = _numbers(values["xyaxes"], 6)
            return _rotation_from_axes(numbers[:3], numbers[3:])
        if "zaxis" in values:
            return _rotation_from_z(_vector(values["zaxis"]))
        if "euler" in values:
            found = Place().rotation
            for name, angle in zip(self._sequence, _vector(values["euler"]), strict=True):
                about = turn(AXES[name.lower()], angle * self._rad_per_unit)
                found = product(found, about) if name.islower() else product(about, found)
            return found
        w, x, y, z = _unit(_numbers(values.get("quat", "1 0 0 0"), 4))
        return w, x, y, z

    def joint(self, values: Mapping[str, str]) -> LinkJoint:
        """Return a hinge or a slide."""
        slides = values.get("type") == "slide"
        rest = _numbers(values.get("ref", "0"), 1)[0]
        return LinkJoint(
            name=values.get("name", ""),
            axis=_vector(_unit(_vector(values.get("axis", "0 0 1")))),
            anchor=_vector(values.get("pos", "0 0 0")),
            slides=slides,
            rest=rest if slides else rest * self._rad_per_unit,
        )

    def shapes(
        self, element: xml.Element, link: int, frame: Place, class_name: str
    ) -> Iterator[Shape]:
        """Yield the shape of a geom if it is a primitive."""
        values = self.attributes(element, class_name)
        colour = tuple(_numbers(values.get("rgba", "0.5 0.5 0.5 1"), 4))
        if "material" in values and colour == GREY:
            material = self._materials.get(values["material"], {})
            colour = tuple(_numbers(material.get("rgba", "1 1 1 1"), 4))
        hidden = int(values.get("group", "0")) >= HIDDEN_GROUP or colour[3] == 0
        kind = PRIMITIVES.get(values.get("type", "sphere"))
        if kind is None:
            return
        size, place = _numbers(values.get("size", "0")), self.place(values)
        if "fromto" in values:
            numbers = _numbers(values["fromto"], 6)
            begin, end = _vector(numbers[:3]), _vector(numbers[3:])
            along = _difference(begin, end)
            middle = _sum(begin, _difference(end, begin), 0.5)
            place, half = Place(middle, _rotation_from_z(along)), math.hypot(*along) / 2
            size = [size[0], half] if kind in ("capsule", "cylinder") else [*size[:1] * 2, half]
        vector = _vector((*size, 0.0, 0.0)[:3])
        mass = volume(kind, vector) * _numbers(values.get("density", f"{DENSITY}"), 1)[0]
        if "mass" in values:
            mass = _numbers(values["mass"], 1)[0]
        solid = any(values.get(name, "1") != "0" for name in ("contype", "conaffinity"))
        yield Shape(kind, link, vector, frame @ place, colour, mass, not hidden, solid)

    def inertial(self, element: xml.Element) -> Inertial:
        """Return the mass and inertia in an `inertial` element."""
        place, values = self.place(element.attrib), element.attrib
        if "fullinertia" in values:
            xx, yy, zz, xy, xz, yz = _numbers(values["fullinertia"], 6)
            tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            tensor = np.array(_vector(values.get("diaginertia", "0 0 0")))
        mass = _numbers(values.get("mass", "0"), 1)[0]
        return Inertial(mass, np.array(place.position), turned(tensor, place.rotation))


def _parsed(mjcf: str) -> xml.Element:
    if len(mjcf) > MAX_MODEL_CHARACTERS:
        raise ValueError(f"expected at most {MAX_MODEL_CHARACTERS} characters")
    if "<!DOCTYPE" in mjcf or "<!ENTITY" in mjcf:  # entities may expand without bound
        raise ValueError("it declares entities")
    root = xml.fromstring(mjcf)
    if root.tag != "mujoco":
        raise ValueError(f"expected the element mujoco, not {root.tag[:40]!r}")
    return root


def _link_place(link: Link, positions: Mapping[str, float]) -> Place:
    place = link.place
    for joint in link.joints:
        step = moved(joint, positions[joint.name] - joint.rest)
        # keep the anchor in place
        shift = _difference(joint.anchor, rotated(step.rotation, joint.anchor))
        place = place @ Place(_sum(step.position, shift), step.rotation)
    return place


def moved(joint: LinkJoint, way: float) -> Place:
    """Return the pose of the frame at a joint's anchor, after a displacement `way` [rad] or [m]."""
    if joint.slides:
        return Place(_sum((0.0, 0.0, 0.0), joint.axis, way))
    return Place(rotation=turn(joint.axis, way))


def turn(axis: Vector, angle: float) -> Quaternion:
    """Return the rotation about a unit vector [rad]."""
    s = math.sin(angle / 2)
    return math.cos(angle / 2), s * axis[0], s * axis[1], s * axis[2]


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation by `b`, then by `a`."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def rotated(by: Quaternion, vector: Vector) -> Vector:
    """Return a vector, rotated."""
    w, x, y, z = by
    return _vector(product(product(by, (0.0, *vector)), (w, -x, -y, -z))[1:])


def _sum(a: Vector, b: Vector, times: float = 1.0) -> Vector:
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]


def _difference(a: Vector, b: Vector) -> Vector:
    return _sum(a, b, -1.0)


def cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Return the cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _unit(values: Sequence[float]) -> list[float]:
    length = math.hypot(*values)
    if length < 1e-9:
        raise ValueError("an axis or a quaternion is zero")
    return [value / length for value in values]


def _rotation_from_z(along: Sequence[float]) -> Quaternion:
    """Return the smallest rotation that turns the z axis to a vector."""
    x, y, z = _unit(along)
    across = math.hypot(x, y)
    axis = (-y / across, x / across, 0.0) if across > 1e-9 else AXES["x"]
    return turn(axis, math.atan2(across, z))


def _rotation_from_axes(x: Sequence[float], y: Sequence[float]) -> Quaternion:
    """Return the rotation to a frame with the axis `x`, whose xy plane contains `y`."""
    a = _unit(x)
    c = _unit(cross(a, y))
    to_z = _rotation_from_z(c)
    w, i, j, k = to_z
    in_plane = rotated((w, -i, -j, -k), _vector(a))
    return product(to_z, turn(AXES["z"], math.atan2(in_plane[1], in_plane[0])))


def _vector(values: str | Sequence[float]) -> Vector:
    x, y, z = _numbers(values, 3) if isinstance(values, str) else values
    return x, y, z


def _numbers(text: str, count: int = 0) -> list[float]:
    """Return the numbers in a text. Raises ValueError unless there are `count`; 0 allows any."""
    numbers = [float(word) for word in text.split()]
    if not all(abs(number) <= MAX_NUMBER for number in numbers):
        raise ValueError(f"expected numbers, not {text[:40]!r}")
    if not numbers or (count and len(numbers) != count):
        raise ValueError(f"expected {count or 'some'} numbers, not {text[:40]!r}")
    return numbers
