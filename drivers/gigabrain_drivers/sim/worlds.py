"""Worlds by name: an arena, a house and a warehouse drawn by hand, and random layouts.

Free passages are at least 1.1 m wide (doors 1.0 m) and everything else is flush, so a robot that
only looks a metre ahead and turns right can roam without end.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gigabrain_drivers.sim.world import (
    WALL_HALF,
    Box,
    ClosedPath,
    Corners,
    Cylinder,
    Pose,
    Shape,
    Stream,
    World,
    clearance,
    generator,
)
from gigabrain_zenoh.errors import UnknownName, unknown

RANDOM_HALF_M = 3.5
PASSAGE_M = 1.15  # the least gap that a robot may find; narrower ones are closed
MAX_FREE, MAX_BY_WALL = 8, 5  # obstacles, at most
MIN_OBSTACLES = 10
LAYOUT_ATTEMPTS = 400  # for one layout
OBSTACLE_MATERIALS = ("orange", "teal", "yellow", "blue", "green", "clay")
Placed = tuple[Shape, float]  # a shape and the radius of the circle round it
START_CLEARANCE_M = 0.6  # from the robot's origin to anything that stands
PERSON_CLEARANCE_M = 1.5  # from the robot's origin to the person's middle
RANDOM = "random:"


def slab(
    x: tuple[float, float], y: tuple[float, float], top: float, material: str, bottom: float = 0.0
) -> Box:
    """A box by its edges: from `x[0]` to `x[1]`, `y[0]` to `y[1]`, `bottom` to `top`."""
    middle, half = (x[0] + x[1]) / 2, (x[1] - x[0]) / 2
    return Box(
        middle, (y[0] + y[1]) / 2, half, (y[1] - y[0]) / 2, top - bottom, material, 0, bottom
    )


def arena() -> World:
    """Eight pillars in a square room."""
    return World(
        name="arena",
        description="a square room of 6.4 m with eight round and square pillars",
        half_x=3.2,
        half_y=3.2,
        floor=((0.44, 0.53, 0.62), (0.40, 0.49, 0.58)),
        shapes=(
            Cylinder(-1.75, -1.72, 0.18, 0.6, "orange"),
            Box(0.05, -1.8, 0.15, 0.15, 0.6, "teal", 0.4),
            Cylinder(1.78, -1.7, 0.2, 0.6, "yellow"),
            Box(-1.75, 0.1, 0.16, 0.16, 0.6, "yellow", 0.15),
            Box(1.78, 0.05, 0.15, 0.15, 0.6, "orange", 0.7),
            Cylinder(-1.7, 1.78, 0.2, 0.6, "teal"),
            Cylinder(0.1, 1.75, 0.17, 0.6, "orange"),
            Box(1.75, 1.78, 0.16, 0.16, 0.6, "teal", 1.1),
        ),
    )


def _wall(x: tuple[float, float], y: tuple[float, float], height: float) -> Box:
    """An inner wall along the line from (x[0], y[0]) to (x[1], y[1])."""
    half = WALL_HALF
    if x[0] == x[1]:
        return slab((x[0] - half, x[0] + half), y, height, "wall")
    return slab(x, (y[0] - half, y[0] + half), height, "wall")


def _house_walls(height: float) -> tuple[Box, ...]:
    """Inner walls with six doors of 1.0 m: every room has at least two."""
    return (
        _wall((-4.5, -3.2), (0, 0), height),
        _wall((-2.2, -0.7), (0, 0), height),
        _wall((0.3, 2.5), (0, 0), height),
        _wall((3.5, 4.5), (0, 0), height),
        _wall((0.8, 0.8), (-3.5, -2.2), height),
        _wall((0.8, 0.8), (-1.2, -0.05), height),
        _wall((-1.2, -1.2), (0.05, 1.2), height),
        _wall((-1.2, -1.2), (2.2, 3.5), height),
        _wall((1.6, 1.6), (0.05, 1.5), height),
        _wall((1.6, 1.6), (2.5, 3.5), height),
    )


def _living_room() -> tuple[Shape, ...]:
    return (
        slab((-4.5, -3.7), (-2.65, -1.2), 0.34, "blue"),  # sofa: seat, back, arms, cushion
        slab((-4.5, -4.28), (-2.65, -1.2), 0.66, "blue", 0.34),
        slab((-4.28, -3.72), (-2.65, -2.47), 0.5, "blue", 0.34),
        slab((-4.28, -3.72), (-1.38, -1.2), 0.5, "blue", 0.34),
        slab((-4.25, -4.13), (-2.3, -1.9), 0.58, "yellow", 0.34),
        slab((-4.5, -3.8), (-3.5, -2.65), 0.4, "wood"),  # side table
        Cylinder(-4.15, -3.1, 0.12, 0.3, "clay", 0.4),
        Cylinder(-2.05, -1.62, 0.16, 0.36, "dark_wood"),  # coffee table
        Cylinder(-2.05, -1.62, 0.34, 0.04, "wood", 0.36),
        slab((-2.6, -1.0), (-3.5, -3.12), 0.4, "dark_wood"),  # television on its bench
        slab((-2.3, -1.3), (-3.4, -3.35), 0.98, "black", 0.42),
        slab((0.4, 0.75), (-3.5, -2.35), 1.1, "wood"),  # bookshelf
        Cylinder(0.57, -0.24, 0.16, 0.3, "clay"),  # plant
        Cylinder(0.57, -0.24, 0.13, 0.32, "leaf", 0.3),
    )


def _kitchen() -> tuple[Shape, ...]:
    return (
        slab((1.55, 4.5), (-3.5, -2.9), 0.78, "white"),  # counter
        slab((1.55, 4.5), (-3.5, -2.88), 0.82, "dark_wood", 0.78),
        slab((0.85, 1.55), (-3.5, -2.85), 1.2, "steel"),  # fridge
        slab((2.55, 3.35), (-1.75, -1.15), 0.62, "wood"),  # table
        slab((2.5, 3.4), (-1.8, -1.1), 0.66, "wood", 0.62),
        Cylinder(2.95, -1.45, 0.12, 0.05, "orange", 0.66),
    )


def _north_rooms() -> tuple[Shape, ...]:
    return (
        slab((-4.5, -3.1), (1.4, 3.5), 0.28, "wood"),  # bed
        slab((-4.48, -3.12), (1.42, 3.45), 0.42, "white", 0.28),
        slab((-4.48, -3.12), (1.42, 2.7), 0.46, "green", 0.42),
        slab((-4.2, -3.4), (2.95, 3.35), 0.5, "white", 0.42),
        slab((-1.65, -1.25), (0.05, 0.85), 0.8, "wood"),  # chest of drawers
        slab((-1.15, 0.4), (2.9, 3.5), 0.64, "dark_wood"),  # desk
        slab((-0.7, 0.0), (3.3, 3.34), 1.0, "black", 0.66),
        slab((0.4, 1.55), (3.15, 3.5), 1.1, "wood"),  # bookshelf
        slab((3.75, 4.5), (1.75, 3.5), 0.5, "white"),  # bath
        slab((3.85, 4.4), (1.85, 3.4), 0.51, "teal", 0.5),
        slab((1.65, 2.25), (2.9, 3.5), 0.8, "steel"),  # washing machine
        slab((3.95, 4.5), (0.05, 0.55), 0.8, "white"),  # basin
    )


def house() -> World:
    """Five furnished rooms, in a ring with doors."""
    return World(
        name="house",
        description="five furnished rooms of 9 x 7 m, joined by doors of 1.0 m",
        half_x=4.5,
        half_y=3.5,
        wall_height=1.2,
        floor=((0.72, 0.58, 0.43), (0.69, 0.55, 0.41)),
        check=(0.9, 0.12),
        shapes=(*_house_walls(1.2), *_living_room(), *_kitchen(), *_north_rooms()),
    )


def _rack(x: tuple[float, float], y: float) -> tuple[Shape, ...]:
    """A shelf .5 m deep along x: solid to .5 m, with cartons on two boards above."""
    half = 0.25
    boards = [
        slab((x[0], x[1]), (y - half, y + half), bottom + 0.06, "orange", bottom)
        for bottom in (0.5, 1.0)
    ]
    posts = [
        slab((at, at + 0.06), (y - half, y + half), 1.5, "blue", 0.56) for at in (x[0], x[1] - 0.06)
    ]
    cartons = [
        slab((left, left + width), (y - 0.2, y + 0.2), bottom + height, "carton", bottom)
        for bottom, row in ((0.56, 0.0), (1.06, 0.25))
        for left, width, height in (
            (x[0] + 0.15 + row, 0.5, 0.34),
            (x[0] + 0.85 + row, 0.4, 0.28),
            (x[0] + 1.6 + row, 0.6, 0.36),
        )
    ]
    return (slab(x, (y - half, y + half), 0.5, "steel"), *boards, *posts, *cartons)


def warehouse() -> World:
    """Return six racks, aisles of 1.6 m, and a person that walks round the middle row."""
    racks = [_rack(x, y) for x in ((-4.0, -1.0), (1.0, 4.0)) for y in (-2.125, 0.0, 2.125)]
    path: Corners = ((-5.0, -1.06), (5.0, -1.06), (5.0, 1.06), (-5.0, 1.06))
    return World(
        name="warehouse",
        description="six racks with aisles of 1.6 m in 12 x 8 m, and a person walking round",
        half_x=6.0,
        half_y=4.0,
        floor=((0.60, 0.61, 0.62), (0.57, 0.58, 0.59)),
        shapes=(
            *(shape for rack in racks for shape in rack),
            slab((5.3, 6.0), (3.3, 4.0), 0.45, "carton"),
            slab((-6.0, -5.3), (-4.0, -3.2), 0.4, "wood"),
        ),
        path=path,
    )


def random_world(seed: int) -> World:
    """Return 10 to 13 obstacles in 7 x 7 m, with gaps of none or at least 1.15 m."""
    random = generator(seed, Stream.LAYOUT)
    placed = _layout(random)
    while len(placed) < MIN_OBSTACLES:
        placed = _layout(random)
    return World(
        name=f"random:{seed}",
        description="10 to 13 obstacles in 7 x 7 m, drawn from SEED",
        half_x=RANDOM_HALF_M,
        half_y=RANDOM_HALF_M,
        floor=((0.56, 0.60, 0.55), (0.52, 0.56, 0.51)),
        shapes=tuple(shape for shape, _ in placed),
    )


def _layout(random: np.random.Generator) -> list[Placed]:
    """Place as many obstacles as fit within the attempts; those by the walls first."""
    placed: list[Placed] = []
    for attempt in range(LAYOUT_ATTEMPTS):
        by_wall = attempt < LAYOUT_ATTEMPTS // 4
        if len(placed) >= (MAX_BY_WALL if by_wall else MAX_BY_WALL + MAX_FREE):
            continue
        shape, radius = _by_wall(random) if by_wall else _free(random)
        if all(_gap(shape, radius, *other) >= PASSAGE_M for other in placed):
            placed.append((shape, radius))
    return placed


def _gap(shape: Shape, radius: float, other: Shape, other_radius: float) -> float:
    """Return a lower bound of the gap between two shapes [m], by the circles round them."""
    return math.hypot(shape.x - other.x, shape.y - other.y) - radius - other_radius


def _free(random: np.random.Generator) -> Placed:
    """A pillar or a box, turned anyhow, with a passage all round it."""
    size, height = float(random.uniform(0.12, 0.22)), float(random.uniform(0.4, 0.8))
    material = str(random.choice(OBSTACLE_MATERIALS))
    reach = RANDOM_HALF_M - PASSAGE_M - 0.22 * math.sqrt(2)
    x, y = (float(value) for value in random.uniform(-reach, reach, 2))
    if random.random() < 0.5:
        return Cylinder(x, y, size, height, material), size
    yaw = float(random.uniform(0, math.pi / 2))
    return Box(x, y, size, size, height, material, yaw), size * math.sqrt(2)


def _by_wall(random: np.random.Generator) -> Placed:
    """A cupboard with its back to one of the walls, clear of the corners."""
    width, depth = (float(value) for value in random.uniform((0.25, 0.15), (0.45, 0.25)))
    height, material = float(random.uniform(0.5, 0.9)), str(random.choice(OBSTACLE_MATERIALS))
    reach = RANDOM_HALF_M - PASSAGE_M - width
    along, off = float(random.uniform(-reach, reach)), RANDOM_HALF_M - depth
    radius = math.hypot(width, depth)
    side = int(random.integers(4))
    sign = 1.0 if side < 2 else -1.0
    if side % 2:
        return Box(along, sign * off, width, depth, height, material), radius
    return Box(sign * off, along, depth, width, height, material), radius


NAMED_WORLDS: dict[str, Callable[[], World]] = {
    "arena": arena,
    "house": house,
    "warehouse": warehouse,
}


def world_names() -> dict[str, str]:
    """Return one line about each world, by name."""
    names = {name: build().description for name, build in NAMED_WORLDS.items()}
    return {**names, f"{RANDOM}SEED": random_world(0).description}


def load_world(name: str, seed: int) -> World:
    """The world, with the start poses that `seed` (>= 0) gives. Raises UnknownName."""
    return _with_start(_build(name), seed)


def _build(name: str) -> World:
    if name in NAMED_WORLDS:
        return NAMED_WORLDS[name]()
    if not name.startswith(RANDOM):
        raise unknown("world", name, [*NAMED_WORLDS, f"{RANDOM}SEED"])
    layout = name.removeprefix(RANDOM)
    if not (layout.isascii() and layout.isdigit()):
        text = f"no world {name!r}; random:SEED needs a whole number, as in random:7"
        raise UnknownName(text, value=name)
    return random_world(int(layout))


def _with_start(world: World, seed: int) -> World:
    """Draw the robot's pose until it is clear of everything, and the person's place."""
    random, shapes = generator(seed, Stream.START), world.everything()
    person_start = float(random.uniform(0, 1))
    person = None
    if world.path:
        path = ClosedPath(world.path)
        person_start *= path.length
        person = path.at(person_start)
    while True:
        x = float(random.uniform(-world.half_x, world.half_x))
        y = float(random.uniform(-world.half_y, world.half_y))
        yaw = float(random.uniform(-math.pi, math.pi))
        far = person is None or math.hypot(x - person.x, y - person.y) >= PERSON_CLEARANCE_M
        if far and clearance(shapes, x, y) >= START_CLEARANCE_M:
            return replace(world, start=Pose(x, y, yaw), person_start=person_start)
