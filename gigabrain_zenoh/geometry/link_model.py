"""The links of an arm, their shapes and masses, from the text of its MJCF model.

Read without MuJoCo, which viewers do not need. Read is what MuJoCo's reference calls body, frame,
inertial, joint, geom and site, with defaults, materials and joint equalities; not meshes.
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
    moments,
    together,
    turned,
    volume,
)

MAX_LINKS, MAX_SHAPES = 200, 1000
MAX_NUMBER = 1e6
HIDDEN_GROUP = 3  # geoms of this group and above are shapes for collisions
GREY = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's colour of a geom that has none
KINDS: dict[str, ShapeKind] = {
    kind: kind for kind in get_args(ShapeKind) if kind not in ("plane", "mesh")
}
STILL = ("free", "ball")  # joints that have no position of their own
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z
AXES: dict[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class Place(NamedTuple):
    """A pose in another frame."""

    position: Vector = (0.0, 0.0, 0.0)  # [m]
    rotation: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def __matmul__(self, other: "Place") -> "Place":
        """Return a pose of this frame in the frame that this one is given in."""
        turned = rotated(self.rotation, other.position)
        return Place(_sum(self.position, turned), product(self.rotation, other.rotation))


class LinkJoint(NamedTuple):
    """A joint of one degree of freedom."""

    name: str
    axis: Vector
    anchor: Vector  # [m]
    slides: bool
    rest: float  # [rad] or [m], its position in which the link is where the model has it


class Link(NamedTuple):
    """A body of the model, or a site on one. A parent comes before its links."""

    name: str
    parent: int
    place: Place  # in its parent, with all joints at rest
    joints: tuple[LinkJoint, ...] = ()


class Shape(NamedTuple):
    """A primitive shape on a link."""

    kind: ShapeKind
    link: int
    size: Vector  # [m]; half sides or half axes; radius and half the length; radius
    place: Place
    colour: tuple[float, ...]  # red, green, blue and alpha of 0 to 1
    mass: float  # [kg]
    seen: bool
    solid: bool  # touches other things

    @property
    def inertial(self) -> Inertial:
        """Its inertia in the frame of its link."""
        tensor = turned(moments(self.kind, self.size, self.mass), self.place.rotation)
        return Inertial(self.mass, np.array(self.place.position), tensor)


class Follower(NamedTuple):
    """A joint that moves with another one, both from where they are at rest."""

    name: str
    leader: str
    polynomial: list[float]  # of the leader's way


class LinkModel:
    """An arm as a tree of links. `links[0]` is the frame of the model, which is the robot's base.

    A root that can move freely, as that of a driving robot, is where that frame is.
    """

    def __init__(self, mjcf: str) -> None:
        """Read a model. Raises ConfigError, in one line, for text that is none."""
        self.links, self.every_shape = [Link("", -1, Place())], list[Shape]()
        self.followers = list[Follower]()
        self._inertials = dict[int, Inertial]()  # that the model gives, by link
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
        """The shapes that are to be seen."""
        return [shape for shape in self.every_shape if shape.seen]

    def inertial(self, link: int) -> Inertial | None:
        """Return the inertia of a link in its frame; None for one without mass."""
        if link in self._inertials:
            return self._inertials[link]
        return together(shape.inertial for shape in self.every_shape if shape.link == link)

    def places(self, positions: Mapping[str, float]) -> list[Place]:
        """Return the pose of each link in its parent, for positions of joints [rad or m].

        Joints without a position are at rest, or follow another one by an equality.
        """
        at = {name: positions.get(name, rest) for name, rest in self._rests.items()}
        for follower, leader, polynomial in self.followers:
            if follower not in positions and follower in at and leader in at:
                way = at[leader] - self._rests[leader]
                shift = sum(factor * way**power for power, factor in enumerate(polynomial))
                at[follower] = self._rests[follower] + shift
        return [_at(link, at) for link in self.links]

    def places_in_base(self, positions: Mapping[str, float]) -> list[Place]:
        """Return the pose of each link in the frame of the model, likewise."""
        found = list[Place]()
        for link, place in zip(self.links, self.places(positions), strict=True):
            found.append(found[link.parent] @ place if link.parent >= 0 else place)
        return found

    def place_in_base(self, name: str, positions: Mapping[str, float]) -> Place:
        """Return the pose of the link with this name, likewise. Raises ValueError for no such."""
        number = [link.name for link in self.links].index(name)
        return self.places_in_base(positions)[number]

    def _add(self, top: xml.Element, reader: "_Reader") -> None:
        """Add the links and shapes below an element, without recursion: a text may be deep."""
        waiting: list[tuple[xml.Element, int, Place, str]] = [(top, 0, Place(), "")]
        while waiting:
            element, link, within, kind = waiting.pop()
            kind = element.get("childclass", kind)
            for child in element:
                if child.tag == "geom":
                    self.every_shape += reader.shapes(child, link, within, kind)
                elif child.tag == "inertial":
                    self._inertials[link] = reader.inertial(child)
                elif child.tag == "frame":
                    waiting.append((child, link, within @ reader.place(child.attrib), kind))
                elif child.tag in ("body", "site"):
                    self._add_link(child, link, within, reader, kind)
                    waiting.append((child, len(self.links) - 1, Place(), kind))
            if len(self.links) > MAX_LINKS or len(self.every_shape) > MAX_SHAPES:
                raise ValueError(f"more than {MAX_LINKS} links or {MAX_SHAPES} shapes")

    def _add_link(
        self, element: xml.Element, parent: int, within: Place, reader: "_Reader", kind: str
    ) -> None:
        name = element.get("name") or f"{element.tag} {len(self.links)}"
        if any(link.name == name for link in self.links):
            name = f"{element.tag} {name}"  # bodies and sites may share one
        attributes = reader.attributes(element, kind) if element.tag == "site" else element.attrib
        place = within @ reader.place(attributes)
        free = element.find("freejoint") is not None
        joints = []
        for child in element.iterfind("joint"):
            values = reader.attributes(child, element.get("childclass", kind))
            free = free or values.get("type") in STILL
            if values.get("type") not in STILL:
                joints.append(reader.joint(values))
        self.links.append(Link(name, parent, Place() if free else place, tuple(joints)))

    def _read_equalities(self, root: xml.Element) -> None:
        for one in root.iterfind("equality/joint"):
            polynomial = _numbers(one.get("polycoef", "0 1 0 0 0"))
            names = one.get("joint1", ""), one.get("joint2", "")
            self.followers.append(Follower(*names, polynomial[:5]))


class _Reader:
    """Reads elements by the defaults and units of their model."""

    def __init__(self, root: xml.Element) -> None:
        compiler = {k: v for one in root.iterfind("compiler") for k, v in one.attrib.items()}
        self._angle = 1.0 if compiler.get("angle") == "radian" else math.pi / 180
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

    def attributes(self, element: xml.Element, kind: str) -> dict[str, str]:
        """Return an element's attributes with the defaults of its class."""
        defaults = self._defaults.get(element.get("class", kind))
        if defaults is None:
            raise ValueError(f"unknown class {element.get('class', kind)!r}")
        return defaults.get(element.tag, {}) | element.attrib

    def place(self, values: Mapping[str, str]) -> Place:
        """Return the pose that attributes give."""
        return Place(_vector(values.get("pos", "0 0 0")), self._rotation(values))

    def _rotation(self, values: Mapping[str, str]) -> Quaternion:
        if "axisangle" in values:
            x, y, z, angle = _numbers(values["axisangle"], 4)
            return turn(_vector(_unit((x, y, z))), angle * self._angle)
        if "xyaxes" in values:
            numbers = _numbers(values["xyaxes"], 6)
            return _of_axes(numbers[:3], numbers[3:])
        if "zaxis" in values:
            return _of_z(_vector(values["zaxis"]))
        if "euler" in values:
            found = Place().rotation
            for name, angle in zip(self._sequence, _vector(values["euler"]), strict=True):
                about = turn(AXES[name.lower()], angle * self._angle)
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
            rest=rest if slides else rest * self._angle,
        )

    def shapes(self, element: xml.Element, link: int, within: Place, kind: str) -> Iterator[Shape]:
        """Yield the shape of a geom, if it is a primitive one."""
        values = self.attributes(element, kind)
        colour = tuple(_numbers(values.get("rgba", "0.5 0.5 0.5 1"), 4))
        if "material" in values and colour == GREY:
            painted = self._materials.get(values["material"], {})
            colour = tuple(_numbers(painted.get("rgba", "1 1 1 1"), 4))
        hidden = int(values.get("group", "0")) >= HIDDEN_GROUP or colour[3] == 0
        found = KINDS.get(values.get("type", "sphere"))
        if found is None:
            return
        size, place = _numbers(values.get("size", "0")), self.place(values)
        if "fromto" in values:
            numbers = _numbers(values["fromto"], 6)
            begin, end = _vector(numbers[:3]), _vector(numbers[3:])
            along = _difference(begin, end)
            middle = _sum(begin, _difference(end, begin), 0.5)
            place, half = Place(middle, _of_z(along)), math.hypot(*along) / 2
            size = [size[0], half] if found in ("capsule", "cylinder") else [*size[:1] * 2, half]
        vector = _vector((*size, 0.0, 0.0)[:3])
        mass = volume(found, vector) * _numbers(values.get("density", f"{DENSITY}"), 1)[0]
        if "mass" in values:
            mass = _numbers(values["mass"], 1)[0]
        solid = any(values.get(name, "1") != "0" for name in ("contype", "conaffinity"))
        yield Shape(found, link, vector, within @ place, colour, mass, not hidden, solid)

    def inertial(self, element: xml.Element) -> Inertial:
        """Return what an element says of its link's mass."""
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
    if "<!DOCTYPE" in mjcf or "<!ENTITY" in mjcf:  # its entities may grow without end
        raise ValueError("it declares entities")
    root = xml.fromstring(mjcf)
    if root.tag != "mujoco":
        raise ValueError(f"expected the element mujoco, not {root.tag[:40]!r}")
    return root


def _at(link: Link, at: Mapping[str, float]) -> Place:
    place = link.place
    for joint in link.joints:
        step = moved(joint, at[joint.name] - joint.rest)
        shift = _difference(joint.anchor, rotated(step.rotation, joint.anchor))  # which stays
        place = place @ Place(_sum(step.position, shift), step.rotation)
    return place


def moved(joint: LinkJoint, way: float) -> Place:
    """Return the pose of a frame at a joint's anchor once it has moved by `way` [rad] or [m]."""
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


def _of_z(along: Sequence[float]) -> Quaternion:
    """Return the smallest rotation that turns the z axis to a vector."""
    x, y, z = _unit(along)
    across = math.hypot(x, y)
    axis = (-y / across, x / across, 0.0) if across > 1e-9 else AXES["x"]
    return turn(axis, math.atan2(across, z))


def _of_axes(x: Sequence[float], y: Sequence[float]) -> Quaternion:
    """Return the rotation to a frame of which the x axis and the plane to y are given."""
    a = _unit(x)
    c = _unit(cross(a, y))
    to_z = _of_z(c)
    w, i, j, k = to_z
    in_plane = rotated((w, -i, -j, -k), _vector(a))
    return product(to_z, turn(AXES["z"], math.atan2(in_plane[1], in_plane[0])))


def _vector(values: str | Sequence[float]) -> Vector:
    x, y, z = _numbers(values, 3) if isinstance(values, str) else values
    return x, y, z


def _numbers(text: str, count: int = 0) -> list[float]:
    """Return the numbers in a text; raises ValueError for others than `count` of them."""
    numbers = [float(word) for word in text.split()]
    if not all(abs(number) <= MAX_NUMBER for number in numbers):
        raise ValueError(f"expected numbers, not {text[:40]!r}")
    if not numbers or (count and len(numbers) != count):
        raise ValueError(f"expected {count or 'some'} numbers, not {text[:40]!r}")
    return numbers
