"""Cost to go from every place in the window to the goal."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import kernel
from gigabrain_zenoh.navigation.footprint import DistanceGrid, interpolate
from gigabrain_zenoh.navigation.zones import fill

COARSER = 2  # cells of the window per cell of the field, along each axis
FARTHEST = 1e4  # [m], cost to go of unreachable cells
UNIT = 1e-5  # [m], of costs as integers, which take a quarter of the time
TIGHT, TIGHT_OVER = 12.0, 0.09  # cost per metre where the body just fits, and its decay [m]
TOUCHING, INSIDE = 60.0, 400.0  # cost per metre in obstacles; finite, so that a body can leave

BEYOND = 1e4  # cost per metre beside the window
DIAGONAL = math.sqrt(2.0)
HALVINGS = 5  # of an exponent, so that few terms of its series are enough
SECOND, THIRD, FOURTH = np.float32(1 / 2), np.float32(1 / 6), np.float32(1 / 24)

Singles = NDArray[np.float32]
Units = NDArray[np.int32]


class Ways(NamedTuple):
    """Cost of ways through traffic, on a coarse grid larger than the window."""

    price: DistanceGrid  # per metre, 1 without traffic
    field: DistanceGrid  # cost to go [m of free way]


class CostToGo:
    """Computes the cheapest 8-connected ways over the window. Its buffers are reused."""

    def __init__(self, cells: int) -> None:
        side = cells // COARSER
        self._field = np.empty((side, side), dtype=np.float32)
        self._padded = np.empty((side, side + 2), dtype=np.int32)
        self._halves = np.empty((2, side, side + 2), dtype=np.int32)
        self._spans = np.empty((3, side + 2), dtype=np.int32)

    def field(
        self, grid: DistanceGrid, half_width: float, goal: tuple[float, float], path: Floats | None,
        ways: Ways | None = None, avoid: Sequence[Floats] = (),
    ) -> DistanceGrid:  # fmt: skip
        """Return the cost from each cell to the goal, or to the path's exit [m of free way].

        Without a path to a goal outside, each cell of the rim has the cost of a straight free way
        from there, or that of `ways`. Polygons `avoid` (n, 2) [m] cost as much as touching.
        """
        cell = grid.cell * COARSER
        _fill_costs(
            grid.distance, np.float32(half_width), np.float32(cell / 2.0 / UNIT), self._halves
        )
        if len(avoid):
            self._raise_costs(avoid, cell, (grid.x, grid.y))
        self._padded.fill(round(FARTHEST / UNIT))
        inner = self._padded[:, 1:-1]
        found = seed(inner, cell, (grid.x, grid.y), np.array([goal]) if path is None else path)
        if ways is not None:
            _scale_costs(self._halves, cell, grid.x - ways.price.x, grid.y - ways.price.y, ways)
            if not found:
                _seed_rim(inner, cell, grid.x - ways.price.x, grid.y - ways.price.y, ways)
        sweep(self._halves, self._padded, self._spans)
        _in_metres(self._padded, self._field)
        return DistanceGrid(self._field, cell, grid.x, grid.y)

    def _raise_costs(
        self, polygons: Sequence[Floats], cell: float, corner: tuple[float, float]
    ) -> None:
        """Make ways through `polygons` expensive."""
        mask = np.zeros(self._field.shape, np.uint8)
        for corners in polygons:
            fill(mask, (corners - corner) / cell, 1)
        for halves, half in zip(self._halves, (0.5, DIAGONAL / 2), strict=True):
            inner = halves[:, 1:-1]
            least = np.int32(TOUCHING * half * cell / UNIT)
            np.maximum(inner, least, out=inner, where=mask > 0)


@kernel
def seed(known: Units, cell: float, corner: tuple[float, float], points: Floats) -> bool:
    """Put the initial costs into `known` (side, side), in units; other cells are unchanged.

    The exit of the path `points` (n, 2) [m] has cost 0. If the path is outside, each cell of the
    rim has the straight distance to its end. Return whether a point of the path is inside.
    """
    side = len(known)
    last = _path_exit(points, cell, corner, side)
    if last >= 0:
        x, y = points[last]
        known[math.floor((y - corner[1]) / cell), math.floor((x - corner[0]) / cell)] = 0
        return True
    x, y = points[len(points) - 1]
    for i in range(side):
        step = 1 if i in (0, side - 1) else side - 1
        for j in range(0, side, step):
            right = corner[0] + (j + 0.5) * cell - x
            away = math.hypot(right, corner[1] + (i + 0.5) * cell - y)
            known[i, j] = np.int32(min(away, FARTHEST) / UNIT)
    return False


@kernel
def _in_metres(units: Units, metres: Singles) -> None:
    """Fill `metres` (side, side) from `units` (side, side + 2)."""
    unit = np.float64(np.float32(UNIT))
    for row in range(len(metres)):
        out = metres[row]
        known = units[row, 1 : len(out) + 1]
        for column in range(len(out)):
            out[column] = np.float32(known[column] * unit)


@kernel
def _path_exit(points: Floats, cell: float, corner: tuple[float, float], side: int) -> int:
    """Return the index of the last of `points` (n, 2) before they leave the window.

    The search starts at the point nearest to the middle. The index is -1 if all are outside.
    """
    middle_x, middle_y = corner[0] + side * cell / 2, corner[1] + side * cell / 2
    last, nearest, leads_on = -1, math.inf, False
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        column, row = math.floor((x - corner[0]) / cell), math.floor((y - corner[1]) / cell)
        inside = 1 <= column < side - 1 and 1 <= row < side - 1
        away = math.hypot(x - middle_x, y - middle_y)
        if inside and away < nearest:
            last, nearest, leads_on = n, away, True
        elif inside and leads_on:
            last = n
        else:
            leads_on = False
    return last


@kernel
def _fill_costs(distance: Singles, half_width: np.float32, half: np.float32, halves: Units) -> None:
    """Fill `halves` (2, side, side + 2): half the cost to cross each cell, straight and diagonal.

    `half` is that cost in a free cell. The distance is the mean of COARSER x COARSER cells. The
    exponential function is written out so that it is vectorised.
    """
    side, slant = halves.shape[1], half * np.float32(DIAGONAL)
    for row in range(side):
        for end in (0, side + 1):
            halves[0, row, end] = halves[1, row, end] = np.int32(BEYOND * half)
    touching, inside = np.float32(TOUCHING), np.float32(INSIDE)
    per_decay, share = np.float32(1.0 / TIGHT_OVER / 2**HALVINGS), np.float32(1.0 / COARSER**2)
    one, tight, deep_inside = np.float32(1.0), np.float32(TIGHT), np.float32(0.6) * half_width
    for row in range(side):
        first, second = distance[2 * row], distance[2 * row + 1]
        straight, diagonal = halves[0, row, 1 : side + 1], halves[1, row, 1 : side + 1]
        for j in range(side):
            away = (first[2 * j] + first[2 * j + 1] + second[2 * j] + second[2 * j + 1]) * share
            y = (half_width - away) * per_decay
            near = one + y * (one + y * (SECOND + y * (THIRD + y * FOURTH)))
            for _ in range(HALVINGS):
                near *= near
            price = one + tight * near
            price = price if away >= half_width else touching
            price = price if away >= deep_inside else inside
            straight[j], diagonal[j] = np.int32(price * half), np.int32(price * slant)


@kernel
def _scale_costs(halves: Units, cell: float, x: float, y: float, ways: Ways) -> None:
    """Multiply `halves` by the price in `ways`, from whose corner they are (x, y) [m] away."""
    price, per_cell = ways.price.distance, 1.0 / ways.price.cell
    for i in range(halves.shape[1]):
        for j in range(halves.shape[1]):
            u, v = (x + (j + 0.5) * cell) * per_cell - 0.5, (y + (i + 0.5) * cell) * per_cell - 0.5
            times = interpolate(price, u, v)
            halves[0, i, j + 1] = np.int32(halves[0, i, j + 1] * times)
            halves[1, i, j + 1] = np.int32(halves[1, i, j + 1] * times)


@kernel
def _seed_rim(known: Units, cell: float, x: float, y: float, ways: Ways) -> None:
    """Put the cost to go of `ways` into the rim of `known`, (x, y) [m] from their corner."""
    field, per_cell, side = ways.field.distance, 1.0 / ways.field.cell, len(known)
    for i in range(side):
        step = 1 if i in (0, side - 1) else side - 1
        for j in range(0, side, step):
            u, v = (x + (j + 0.5) * cell) * per_cell - 0.5, (y + (i + 0.5) * cell) * per_cell - 0.5
            known[i, j] = np.int32(interpolate(field, u, v) / UNIT)


@kernel
def sweep(halves: Units, field: Units, spans: Units) -> None:
    """Lower `field` until each cell is as cheap as by any of its eight neighbours.

    A step costs its length times the mean cost of both cells. Rows are lowered one by one, down and
    up, until none changes. The result is that of Dijkstra's algorithm, in a quarter of its time.
    """
    rows = len(field)
    stale, fresh = np.ones(rows, dtype=np.bool_), np.ones(rows, dtype=np.bool_)
    changing, down = True, True
    while changing:
        changing = False
        for step in range(rows):
            i = step if down else rows - 1 - step
            if not stale[i]:
                continue
            stale[i] = False
            changed = i > 0 and _lower_from_row(halves, field, i - 1, i)
            if i < rows - 1:
                changed |= _lower_from_row(halves, field, i + 1, i)
            if changed or fresh[i]:
                changed |= _lower_within_row(halves[0, i], field[i], spans)
                fresh[i] = False
            if changed:
                changing = True
                stale[max(0, i - 1)] = stale[min(rows - 1, i + 1)] = True
                stale[i] = False
        down = not down


@kernel
def _lower_from_row(halves: Units, field: Units, beside: int, i: int) -> bool:
    """Lower row `i` by steps from the row `beside`, and return whether it changed.

    Slices are vectorised, indices are not.
    """
    n = field.shape[1]
    others, here = field[beside], field[i, 1 : n - 1]
    own, own_diagonal = halves[0, i, 1 : n - 1], halves[1, i, 1 : n - 1]
    straight, diagonal = halves[0, beside, 1 : n - 1], halves[1, beside]
    a, b, c, p, r = others[: n - 2], others[1 : n - 1], others[2:], diagonal[: n - 2], diagonal[2:]
    changed = False
    for j in range(n - 2):
        left, right = np.int32(a[j] + p[j]), np.int32(c[j] + r[j])
        middle = np.int32(b[j] + straight[j] + own[j])
        best = np.int32(min(left, right) + own_diagonal[j])
        best = min(middle, best)
        changed |= best < here[j]
        here[j] = min(best, here[j])
    return changed


@kernel
def _lower_within_row(halves: Units, row: Units, spans: Units) -> bool:
    """Lower `row` by steps within it, and return whether it changed.

    Both directions are in one loop, as each step depends on the one before it.
    """
    n = len(row)
    first, second = halves[: n - 1], halves[1:]
    steps, right, left = spans[0, : n - 1], spans[1], spans[2]
    for j in range(n - 1):
        steps[j] = first[j] + second[j]
    forward, backward = row[0], row[n - 1]
    right[0], left[n - 1] = forward, backward
    for j in range(n - 1):
        forward = min(np.int32(forward + steps[j]), row[j + 1])
        right[j + 1] = forward
        k = n - 2 - j
        backward = min(np.int32(backward + steps[k]), row[k])
        left[k] = backward
    changed = False
    for j in range(n):
        best = min(right[j], left[j])
        changed |= best < row[j]
        row[j] = min(best, row[j])
    return changed
