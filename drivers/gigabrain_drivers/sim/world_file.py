"""World files: YAML with walls, boxes, doors, people and lights; read as a World."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct, field

from gigabrain_drivers.sim.map_world import map_world
from gigabrain_drivers.sim.tag_plates import tag_plate
from gigabrain_drivers.sim.world import (
    WALKING_SPEED,
    WALL_HALF,
    WALL_HEIGHT,
    Ball,
    Box,
    ClosedPath,
    Colour,
    Cylinder,
    Light,
    Pose,
    Shape,
    WalkingPath,
    World,
)
from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.config.loading import nearest
from gigabrain_zenoh.errors import ConfigError, listed
from gigabrain_zenoh.host.files import expanded

MAX_DISTANCE_M = 400.0  # from the origin to anything in a world
MAX_THINGS, MAX_TAGS = 200, 50
MAX_SHAPES, MAX_PEOPLE, MAX_LIGHTS, MAX_CORNERS = 4000, 16, 8, 100
MIN_PATH_M = 0.5
HALF_DOOR_M = 0.02  # half the thickness of a closed door
FLOOR = "floor"  # name of the floor's geom, material and texture

Place = Annotated[float, Meta(ge=-MAX_DISTANCE_M, le=MAX_DISTANCE_M)]  # [m]
Size = Annotated[float, Meta(ge=0.005, le=2 * MAX_DISTANCE_M)]  # [m]
Height = Annotated[float, Meta(ge=0.0, le=20.0)]  # [m], above the floor
WallHeight = Annotated[float, Meta(ge=0.05, le=20.0)]  # [m]
Angle = Annotated[float, Meta(ge=-10.0, le=10.0)]  # [rad]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Point = tuple[Place, Place]  # x, y [m]
Rgb = tuple[Share, Share, Share]
Material = Annotated[str, Meta(min_length=1, max_length=32)]

MATERIALS: dict[str, Colour] = {
    "wall": (0.93, 0.92, 0.89),
    "wood": (0.66, 0.47, 0.28),
    "dark_wood": (0.36, 0.24, 0.16),
    "carton": (0.76, 0.60, 0.42),
    "white": (0.95, 0.95, 0.95),
    "black": (0.06, 0.06, 0.07),
    "steel": (0.66, 0.69, 0.72),
    "metal": (0.80, 0.81, 0.83),
    "blue": (0.20, 0.36, 0.60),
    "teal": (0.13, 0.52, 0.53),
    "green": (0.38, 0.56, 0.36),
    "leaf": (0.20, 0.46, 0.20),
    "clay": (0.72, 0.38, 0.26),
    "orange": (0.90, 0.48, 0.16),
    "yellow": (0.94, 0.76, 0.26),
    "skin": (0.86, 0.66, 0.53),
}


class _Part(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of a world file."""


class DoorPart(_Part, frozen=True, kw_only=True):
    """An opening in a wall; if closed, with a wooden door in it."""

    at: Annotated[
        float, Meta(ge=0.0, le=2 * MAX_DISTANCE_M)
    ]  # distance of its middle from the wall's `from` [m]
    width: Annotated[float, Meta(ge=0.1, le=100.0)] = 1.0  # [m]
    closed: bool = False


class WallPart(_Part, frozen=True, kw_only=True):
    """An inner wall along a line."""

    begin: Point = field(name="from")
    end: Point = field(name="to")
    thickness: Annotated[float, Meta(ge=0.01, le=5.0)] = 2 * WALL_HALF  # [m]
    height: WallHeight | None = None  # [m]; default: the file's `wall_height`
    material: Material = "wall"
    doors: Annotated[tuple[DoorPart, ...], Meta(max_length=50)] = ()

    def __post_init__(self) -> None:
        if self.length < 0.01:
            raise ValueError("to: the wall has no length; expected another point than from")
        reached = 0.0
        for number, door in enumerate(self.doors):
            if door.at - door.width / 2 < reached - 1e-9:
                beside = "the door before it" if number else "the wall's begin"
                raise ValueError(f"doors[{number}]: it overlaps {beside}; expected them in order")
            reached = door.at + door.width / 2
            if reached > self.length + 1e-9:
                raise ValueError(
                    f"doors[{number}]: it ends at {reached:g} m, behind the wall's end "
                    f"at {self.length:g} m"
                )

    @property
    def length(self) -> float:
        """Return the length of the line [m]."""
        return math.dist(self.begin, self.end)

    def shapes(self, height: float) -> Iterator[Box]:
        """Yield the pieces between the doors, and the closed doors."""
        top = height if self.height is None else self.height
        reached = 0.0
        for door in self.doors:
            left, right = door.at - door.width / 2, door.at + door.width / 2
            if left - reached > 1e-6:
                yield self._piece(reached, left, self.thickness / 2, top, self.material)
            if door.closed:
                yield self._piece(left, right, HALF_DOOR_M, top, "wood")
            reached = right
        if self.length - reached > 1e-6:
            yield self._piece(reached, self.length, self.thickness / 2, top, self.material)

    def _piece(self, start: float, stop: float, half: float, top: float, material: str) -> Box:
        """Return the box from `start` to `stop` [m] along the wall."""
        (x, y), (to_x, to_y) = self._point(start), self._point(stop)
        if x == to_x:  # exact numbers for walls along the axes
            return slab((x - half, x + half), (min(y, to_y), max(y, to_y)), top, material)
        if y == to_y:
            return slab((min(x, to_x), max(x, to_x)), (y - half, y + half), top, material)
        yaw = math.atan2(to_y - y, to_x - x)
        middle = (x + to_x) / 2, (y + to_y) / 2
        return Box(*middle, math.dist((x, y), (to_x, to_y)) / 2, half, top, material, yaw)

    def _point(self, along: float) -> Point:
        if along == 0.0:
            return self.begin
        if along == self.length:
            return self.end
        share = along / self.length
        (x, y), (to_x, to_y) = self.begin, self.end
        return x + share * (to_x - x), y + share * (to_y - y)


class BoxPart(_Part, frozen=True, kw_only=True):
    """A box by its middle and size, or by its edges. Off the floor it is decoration only."""

    at: Point | None = None  # its middle
    size: tuple[Size, Size, Size] | None = None  # along its own x and y, and its height [m]
    yaw: Angle = 0.0  # [rad]
    bottom: Height = 0.0  # [m], above the floor
    x: tuple[Place, Place] | None = None  # from, to [m]
    y: tuple[Place, Place] | None = None  # from, to [m]
    z: tuple[Height, Height] | None = None  # bottom, top [m]
    material: Material = "orange"

    def __post_init__(self) -> None:
        edges = (self.x, self.y, self.z)
        by_size = self.at is not None and self.size is not None and edges == (None, None, None)
        by_edges = self.at is None and self.size is None and None not in edges
        if not (by_size or by_edges):
            raise ValueError("expected either `at` and `size`, or `x`, `y` and `z`")
        for name, pair in zip("xyz", edges, strict=True):
            if pair and pair[1] - pair[0] < 0.0009:
                raise ValueError(f"{name}: from {pair[0]:g} to {pair[1]:g}; expected to be larger")
        if by_edges and (self.yaw or self.bottom):
            raise ValueError("`yaw` and `bottom` are for a box with `at` and `size`")

    def shape(self) -> Box:
        """Return the box."""
        if self.at and self.size:
            half_x, half_y = self.size[0] / 2, self.size[1] / 2
            height, material = self.size[2], self.material
            return Box(*self.at, half_x, half_y, height, material, self.yaw, self.bottom)
        assert self.x
        assert self.y
        assert self.z
        return slab(self.x, self.y, self.z[1], self.material, self.z[0])


class CylinderPart(_Part, frozen=True, kw_only=True):
    """An upright cylinder. Off the floor it is decoration only."""

    at: Point
    radius: Annotated[float, Meta(ge=0.005, le=100.0)]  # [m]
    height: Annotated[float, Meta(ge=0.005, le=20.0)]  # [m]
    bottom: Height = 0.0  # [m], above the floor
    material: Material = "orange"

    def shape(self) -> Cylinder:
        """Return the cylinder."""
        return Cylinder(*self.at, self.radius, self.height, self.material, self.bottom)


class BallPart(_Part, frozen=True, kw_only=True):
    """A ball. Off the floor it is decoration only."""

    at: Point
    radius: Annotated[float, Meta(ge=0.005, le=10.0)] = 0.1  # [m]
    bottom: Height = 0.0  # [m], above the floor
    material: Material = "orange"

    def shape(self) -> Ball:
        """Return the ball."""
        return Ball(*self.at, self.radius, self.material, self.bottom)


class CanPart(_Part, frozen=True, kw_only=True):
    """A drinks can: a coloured label between two rims of metal."""

    at: Point
    radius: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.035  # [m]
    height: Annotated[float, Meta(ge=0.02, le=2.0)] = 0.12  # [m]
    material: Material = "orange"  # of its label

    def shapes(self) -> Iterator[Cylinder]:
        """Yield its cylinders; only the core stands on the floor."""
        rim = min(0.3 * self.radius, 0.2 * self.height)
        yield Cylinder(*self.at, 0.8 * self.radius, self.height, "metal")
        label = self.height - 2 * rim
        yield Cylinder(*self.at, self.radius, label, self.material, rim)
        shoulder = self.height - 2 * rim / 3
        yield Cylinder(*self.at, 0.9 * self.radius, shoulder, "metal", rim / 3)


class TagPart(_Part, frozen=True, kw_only=True):
    """An AprilTag on an upright white plate. It is decoration only."""

    id: Annotated[int, Meta(ge=0, le=10_000)]
    at: Point  # the centre of its face
    yaw: Angle = 0.0  # direction that it faces [rad]
    z: Annotated[float, Meta(ge=0.02, le=20.0)] = 0.3  # its middle, above the floor [m]
    size: Annotated[float, Meta(ge=0.01, le=10.0)] = 0.16  # of its black square [m]
    family: Literal["36h11", "36h10", "25h9", "16h5"] = "36h11"

    def shapes(self) -> list[Box]:
        """Return the boxes of plate and tag. Raises ConfigError for an unknown tag."""
        face = Pose(self.at[0], self.at[1], self.yaw)
        return tag_plate(self.id, self.family, face, self.z, self.size)


class PersonPart(_Part, frozen=True, kw_only=True):
    """A person who walks round a closed path; with two points, back and forth."""

    path: Annotated[tuple[Point, ...], Meta(min_length=2, max_length=MAX_CORNERS)]
    speed: Annotated[float, Meta(ge=0.05, le=3.0)] = WALKING_SPEED  # [m/s]

    def __post_init__(self) -> None:
        length = ClosedPath(self.path).length
        if length < MIN_PATH_M:
            raise ValueError(f"path: {length:g} m round; expected at least {MIN_PATH_M:g} m")


class LightPart(_Part, frozen=True, kw_only=True):
    """A lamp at a point, or a sun that shines in a direction."""

    at: tuple[Place, Place, Place] | None = None
    direction: tuple[Place, Place, Place] | None = None
    colour: Rgb = (0.62, 0.60, 0.56)

    def __post_init__(self) -> None:
        if (self.at is None) == (self.direction is None):
            raise ValueError("expected either `at`, of a lamp, or `direction`, of a sun")
        if self.direction and self.direction[2] >= 0:
            raise ValueError(f"direction: z is {self.direction[2]:g}; expected to shine downwards")

    def light(self) -> Light:
        """Return the light."""
        return Light(self.colour, self.at, self.direction or (0.0, 0.0, -1.0))


class FloorPart(_Part, frozen=True, kw_only=True):
    """The look of the floor."""

    colours: tuple[Rgb, Rgb] = World.floor  # of its two checks
    check: tuple[Size, Size] = World.check  # size of a check [m]


class WorldFile(_Part, frozen=True, kw_only=True):
    """A world file. The origin is the middle of the floor; x is east, y north."""

    description: Annotated[str, Meta(max_length=200)] = ""
    size: tuple[Size, Size] | None = None  # of the floor inside the outer walls [m]
    outer_walls: bool = True
    wall_height: WallHeight = WALL_HEIGHT  # [m]
    floor: FloorPart = FloorPart()
    materials: Annotated[dict[Material, Rgb], Meta(max_length=100)] = field(default_factory=dict)
    start: tuple[Place, Place, Angle] | None = None  # of the robot: x, y [m], yaw [rad]
    walls: Annotated[tuple[WallPart, ...], Meta(max_length=MAX_SHAPES)] = ()
    boxes: Annotated[tuple[BoxPart, ...], Meta(max_length=MAX_SHAPES)] = ()
    cylinders: Annotated[tuple[CylinderPart, ...], Meta(max_length=MAX_SHAPES)] = ()
    balls: Annotated[tuple[BallPart, ...], Meta(max_length=MAX_THINGS)] = ()
    cans: Annotated[tuple[CanPart, ...], Meta(max_length=MAX_THINGS)] = ()
    tags: Annotated[tuple[TagPart, ...], Meta(max_length=MAX_TAGS)] = ()
    people: Annotated[tuple[PersonPart, ...], Meta(max_length=MAX_PEOPLE)] = ()
    lights: Annotated[tuple[LightPart, ...], Meta(max_length=MAX_LIGHTS)] = ()
    map: str = ""  # YAML file of a ROS map whose occupied cells become walls
    model: str = ""  # MJCF file that is part of the world

    def __post_init__(self) -> None:
        if self.size is None and not (self.map or self.model):
            raise ValueError("size: missing; expected the floor's [x, y] in metres")
        for name in self.materials:
            if name in (*MATERIALS, FLOOR):
                raise ValueError(f"materials: {name!r} is there already; choose another name")
        known = (*MATERIALS, *self.materials)
        for part in ("walls", "boxes", "cylinders", "balls", "cans"):
            for number, one in enumerate(getattr(self, part)):
                if one.material not in known:
                    hint = nearest(one.material, known) or f"; known: {listed(known)}"
                    raise ValueError(f"{part}[{number}]: no material {one.material!r}{hint}")


def slab(
    x: tuple[float, float], y: tuple[float, float], top: float, material: str, bottom: float = 0.0
) -> Box:
    """Return a box by its edges: `x[0]` to `x[1]`, `y[0]` to `y[1]`, `bottom` to `top`."""
    middle, half = (x[0] + x[1]) / 2, (x[1] - x[0]) / 2
    return Box(
        middle, (y[0] + y[1]) / 2, half, (y[1] - y[0]) / 2, top - bottom, material, 0, bottom
    )


@contextmanager
def errors_at(path: Path, place: Sequence[str], shown: str) -> Iterator[None]:
    """Add the file and the line of a part to ConfigErrors of the block."""
    try:
        yield
    except ConfigError as error:
        line = config.line_in(path, place) or 1
        raise ConfigError(f"{path}:{line}: {shown}: {error}") from None


def read_world(path: Path) -> World:
    """Return the world of a YAML file. Raises ConfigError with the line."""
    return build_world(config.load(path, WorldFile), path)


def build_world(file: WorldFile, path: Path) -> World:
    """Return the world that a file describes; files that it names are relative to `path`."""
    shapes: list[Shape] = [box for wall in file.walls for box in wall.shapes(file.wall_height)]
    shapes += [part.shape() for part in file.boxes]
    shapes += [part.shape() for part in file.cylinders]
    shapes += [part.shape() for part in file.balls]
    shapes += [shape for part in file.cans for shape in part.shapes()]
    for number, tag in enumerate(file.tags):
        with errors_at(path, ("tags", str(number)), f"tags[{number}]"):
            shapes += tag.shapes()
    size = file.size or (2.0, 2.0)  # the map or the model enlarges it
    world = World(
        name=path.stem,
        description=file.description,
        half_x=size[0] / 2,
        half_y=size[1] / 2,
        shapes=tuple(shapes),
        outer_walls=file.outer_walls and file.size is not None,
        wall_height=file.wall_height,
        floor=file.floor.colours,
        check=file.floor.check,
        materials=file.materials,
        people=tuple(WalkingPath(one.path, one.speed) for one in file.people),
        lights=tuple(one.light() for one in file.lights),
        start=Pose(*(file.start or (0.0, 0.0, 0.0))),
        start_fixed=file.start is not None,
        model=path.parent / expanded(file.model) if file.model else None,
        file=path,
    )
    if file.map:
        with errors_at(path, ("map",), "map"):
            extruded = map_world(path.parent / expanded(file.map), file.wall_height)
        world = replace(
            extruded,
            name=world.name,
            description=world.description or extruded.description,
            shapes=extruded.shapes + world.shapes,
            outer_walls=file.outer_walls,
            floor=world.floor,
            check=world.check,
            materials=world.materials,
            people=world.people,
            lights=world.lights,
            start=world.start,
            start_fixed=world.start_fixed,
            model=world.model,
            file=path,
        )
    if len(world.shapes) > MAX_SHAPES:
        raise ConfigError(f"{path}: {len(world.shapes)} shapes; expected at most {MAX_SHAPES}")
    return world
