"""Global planner of cars: from pose to pose, with their turning radius and in reverse."""

import math

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.geometry import sweep
from gigabrain_zenoh.kernels.images import OCCUPIED_PERCENT, Singles, squared_distance
from gigabrain_zenoh.navigation import hybrid_astar as hybrid
from gigabrain_zenoh.navigation.costmap import LETHAL, Costmap, Inflation
from gigabrain_zenoh.navigation.costmap import costmap as make_costmap
from gigabrain_zenoh.navigation.global_planner import NO_WAY, Path, Unreachable, goal_problem
from gigabrain_zenoh.navigation.grid_search import GridSearch
from gigabrain_zenoh.navigation.reeds_shepp import SEGMENTS, TINY, along, best_word

RADIUS_FACTOR = 1.1  # of the turning radius of paths, so that the car can correct errors
MAX_WIDER_M = 0.02  # by which the discs may extend beyond the sides of the car
MAX_DISCS = 12
FAR_M = 0.5  # larger distances to obstacles are not distinguished
MAX_OFF_M = 0.2  # a car farther from its path gets a new one
GOAL_OFF_M, GOAL_OFF_RAD = 0.08, 0.08  # errors at the end of a path that need no new one
SAME_END_M = 0.05  # of remaining path, at which the car is at its end
MAX_SHIFT_M = 0.05  # by which the map may move an obstacle towards path or goal
SPARE_M = 0.01  # near the start, the car may have this much less room than there


def car_of(body: BodyDescription) -> hybrid.Car:
    """Return the shape of a car, including the margins that safety keeps around it."""
    edges, limits = sweep.box(body.footprint), body.thresholds
    front, rear = edges.front + limits.stop_margin, edges.rear - limits.stop_margin
    half = max(edges.left, -edges.right) + limits.side_margin
    length, count = front - rear, 1
    while math.hypot(length / count / 2, half) > half + MAX_WIDER_M and count < MAX_DISCS:
        count += 1
    piece = length / count
    return hybrid.Car(
        radius=RADIUS_FACTOR * body.turning_radius,
        first=rear + piece / 2,
        spacing=piece,
        discs=count,
        room=math.hypot(piece / 2, half),
        middle=(front + rear) / 2,
    )


class CarPlanner:
    """Plans for cars with the same buffers each time. It is not thread-safe."""

    def __init__(self) -> None:
        self._memory = hybrid.nodes()
        self._grid = GridSearch()
        self._distances: tuple[Costmap, Singles] | None = None  # of the last costmap

    def plan(
        self, costmap: Costmap, body: BodyDescription, start: Pose, goal: Goal
    ) -> Path | Unreachable:
        """Return the cheapest path found to a goal, or why none exists."""
        fault = goal_problem(costmap, (goal.x, goal.y))
        cell = costmap.cell(goal.x, goal.y)
        if fault or cell is None:
            return Unreachable(fault=fault)
        here = costmap.cell(start.x, start.y)
        if here is None:
            return Unreachable(fault="the robot is outside the map")
        car = car_of(body)
        to_go = self._grid.field(costmap.cost, cell, "to", costmap.against) * costmap.resolution
        if to_go[here] == math.inf and costmap.cost[here] < LETHAL:
            return Unreachable(fault=NO_WAY)
        terrain = self._terrain(costmap, to_go)
        begin, end = _pose(start), (goal.x, goal.y, math.nan if goal.yaw is None else goal.yaw)
        needs = _needs(terrain, car, begin, end)
        if needs is None:
            return Unreachable(fault="the goal is too close to an obstacle for this heading")
        last = hybrid.search(terrain, car, begin, end, needs, self._memory)
        if last == hybrid.ROOT:
            return Unreachable(fault="no path leads to the goal that a car can drive")
        return self._path(terrain, car, end, last)

    def replan(
        self, costmap: Costmap, body: BodyDescription, start: Pose, goal: Goal, path: Path
    ) -> Path | Unreachable:
        """Return the rest of `path` if the car is on it and it is free, else a new path."""
        rest = rest_of(path, start, body.turning_radius)
        if rest is not None and self._is_free(costmap, body, rest):
            return rest
        return self.plan(costmap, body, start, goal)

    def _is_free(self, costmap: Costmap, body: BodyDescription, path: Path) -> bool:
        car, terrain = car_of(body), self._terrain(costmap, np.empty((0, 0)))
        assert path.headings is not None
        poses = np.column_stack((path.points, path.headings[:, 0]))
        away = np.hypot(*(path.points - path.points[0]).T)
        rooms = np.array([hybrid.room_at(terrain, car, *pose) for pose in poses])
        return bool((rooms[away > hybrid.LEAVE_M] >= car.room - MAX_SHIFT_M).all())

    def _terrain(self, costmap: Costmap, to_go: Floats) -> hybrid.Terrain:
        if self._distances is None or self._distances[0] is not costmap:
            resolution = costmap.resolution
            cells = costmap.cells
            if costmap.inflation.unknown == "forbid":
                cells = np.where(cells < 0, np.int8(OCCUPIED_PERCENT), cells)
            if costmap.keepouts is not None:
                cells = np.maximum(cells, costmap.keepouts)
            squares = squared_distance(cells, math.ceil(FAR_M / resolution) + 1)
            distance = ((np.sqrt(squares) - 0.5) * resolution).astype(np.float32)
            self._distances = costmap, distance
        return hybrid.Terrain(
            distance=self._distances[1],
            cost=costmap.cost,
            to_go=to_go,
            resolution=costmap.resolution,
            origin_x=costmap.origin_x,
            origin_y=costmap.origin_y,
        )

    def _path(self, terrain: hybrid.Terrain, car: hybrid.Car, goal: hybrid.Pose, last: int) -> Path:
        """Return the path to node `last` of the last search."""
        pose, g, link = self._memory.pose, self._memory.g, self._memory.link
        arcs: list[tuple[float, float]] = []  # curvature [1/m], length [m]
        node = last
        if link[last, 1] == hybrid.SHOT:
            node = int(link[last, 0])
            lengths, turns = np.empty(SEGMENTS), np.empty(SEGMENTS)
            x, y, yaw = pose[node].tolist()
            to_yaw = float(pose[last, 2])
            dx, dy = (goal[0] - x) / car.radius, (goal[1] - y) / car.radius
            cosine, sine = math.cos(yaw), math.sin(yaw)
            prices = (hybrid.REVERSE_COST, hybrid.SWITCH_COST / car.radius)
            there = cosine * dx + sine * dy, cosine * dy - sine * dx, to_yaw - yaw
            best_word(*there, prices, lengths, turns)
            arcs = [
                (turn / car.radius, length * car.radius)
                for turn, length in zip(turns.tolist(), lengths.tolist(), strict=True)
                if abs(length) > TINY
            ]
        while link[node, 0] != hybrid.ROOT:
            move = int(link[node, 1])
            bend = hybrid.BENDS[move % len(hybrid.BENDS)] / car.radius
            reverse = move >= len(hybrid.BENDS)
            arcs.insert(0, (bend, -hybrid.STEP_M if reverse else hybrid.STEP_M))
            node = int(link[node, 0])
        return _sampled((*pose[0].tolist(),), arcs, float(g[last]))


def _needs(
    terrain: hybrid.Terrain, car: hybrid.Car, start: hybrid.Pose, goal: hybrid.Pose
) -> Floats | None:
    """Return the required room, see `hybrid_astar.drive`; None if the goal is too tight."""
    at_start = hybrid.room_at(terrain, car, *start) - SPARE_M
    at_goal = car.room
    if not math.isnan(goal[2]):
        at_goal = hybrid.room_at(terrain, car, *goal)
        if at_goal < car.room - MAX_SHIFT_M:
            return None
    return np.array([
        (start[0], start[1], min(at_start, car.room)),
        (goal[0], goal[1], min(at_goal, car.room)),
        (0.0, 0.0, car.room),
    ])  # fmt: skip


def _pose(pose: Pose) -> hybrid.Pose:
    return pose.x, pose.y, pose.yaw


def _sampled(start: hybrid.Pose, arcs: list[tuple[float, float]], cost: float) -> Path:
    """Return the path along arcs (curvature [1/m], length [m]) from `start`."""
    first = 1.0 if not arcs or arcs[0][1] > 0.0 else -1.0
    rows, pose = [(*start, first, 0.0)], start
    for bend, length in arcs:
        count = max(1, math.ceil(abs(length) / hybrid.SAMPLE_M))
        for _ in range(count):
            pose = along(*pose, bend, length / count)
            rows.append((*pose, math.copysign(1.0, length), abs(length) / count))
    if len(rows) == 1:
        rows *= 2
    table = np.array(rows)
    remaining = np.append(np.cumsum(table[:0:-1, 4])[::-1], 0.0)
    whole = max(float(remaining[0]), 1e-9)
    return Path(
        points=table[:, :2],
        remaining=remaining,
        cost=remaining * (cost / whole),
        headings=table[:, 2:4],
    )


def offsets(path: Path, here: Pose, radius: float) -> Floats:
    """Return the distance of a car to each pose of its path (n,) [m]; a turn counts as its arc."""
    assert path.headings is not None
    off = np.hypot(path.points[:, 0] - here.x, path.points[:, 1] - here.y)
    turn = path.headings[:, 0] - here.yaw
    away: Floats = off + radius * np.abs(turn - math.tau * np.floor(turn / math.tau + 0.5))
    return away


def rest_of(path: Path, here: Pose, radius: float) -> Path | None:
    """Return the rest of a path from the car on; None if the car left it or missed its end."""
    assert path.headings is not None
    off = offsets(path, here, radius)
    at = int(off.argmin())
    if off[at] > MAX_OFF_M:
        return None
    end = path.points[-1]
    turn = math.remainder(float(path.headings[-1, 0]) - here.yaw, math.tau)
    missed = math.hypot(end[0] - here.x, end[1] - here.y) > GOAL_OFF_M or abs(turn) > GOAL_OFF_RAD
    if path.remaining[at] < SAME_END_M and missed:
        return None
    at = min(at, len(path.points) - 2)
    return Path(
        points=path.points[at:],
        remaining=path.remaining[at:],
        cost=path.cost[at:],
        headings=path.headings[at:],
    )


CAR = BodyDescription(
    robot_type="car", drive_type="ackermann",
    footprint=((0.3, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.3, -0.1)),
    max_linear_speed=0.5, max_angular_speed=1.0,
)  # fmt: skip


def warm_up() -> None:
    """Compile all kernels of planning for cars."""
    cells = np.zeros((60, 60), np.int8)
    grid = OccupancyGrid(
        resolution=0.1, width=60, height=60, origin_x=0.0, origin_y=0.0, cells=cells.tobytes()
    )
    costs, planner = make_costmap(grid, Inflation(fits=0.1, turns=0.3)), CarPlanner()
    here, goal = Pose(x=2.0, y=2.0, yaw=0.0), Goal(x=4.0, y=3.0, yaw=1.0)
    path = planner.plan(costs, CAR, here, goal)
    assert isinstance(path, Path)
    planner.replan(costs, CAR, here, goal, path)
