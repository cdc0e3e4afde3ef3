"""Quick bodies among quick obstacles: margins, looking around first, and a map of traffic.

Obstacles may turn at any moment. Predictions count less the later they are, and paths beside
places that much passes are cheaper.
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
HORIZON_S = 2.0  # of its plans
LOOK_AROUND_S = 0.6  # before it first drives off: so long it takes to tell what moves
LOOK_AROUND_IN_TRAFFIC_S = 4.0  # instead, where there is traffic: so long it takes to tell where
KEEP_AWAY_M = 1.25  # what comes nearer meanwhile it makes way for
WEIGHTS = Weights(disc=9.0, disc_lead=0.1, trust=0.7)

CELL_M = 0.5
CELLS = 128  # along each axis: what is farther off does not matter yet
RECENTER_CELLS = 8  # that the robot may be off its middle
PLACE_RADIUS_M = 2.5  # so far round a thing counts as its place, for it may turn
FADES_S = 30.0  # how long a place is remembered
UNSURE_S = 0.5  # a place that was watched for so long is known half
DODGED_SHARE = 0.65  # of the body's own top speed: what is slower it gets out of the way of
RISK_COST = 1200.0  # [s2/m], what the faster ones cost, by the square of how much faster they are
MIN_TRAFFIC = 1e-3  # [m/s2], less than that is no traffic
LONGEST_GAP_S = 1.0  # between scans; in a longer one nothing was watched
UPDATE_TICKS = 10  # from map to map

MOVING_SPEED = 0.15  # [m/s], slower things are part of the grid
MOVING_SIGMAS = 3.0  # standard deviations of its velocity that a thing must be faster than to move
DEFAULT_SPEED_SIGMA = 0.05  # [m/s], standard deviation of a velocity that comes without
MOVING_MARGIN_M = 0.1  # [m], from the rim of a disc: the middle of its own contour
MAX_GROWTH_SPEED = 0.3  # [m/s], of a disc: how fast what is known of it fades at most


def is_quick(model: MotionModel) -> bool:
    """Return whether a body is fast enough to watch quick obstacles."""
    return model.forward > QUICK_BODY_SPEED


def moving_quickly(discs: Floats) -> Floats:
    """Return the quick ones of the `discs` (m, 6), with velocity x, y [m/s] in columns 2 and 3."""
    found: Floats = discs[np.hypot(discs[:, 2], discs[:, 3]) > QUICK_OBSTACLE_SPEED]
    return found


def standing(polygons: tuple[Floats, ...], discs: Floats) -> tuple[Floats, ...]:
    """Return the `polygons` (k, 2) [m] whose middle is in none of the `discs` (m, 6) that move."""
    if not polygons or not len(discs):
        return polygons
    middles = np.array([polygon.mean(axis=0) for polygon in polygons])
    away = np.hypot(*(middles[:, None] - discs[:, :2]).transpose(2, 0, 1))
    inside = (away <= discs[:, 4] + MOVING_MARGIN_M).any(axis=1)
    return tuple(polygon for polygon, moves in zip(polygons, inside, strict=True) if not moves)


def stay_clear(discs: Floats, x: float, y: float) -> bool:
    """Return whether no disc (m, 6) comes near (x, y) [m] while the body looks around."""
    dx, dy, vx, vy = discs[:, 0] - x, discs[:, 1] - y, discs[:, 2], discs[:, 3]
    nearest = -(dx * vx + dy * vy) / np.maximum(vx * vx + vy * vy, 1e-9)
    when = np.clip(nearest, 0.0, HORIZON_S)
    away = np.hypot(dx + vx * when, dy + vy * when) - discs[:, 4]
    return bool((away > KEEP_AWAY_M).all())


class TrafficMemory(NamedTuple):
    """Fading sums of observations, (CELLS, CELLS) each."""

    passed: Floats  # [m/s]: times, widths and squares of speeds above what counts, per area
    watched: Floats  # [s]


class TrafficMap:
    """Traffic near a body, in the planning frame."""

    def __init__(self, width: float, fastest: float, sight: float) -> None:
        """Take a body of `width` [m], top speed `fastest` [m/s] and range `sight` [m]."""
        self._width, self._fastest, self._sight = width, fastest, sight
        self._memory = _empty_memory()
        self._padded = np.empty((CELLS, CELLS + 2), dtype=np.int32)
        self._halves = np.empty((2, CELLS, CELLS + 2), dtype=np.int32)
        self._spans = np.empty((3, CELLS + 2), dtype=np.int32)
        self.reset()

    def reset(self) -> None:
        """Forget all."""
        self._row = self._column = self._tick = self._made = 0
        self._any = False
        self._ways: Ways | None = None
        for cells in self._memory:
            cells.fill(0.0)

    @property
    def any(self) -> bool:
        """Return whether there is traffic."""
        return self._any

    def see(self, tick: int, x: float, y: float, discs: Floats) -> None:
        """Take in the moving `discs` (n, 6) round a body at (x, y) [m]."""
        over = np.minimum(np.hypot(discs[:, 2], discs[:, 3]), self._fastest)
        over -= DODGED_SHARE * self._fastest
        counts = over > 0.0
        if not self._any:
            if not counts.any():
                return
            self._any, self._tick, self._made = True, tick, tick
        dt, self._tick = (tick - self._tick) * TICK_NS / 1e9, tick
        keeps, seen = math.exp(-dt / FADES_S), dt if dt < LONGEST_GAP_S else 0.0
        self._follow(x, y)
        left, low = self._column * CELL_M, self._row * CELL_M
        _add_watched(self._memory, keeps, seen, x - left, y - low, self._sight)
        amounts = seen * over**2 * (2.0 * discs[:, 4] + self._width)
        for disc, amount in zip(discs[counts], amounts[counts], strict=True):
            _pass(self._memory.passed, disc[0] - left, disc[1] - low, amount)

    def ways(self, goal: tuple[float, float]) -> Ways | None:
        """Return the cost of ways to the goal through the traffic; None without traffic."""
        if self._any and self._tick - self._made >= UPDATE_TICKS:
            self._made, self._ways = self._tick, self._priced(goal)
            self._any = self._ways is not None
        return self._ways

    def _priced(self, goal: tuple[float, float]) -> Ways | None:
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

    def _follow(self, x: float, y: float) -> None:
        """Keep the robot in the middle; what leaves the map is forgotten."""
        row = math.floor(y / CELL_M) - CELLS // 2
        column = math.floor(x / CELL_M) - CELLS // 2
        down, right = row - self._row, column - self._column
        if max(abs(down), abs(right)) <= RECENTER_CELLS:
            return
        rows, columns = _shifted(down), _shifted(right)
        moved = _empty_memory()
        for to, cells in zip(moved, self._memory, strict=True):
            to[rows[1], columns[1]] = cells[rows[0], columns[0]]
        self._memory, self._row, self._column = moved, row, column


def _empty_memory() -> TrafficMemory:
    return TrafficMemory(*np.zeros((2, CELLS, CELLS)))


def _shifted(by: int) -> tuple[slice, slice]:
    """Return the cells that stay when a map moves on, and where they are then."""
    low, high = max(0, by), max(0, min(CELLS, CELLS + by))
    return slice(low, max(low, high)), slice(max(0, -by), max(0, -by) + max(0, high - low))


@kernel
def _add_watched(
    memory: TrafficMemory, keeps: float, dt: float, x: float, y: float, sight: float
) -> None:
    """Let `dt` [s] pass, in which what is nearer to (x, y) than `sight` [m] was watched."""
    for i in range(CELLS):
        for j in range(CELLS):
            dx, dy = (j + 0.5) * CELL_M - x, (i + 0.5) * CELL_M - y
            near = dx * dx + dy * dy < sight * sight
            memory.passed[i, j] *= keeps
            memory.watched[i, j] = keeps * memory.watched[i, j] + (dt if near else 0.0)


@kernel
def _pass(passed: Floats, x: float, y: float, amount: float) -> None:
    """Add an obstacle at (x, y) [m] to the traffic around its place."""
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
    """Return moving obstacles (m, 6), with the growth of their uncertainty."""
    rows = [
        (
            one.x,
            one.y,
            one.velocity_x,
            one.velocity_y,
            one.radius,
            min(MAX_GROWTH_SPEED, _growth(one)),
        )
        for one in obstacles
        if math.hypot(one.velocity_x, one.velocity_y)
        > max(MOVING_SPEED, MOVING_SIGMAS * _growth(one))
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def _growth(obstacle: Obstacle) -> float:
    """Return the standard deviation of the velocity [m/s]."""
    if not obstacle.covariance:
        return DEFAULT_SPEED_SIGMA
    return math.sqrt(max(0.0, obstacle.covariance[10], obstacle.covariance[15]))
