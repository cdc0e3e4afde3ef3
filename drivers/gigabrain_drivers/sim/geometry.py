"""Plane geometry of upright things: boxes, cylinders, outlines and paths. Metres and radians."""

import bisect
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple


class Pose(NamedTuple):
    """A place in the plane and a heading."""

    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad], counter-clockwise from x


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box, turned by `yaw` about its middle. Off the floor it is decoration only."""

    x: float
    y: float
    half_x: float
    half_y: float
    height: float
    material: str = "wall"
    yaw: float = 0.0
    bottom: float = 0.0

    def distance(self, x: float, y: float) -> float:
        """How far the point is from the outline [m]; 0 inside."""
        dx, dy = x - self.x, y - self.y
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        beside_x = max(abs(cos * dx + sin * dy) - self.half_x, 0.0)
        beside_y = max(abs(cos * dy - sin * dx) - self.half_y, 0.0)
        return math.hypot(beside_x, beside_y)


@dataclass(frozen=True, slots=True)
class Cylinder:
    """An upright cylinder. Off the floor it is decoration only."""

    x: float
    y: float
    radius: float
    height: float
    material: str = "wall"
    bottom: float = 0.0

    def distance(self, x: float, y: float) -> float:
        """How far the point is from the outline [m]; 0 inside."""
        return max(math.hypot(x - self.x, y - self.y) - self.radius, 0.0)


Shape = Box | Cylinder


def clearance(shapes: Iterable[Shape], x: float, y: float) -> float:
    """The distance from a point to the nearest shape that stands on the floor [m]."""
    return min(shape.distance(x, y) for shape in shapes if shape.bottom == 0)


@dataclass(frozen=True, slots=True)
class Footprint:
    """The rectangle that a robot covers, in its base frame."""

    front: float  # [m], x of the foremost edge
    rear: float  # [m], x of the rearmost edge, negative
    half_width: float  # [m]

    def distance(self, pose: Pose, x: float, y: float) -> float:
        """How far a point of the world is from the robot's outer edge [m]; 0 inside."""
        dx, dy = x - pose.x, y - pose.y
        cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        beside_x = max(ahead - self.front, self.rear - ahead, 0.0)
        return math.hypot(beside_x, max(abs(left) - self.half_width, 0.0))


class ClosedPath:
    """A closed polyline that is walked by arc length, in the order of its corners."""

    def __init__(self, corners: Sequence[tuple[float, float]]) -> None:
        self._corners = list(corners)
        self._starts: list[float] = []
        self._headings: list[float] = []
        self.length = 0.0
        for here, there in zip(corners, [*corners[1:], corners[0]], strict=True):
            dx, dy = there[0] - here[0], there[1] - here[1]
            self._starts.append(self.length)
            self._headings.append(math.atan2(dy, dx))
            self.length += math.hypot(dx, dy)

    def at(self, distance: float) -> Pose:
        """The pose `distance` metres along the path; it wraps round."""
        distance %= self.length
        leg = bisect.bisect_right(self._starts, distance) - 1
        (x, y), along, yaw = self._corners[leg], distance - self._starts[leg], self._headings[leg]
        return Pose(x + along * math.cos(yaw), y + along * math.sin(yaw), yaw)
