"""Worlds: upright shapes in a walled rectangle, and a start. Metres and radians."""

import bisect
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.config.loading import line_in

WALL_HEIGHT = 0.6  # [m], well above the lidar of any shipped robot
WALL_HALF = 0.05  # [m]
WALKING_SPEED = 0.8  # [m/s]
Corners = tuple[tuple[float, float], ...]
Colour = tuple[float, float, float]


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
        """Return the distance of a point from the outline [m]; 0 inside."""
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
        """Return the distance of a point from the outline [m]; 0 inside."""
        return max(math.hypot(x - self.x, y - self.y) - self.radius, 0.0)


@dataclass(frozen=True, slots=True)
class Ball:
    """A ball. Off the floor it is decoration only."""

    x: float
    y: float
    radius: float
    material: str = "wall"
    bottom: float = 0.0

    @property
    def height(self) -> float:
        """Return its diameter [m]."""
        return 2 * self.radius

    def distance(self, x: float, y: float) -> float:
        """Return the distance of a point from the outline [m]; 0 inside."""
        return max(math.hypot(x - self.x, y - self.y) - self.radius, 0.0)


Shape = Box | Cylinder | Ball


def clearance(shapes: Iterable[Shape], x: float, y: float) -> float:
    """Return the distance from a point to the nearest shape that stands on the floor [m]."""
    return min((s.distance(x, y) for s in shapes if s.bottom == 0), default=math.inf)


@dataclass(frozen=True, slots=True)
class Footprint:
    """The rectangle that a robot covers, in its base frame."""

    front: float  # [m], x of the foremost edge
    rear: float  # [m], x of the rearmost edge, negative
    half_width: float  # [m]

    def distance(self, pose: Pose, x: float, y: float) -> float:
        """Return the distance of a world point from the robot's edge [m]; 0 inside."""
        dx, dy = x - pose.x, y - pose.y
        cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        beside_x = max(ahead - self.front, self.rear - ahead, 0.0)
        return math.hypot(beside_x, max(abs(left) - self.half_width, 0.0))


class ClosedPath:
    """A closed polyline, parametrized by arc length, in the order of its corners."""

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
        """Return the pose `distance` metres along the path; it wraps round."""
        distance %= self.length
        leg = bisect.bisect_right(self._starts, distance) - 1
        (x, y), along, yaw = self._corners[leg], distance - self._starts[leg], self._headings[leg]
        return Pose(x + along * math.cos(yaw), y + along * math.sin(yaw), yaw)


class Stream(IntEnum):
    """The purpose of a random stream. Do not reuse numbers, so that old runs stay the same."""

    LAYOUT = 0
    START = 1
    LIDAR = 2
    IMU = 3
    CAMERA = 4


def generator(seed: int, stream: Stream) -> np.random.Generator:
    """Return the random generator of one stream of `seed` (>= 0)."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))


ORIGIN = Pose(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class WalkingPath:
    """The closed path of a person, who walks it again and again."""

    corners: Corners
    speed: float = WALKING_SPEED  # [m/s]
    start: float = 0.0  # along the path [m]


@dataclass(frozen=True, slots=True)
class Light:
    """A lamp at `position`, or without one a sun that shines along `direction`."""

    colour: Colour
    position: tuple[float, float, float] | None = None  # [m]
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)


@dataclass(frozen=True, kw_only=True)
class World:
    """A place for a robot. Lengths in metres."""

    name: str
    description: str
    half_x: float  # of the floor, to the inner face of the outer walls
    half_y: float
    middle: tuple[float, float] = (0.0, 0.0)  # of the floor
    shapes: tuple[Shape, ...]  # without the outer walls
    outer_walls: bool = True
    wall_height: float = WALL_HEIGHT
    floor: tuple[Colour, Colour] = ((0.62, 0.66, 0.70), (0.58, 0.62, 0.66))  # its two checks
    check: tuple[float, float] = (0.5, 0.5)  # size of a check
    materials: Mapping[str, Colour] = field(default_factory=dict)  # besides those of all worlds
    people: tuple[WalkingPath, ...] = ()
    lights: tuple[Light, ...] = ()  # none: a low sun
    start: Pose = ORIGIN  # of the robot
    start_fixed: bool = False  # the start is from the world's file, not random
    free: NDArray[np.float64] | None = field(default=None, compare=False)
    # (n, 2) possible starts; None: anywhere
    model: Path | None = None  # MJCF file that is part of this world
    outlines: tuple[Shape, ...] = ()  # of the obstacles in the model
    file: Path | None = field(default=None, compare=False)  # of the world

    def start_place(self) -> str:
        """Return the file and the line of the start, or the world's name, for errors."""
        if self.file is None:
            return f"world {self.name}"
        line = None if self.file == self.model else line_in(self.file, ("start",))
        return f"{self.file}:{line or 1}"

    def walls(self) -> tuple[Box, ...]:
        """Return the four outer walls."""
        if not self.outer_walls:
            return ()
        x, y, half, height = self.half_x, self.half_y, WALL_HALF, self.wall_height
        east, north = self.middle
        return (
            Box(east, north + y + half, x + 2 * half, half, height),
            Box(east, north - y - half, x + 2 * half, half, height),
            Box(east + x + half, north, half, y, height),
            Box(east - x - half, north, half, y, height),
        )

    def everything(self) -> tuple[Shape, ...]:
        """Return all shapes, including the outer walls."""
        return (*self.walls(), *self.shapes)

    def obstacles(self) -> tuple[Shape, ...]:
        """Return all shapes that a robot may hit, including the model's outlines."""
        return (*self.everything(), *self.outlines)
