"""Maps that planners are compared on: an office, what changes in it, and scattered cells."""

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.navigation.costmap import LETHAL, Costs

RESOLUTION = 0.05  # [m]
DENSITY = 0.2  # of the random map
PITCH, ROOM, WALL, DOOR = 240, 96, 2, 20  # cells: four rooms and two corridors repeat
FURNITURE = 3  # pieces a room

Cells = NDArray[np.int8]


def office(size: int, rng: np.random.Generator) -> Cells:
    """Rooms of 4.8 m with a door of 1 m each, furniture, and corridors of 2.4 m between them."""
    cells = np.zeros((size, size), np.int8)
    for top in range(0, size, PITCH):
        for left in range(0, size, PITCH):
            for down, right in ((0, 0), (0, ROOM), (ROOM, 0), (ROOM, ROOM)):
                _add_room(
                    cells[top + down : top + down + ROOM, left + right : left + right + ROOM], rng
                )
    cells[:WALL] = cells[-WALL:] = cells[:, :WALL] = cells[:, -WALL:] = 100
    return cells


def _add_room(room: Cells, rng: np.random.Generator) -> None:
    """Walls, a door in each of two sides, and furniture, in a part of a map."""
    room[:WALL] = room[-WALL:] = room[:, :WALL] = room[:, -WALL:] = 100
    for side in (room[:WALL], room[-WALL:], room[:, :WALL].T, room[:, -WALL:].T):
        door = rng.integers(WALL, ROOM - DOOR - WALL)
        if rng.random() < 0.7:
            side[:, door : door + DOOR] = 0
    for _ in range(FURNITURE):
        row, column = rng.integers(20, ROOM - 36, 2)
        height, width = rng.integers(6, 16, 2)
        room[row : row + height, column : column + width] = 100


def scattered(size: int, rng: np.random.Generator) -> Costs:
    """A random map, costs of 1 and lethal cells, as planners are compared on; free corners."""
    taken = rng.random((size, size)) < DENSITY
    taken[:3, :3] = taken[-3:, -3:] = False
    return np.where(taken, np.float32(2 * LETHAL), np.float32(1))


def something_new(cells: Cells, rng: np.random.Generator) -> Cells:
    """The map with a piece of furniture more."""
    row, column = rng.integers(0, len(cells) - 10, 2)
    now = cells.copy()
    now[row : row + 10, column : column + 10] = 100
    return now


def grid_of(cells: Cells) -> OccupancyGrid:
    """The map as it goes over the bus."""
    height, width = cells.shape
    return OccupancyGrid(
        resolution=RESOLUTION,
        width=width,
        height=height,
        origin_x=0.0,
        origin_y=0.0,
        cells=cells.tobytes(),
    )
