"""The worlds that are drawn by hand: an arena, a house and a warehouse.

Free passages are at least 1.1 m wide (doors 1.0 m) and everything else is flush, so a robot that
only looks a metre ahead and turns right can roam for ever.
"""

from gigabrain_drivers.sim.geometry import Box, Cylinder, Shape
from gigabrain_drivers.sim.world import WALL_HALF, Corners, World


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
    """Six racks, aisles of 1.6 m, and a person who walks round the middle row."""
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
