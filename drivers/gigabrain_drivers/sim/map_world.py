"""Worlds from ROS maps (map_server): occupied cells become boxes."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.world import Box, World
from gigabrain_zenoh.config import map_image
from gigabrain_zenoh.config.map_image import MAX_PIXELS, SavedMap, read_pgm
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import file_problem, read_bounded

MAX_BOXES = 4000
MAX_PNG_BYTES = 16_000_000
MAX_STARTS = 100_000  # free cells to draw a start from


def map_world(path: Path, wall_height: float) -> World:
    """Return the world of a map's YAML file. Raises ConfigError.

    Its frame is that of the map. Robots start in free cells.
    """
    grid = map_image.load(path, _read_image)
    occupied = grid.cells == 100
    free = grid.cells == 0
    if not free.any():
        raise ConfigError(f"{path}: the map has no free cell; a robot needs a place")
    rectangles = merge_cells(occupied, MAX_BOXES)
    if rectangles is None:
        raise ConfigError(
            f"{path}: its {np.count_nonzero(occupied)} occupied cells need more than {MAX_BOXES} "
            "boxes; clean the map, or make its cells larger"
        )
    cell = grid.resolution
    height, width = occupied.shape
    boxes = [_box(grid, *one, wall_height) for one in rectangles]
    middle = grid.origin_x + width * cell / 2, grid.origin_y + height * cell / 2
    return World(
        name=path.stem,
        description=f"the map {path.name}, {width * cell:.1f} x {height * cell:.1f} m",
        half_x=width * cell / 2,
        half_y=height * cell / 2,
        middle=middle,
        shapes=tuple(boxes),
        wall_height=wall_height,
        free=_places(grid, free),
        file=path,
    )


def merge_cells(occupied: NDArray[np.bool_], limit: int) -> list[tuple[int, int, int, int]] | None:
    """Return rectangles (row, column, rows, columns) that cover `occupied` (h, w) exactly.

    From each first cell, in row order, it takes the larger of two greedy rectangles. Returns None
    for more than `limit` rectangles.
    """
    left = occupied.copy()
    found: list[tuple[int, int, int, int]] = []
    for row, column in np.argwhere(occupied).tolist():
        if not left[row, column]:
            continue
        if len(found) == limit:
            return None
        below = left[row:, column:]
        wide, high = _run(below[:1].all(axis=0)), _run(below[:, :1].all(axis=1))
        tall = _run(below[:, :wide].all(axis=1)), wide
        long = high, _run(below[:high].all(axis=0))
        rows, columns = max(tall, long, key=lambda size: size[0] * size[1])
        left[row : row + rows, column : column + columns] = False
        found.append((row, column, rows, columns))
    return found


def _run(cells: Any) -> int:
    """Return the number of True cells at the start of an array (n,)."""
    stop = int(cells.argmin())
    return len(cells) if cells[stop] else stop


def _box(grid: SavedMap, row: int, column: int, rows: int, columns: int, height: float) -> Box:
    cell = grid.resolution
    x = grid.origin_x + (column + columns / 2) * cell
    y = grid.origin_y + (row + rows / 2) * cell
    return Box(x, y, columns * cell / 2, rows * cell / 2, height)


def _places(grid: SavedMap, free: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the centres of free cells (n, 2) [m]."""
    cells = np.argwhere(free)
    cells = cells[:: max(1, len(cells) // MAX_STARTS)]
    origin = np.array([grid.origin_x, grid.origin_y])
    return np.asarray(origin + (cells[:, ::-1] + 0.5) * grid.resolution)


def _read_image(file: Path) -> NDArray[np.uint8]:
    """Return the grey values of a PGM or PNG image. Raises ConfigError."""
    try:
        data = read_bounded(file, MAX_PNG_BYTES)
    except OSError as error:
        raise ConfigError(f"{file}: the map's image: {file_problem(error)}") from None
    if not data.startswith(b"\x89PNG"):
        return read_pgm(file)
    from gigabrain_drivers.sim.png import read_png  # MuJoCo decodes it

    return read_png(data, str(file), MAX_PIXELS)
