"""Fast bodies among fast obstacles: margins, looking around first, and a map of traffic.

Obstacles may turn at any moment. So the weight of predictions fades with time, and paths through
traffic cost more.
"""

import math
from typing import NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.brain import Obstacle
from gigabrain_zenoh.kernels.jit import kernel
from gigabrain_zenoh.navigation.cost_to_go import FARTHEST, UNIT, Ways, seed, sweep
from gigabrain_zenoh.navigation.footprint import DistanceGrid
from gigabrain_zenoh.navigation.motion_model import MotionModel
from gigabrain_zenoh.navigation.planning_problem import Weights

QUICK_BODY_SPEED = 1.0  # [m/s], a body that can go faster is quick
QUICK_OBSTACLE_SPEED = 0.3  # [m/s]
HORIZON_S = 2.0  # of the body's plans
LOOK_AROUND_S = 0.6  # before the first motion, to find moving obstacles
LOOK_AROUND_IN_TRAFFIC_S = 4.0  # the same with traffic, to find where it is
KEEP_AWAY_M = 1.25  # the body makes way for obstacles that come nearer meanwhile
WEIGHTS = Weights(disc=9.0, disc_lead=0.1, trust=0.7)

CELL_M = 0.5
CELLS = 128  # along each axis
RECENTER_CELLS = 8  # distance of the robot from the middle, before the map is moved
PLACE_RADIUS_M = 2.5  # around an obstacle, counted as its place because it may turn
FADES_S = 30.0  # time constant of the memory
UNSURE_S = 0.5  # added to the time watched, so that short observations count less
DODGED_SHARE = 0.65  # of the body's top speed: it can dodge slower obstacles
RISK_COST = 1200.0  # [s2/m], of faster obstacles, by the square of the excess
MIN_TRAFFIC = 1e-3  # [m/s2], less is no traffic
MAX_GAP_S = 1.0  # between scans; a longer one counts as not watched
UPDATE_TICKS = 10  # from map to map

MOVING_SPEED = 0.15  # [m/s], slower obstacles are part of the grid
MOVING_SIGMAS = 3.0  # the speed of a moving obstacle, in standard deviations, is at least this
DEFAULT_SPEED_SIGMA = 0.05  # [m/s], standard deviation of a velocity without covariance
MOVING_MARGIN_M = 0.1  # round a disc, for the middle of its own contour
MAX_GROWTH_SPEED = 0.3  # [m/s], limit of the growth of a disc's uncertainty


def is_quick(model: MotionModel) -> bool:
    """Return whether a body is fast enough for the measures of this module."""
    return model.forward > QUICK_BODY_SPEED


def quick_discs(discs: Floats) -> Floats:
    """Return the quick ones of `discs` (m, 6), with velocity x, y [m/s] in columns 2 and 3."""
    found: Floats = discs[np.hypot(discs[:, 2], discs[:, 3]) > QUICK_OBSTACLE_SPEED]
    return found


def static_polygons(polygons: tuple[Floats, ...], discs: Floats) -> tuple[Floats, ...]:
    """Return the `polygons` (k, 2) [m] whose middle is in none of the moving `discs` (m, 6)."""
    if not polygons or not len(discs):
        return polygons
    middles = np.array([polygon.mean(axis=0) for polygon in polygons])
    away = np.hypot(*(middles[:, None] - discs[:, :2]).transpose(2, 0, 1))
    inside = (away <= discs[:, 4] + MOVING_MARGIN_M).any(axis=1)
    return tuple(polygon for polygon, moves in zip(polygons, inside, strict=True) if not moves)


def stay_clear(discs: Floats, x: float, y: float) -> bool:
    """Return whether all `discs` (m, 6) stay KEEP_AWAY_M from (x, y) [m] within HORIZON_S."""
    dx, dy, vx, vy = discs[:, 0] - x, discs[:, 1] - y, discs[:, 2], discs[:, 3]
    nearest = -(dx * vx + dy * vy) / np.maximum(vx * vx + vy * vy, 1e-9)
    when = np.clip(nearest, 0.0, HORIZON_S)
    away = np.hypot(dx + vx * when, dy + vy * when) - discs[:, 4]
    return bool((away > KEEP_AWAY_M).all())


class TrafficMemory(NamedTuple):
    """Fading sums of observations, (CELLS, CELLS) each."""

    passed: Floats  # [m/s], sum of time x width x square of excess speed, per area
    watched: Floats  # [s], for which each cell was in sight


class TrafficMap:
    """Traffic near a body, in the planning frame."""

    def __init__(self, width: float, fastest: float, sight: float) -> None:
        """Make a map for a body's `width` [m], top speed `fastest` [m/s] and `sight` [m]."""
        self._width, self._fastest, self._sight = width, fastest, sight
        self._memory = _empty_memory()
        self._padded = np.empty((CELLS, CELLS + 2), dtype=np.int32)
        self._halves = np.empty((2, CELLS, CELLS + 2), dtype=np.int32)
        self._spans = np.empty((3, CELLS + 2), dtype=np.int32)
        self.reset()

    def reset(self) -> None:
        """Forget the traffic."""
        self._row = self._column = self._tick = self._updated_tick = 0
        self._has_traffic = False
        self._ways: Ways | None = None
        for cells in self._memory:
            cells.fill(0.0)

    @property
    def any(self) -> bool:
        """Return whether there is traffic."""
        return self._has_traffic

    def update(self, tick: int, x: float, y: float, discs: Floats) -> None:
        """Add the moving `discs` (n, 6) seen from a body at (x, y) [m]."""
        excess = np.minimum(np.hypot(discs[:, 2], discs[:, 3]), self._fastest)
        excess -= DODGED_SHARE * self._fastest
        too_fast = excess > 0.0
        if not self._has_traffic:
            if not too_fast.any():
                return
            self._has_traffic, self._tick, self._updated_tick = True, tick, tick
        dt, self._tick = (tick - self._tick) * TICK_NS / 1e9, tick
        decay, seen = math.exp(-dt / FADES_S), dt if dt < MAX_GAP_S else 0.0
        self._move_map(x, y)
        left, low = self._column * CELL_M, self._row * CELL_M
        _add_watched(self._memory, decay, seen, x - left, y - low, self._sight)
        amounts = seen * excess**2 * (2.0 * discs[:, 4] + self._width)
        for disc, amount in zip(discs[too_fast], amounts[too_fast], strict=True):
            _add_passing(self._memory.passed, disc[0] - left, disc[1] - low, amount)

    def ways(self, goal: tuple[float, float]) -> Ways | None:
        """Return the cost of ways to the goal through the traffic; None without traffic."""
        if self._has_traffic and self._tick - self._updated_tick >= UPDATE_TICKS:
            self._updated_tick, self._ways = self._tick, self._compute_ways(goal)
            self._has_traffic = self._ways is not None
        return self._ways

    def _compute_ways(self, goal: tuple[float, float]) -> Ways | None:
        rate = self._memory.passed / (self._memory.watched + UNSURE_S)
        if rate.max() < MIN_TRAFFIC:
            return None
        corner = self._column * CELL_M, self._row * CELL_M
        price = (1.0 + RISK_COST * rate).astype(np.float32)
        self._halves.fill(round(FARTHEST))
        self._halves[0, :, 1:-1] = price * (0.5 * CELL_M / UNIT)
        self._halves[1, :, 1:-1] = price * (0.5 * math.sqrt(2.0) * CELL_M / UNIT)
        self._padded.fill(round(FARTHEST / UNIT))
        seed(self._padded[:, 1:-1], CELL_M, corner, np.array([goal]))
        sweep(self._halves, self._padded, self._spans)
        field = (self._padded[:, 1:-1] * UNIT).astype(np.float32)
        return Ways(DistanceGrid(price, CELL_M, *corner), DistanceGrid(field, CELL_M, *corner))

    def _move_map(self, x: float, y: float) -> None:
        """Move the map with the robot, and forget cells outside."""
        row = math.floor(y / CELL_M) - CELLS // 2
        column = math.floor(x / CELL_M) - CELLS // 2
        down, right = row - self._row, column - self._column
        if max(abs(down), abs(right)) <= RECENTER_CELLS:
            return
        rows, columns = _kept_slices(down), _kept_slices(right)
        moved = _empty_memory()
        for to, cells in zip(moved, self._memory, strict=True):
            to[rows[1], columns[1]] = cells[rows[0], columns[0]]
        self._memory, self._row, self._column = moved, row, column


def _empty_memory() -> TrafficMemory:
    return TrafficMemory(*np.zeros((2, CELLS, CELLS)))


def _kept_slices(by: int) -> tuple[slice, slice]:
    """Return the old and the new slice of the cells that stay in a map moved by `by`."""
    low, high = max(0, by), max(0, min(CELLS, CELLS + by))
    return slice(low, max(low, high)), slice(max(0, -by), max(0, -by) + max(0, high - low))


@kernel
def _add_watched(
    memory: TrafficMemory, decay: float, dt: float, x: float, y: float, sight: float
) -> None:
    """Fade the memory, and add `dt` [s] to cells within `sight` [m] of (x, y)."""
    for i in range(CELLS):
        for j in range(CELLS):
            dx, dy = (j + 0.5) * CELL_M - x, (i + 0.5) * CELL_M - y
            near = dx * dx + dy * dy < sight * sight
            memory.passed[i, j] *= decay
            memory.watched[i, j] = decay * memory.watched[i, j] + (dt if near else 0.0)


@kernel
def _add_passing(passed: Floats, x: float, y: float, amount: float) -> None:
    """Add `amount` to the traffic around an obstacle at (x, y) [m]."""
    share = amount / (math.pi * PLACE_RADIUS_M * PLACE_RADIUS_M)
    for i in range(_cell(y - PLACE_RADIUS_M), _cell(y + PLACE_RADIUS_M) + 1):
        for j in range(_cell(x - PLACE_RADIUS_M), _cell(x + PLACE_RADIUS_M) + 1):
            dx, dy = (j + 0.5) * CELL_M - x, (i + 0.5) * CELL_M - y
            if dx * dx + dy * dy < PLACE_RADIUS_M * PLACE_RADIUS_M:
                passed[i, j] += share


@kernel
def _cell(at: float) -> int:
    return max(0, min(CELLS - 1, math.floor(at / CELL_M)))


def discs_of(obstacles: tuple[Obstacle, ...]) -> Floats:
    """Return the discs (m, 6) of moving obstacles, see `planning_problem.Scene`."""
    rows = [
        (
            obstacle.x,
            obstacle.y,
            obstacle.velocity_x,
            obstacle.velocity_y,
            obstacle.radius,
            min(MAX_GROWTH_SPEED, _speed_sigma(obstacle)),
        )
        for obstacle in obstacles
        if math.hypot(obstacle.velocity_x, obstacle.velocity_y)
        > max(MOVING_SPEED, MOVING_SIGMAS * _speed_sigma(obstacle))
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def _speed_sigma(obstacle: Obstacle) -> float:
    """Return the standard deviation of the velocity [m/s]."""
    if not obstacle.covariance:
        return DEFAULT_SPEED_SIGMA
    return math.sqrt(max(0.0, obstacle.covariance[10], obstacle.covariance[15]))
