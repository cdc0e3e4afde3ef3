"""Rooms with a layout drawn from a seed, in which nothing can get stuck."""

import math

import numpy as np

from gigabrain_drivers.sim.geometry import Box, Cylinder, Shape
from gigabrain_drivers.sim.streams import Stream, generator
from gigabrain_drivers.sim.world import World

HALF_M = 3.5
PASSAGE_M = 1.15  # the least gap that a robot may find; narrower ones are closed
FREE, BY_WALL = 8, 5  # obstacles, at most
LEAST = 10  # obstacles
ATTEMPTS = 400  # for one layout
MATERIALS = ("orange", "teal", "yellow", "blue", "green", "clay")

Placed = tuple[Shape, float]  # a shape and the radius of the circle round it


def random_world(seed: int) -> World:
    """10 to 13 obstacles in 7 x 7 m; gaps are none at all or at least 1.15 m."""
    random = generator(seed, Stream.LAYOUT)
    placed = _layout(random)
    while len(placed) < LEAST:
        placed = _layout(random)
    return World(
        name=f"random:{seed}",
        description="10 to 13 obstacles in 7 x 7 m, drawn from SEED",
        half_x=HALF_M,
        half_y=HALF_M,
        floor=((0.56, 0.60, 0.55), (0.52, 0.56, 0.51)),
        shapes=tuple(shape for shape, _ in placed),
    )


def _layout(random: np.random.Generator) -> list[Placed]:
    """As many obstacles as fit within the attempts; those by the walls first."""
    placed: list[Placed] = []
    for attempt in range(ATTEMPTS):
        by_wall = attempt < ATTEMPTS // 4
        if len(placed) >= (BY_WALL if by_wall else BY_WALL + FREE):
            continue
        shape, radius = _by_wall(random) if by_wall else _free(random)
        if all(_gap(shape, radius, *other) >= PASSAGE_M for other in placed):
            placed.append((shape, radius))
    return placed


def _gap(shape: Shape, radius: float, other: Shape, other_radius: float) -> float:
    """At least this much room is between two shapes [m], by the circles round them."""
    return math.hypot(shape.x - other.x, shape.y - other.y) - radius - other_radius


def _free(random: np.random.Generator) -> Placed:
    """A pillar or a box, turned anyhow, with a passage all round it."""
    size, height = float(random.uniform(0.12, 0.22)), float(random.uniform(0.4, 0.8))
    material = str(random.choice(MATERIALS))
    reach = HALF_M - PASSAGE_M - 0.22 * math.sqrt(2)
    x, y = (float(value) for value in random.uniform(-reach, reach, 2))
    if random.random() < 0.5:
        return Cylinder(x, y, size, height, material), size
    yaw = float(random.uniform(0, math.pi / 2))
    return Box(x, y, size, size, height, material, yaw), size * math.sqrt(2)


def _by_wall(random: np.random.Generator) -> Placed:
    """A cupboard with its back to one of the walls, clear of the corners."""
    width, depth = (float(value) for value in random.uniform((0.25, 0.15), (0.45, 0.25)))
    height, material = float(random.uniform(0.5, 0.9)), str(random.choice(MATERIALS))
    reach = HALF_M - PASSAGE_M - width
    along, off = float(random.uniform(-reach, reach)), HALF_M - depth
    radius = math.hypot(width, depth)
    side = int(random.integers(4))
    sign = 1.0 if side < 2 else -1.0
    if side % 2:
        return Box(along, sign * off, width, depth, height, material), radius
    return Box(sign * off, along, depth, width, height, material), radius
