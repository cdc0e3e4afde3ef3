"""From an order to a route: where to go next, which way through the map, and when to give up."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.behaviours.aside import Courtesy
from gigabrain_zenoh.decision.behaviours.bearings import Driven, Floats, Route
from gigabrain_zenoh.decision.behaviours.beyond import widened
from gigabrain_zenoh.decision.behaviours.progress import THERE_M, Progress
from gigabrain_zenoh.decision.tasks.orders import GoTo, Order, Visit
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.navigation.costmap import Costmap, Unknown, costmap, inflation
from gigabrain_zenoh.navigation.frontiers import frontiers
from gigabrain_zenoh.navigation.moment import LocalSettings
from gigabrain_zenoh.navigation.planner import Path, Planner, Unreachable

GIVE_UP_TICKS = 1500  # 30 s of driving without coming any nearer
NO_PROGRESS = "no progress for 30 s"
LEAVE_TICKS = 500  # 10 s, for a place that is only to be looked at
REMEMBERED_TICKS = 500  # 10 s, that what was in the way stays in the plans
MUCH_BETTER_M = 1.5  # so much better has another frontier to be, or it goes to and fro
OPEN, FAR_M = 2.0, 1.5  # cost of a place worth visiting, and the way there at least [m]
SURE_TICKS = 125  # 2.5 s: the map comes once a second
ARRIVED_M = LocalSettings().position_tolerance  # so near a goal the robot has arrived
BESIDE_M = 0.25  # so near will do, for a goal that was free when it was asked for: maps shift
TAKEN_TICKS = 500  # 10 s without coming nearer to a goal where something is
SAME_M = 0.6  # a frontier so near is the same one: it moves as the map grows


@dataclass(frozen=True, kw_only=True, eq=False)
class Asked:
    """What a route is wanted for."""

    tick: int
    order: Order
    here: Pose  # in the map
    grid: OccupancyGrid
    body: BodyDescription
    driven: Driven | None  # what became of the last route
    seen: Floats  # (n, 2) [m], what is round the robot now, in the map
    held_ticks: int = 0  # since the last route: the body did not follow decision, or had to wait
    slowed_by: str = ""  # what safety says holds it back, in words


class Guide:
    """Plans route after route. Not for two threads at once."""

    def __init__(self, unknown: Unknown = "avoid") -> None:
        self._planner, self._unknown = Planner(), unknown
        self._costmap: Costmap | None = None
        self._drawn: tuple[object, ...] = ()
        self._in_the_way: Floats = np.empty((0, 2))
        self._in_the_way_tick = 0
        self._version = 0
        self._forget(0, 0)

    def think(self, asked: Asked) -> Route:
        """The route for an order, from here."""
        anew = asked.tick < self._last_tick  # the driver has been started anew
        if anew or asked.order.number != self._number:
            self._forget(asked.order.number, asked.tick)
        self._note(asked)
        if isinstance(asked.order, GoTo):
            goal = asked.order.goal
            asked = replace(asked, grid=self._with_room(asked.grid, goal))
            return self._to(goal, asked, self._chart(asked))
        chart = self._chart(asked)
        if isinstance(asked.order, Visit):
            return self._to(self._goal or self._anywhere(asked, chart), asked, chart)
        return self._onward(asked, chart)

    def check(self, grid: OccupancyGrid, body: BodyDescription, here: Pose, goal: Goal) -> str:
        """The way to a goal in words. Raises Refused, and why, where there is none."""
        room = self._with_room(grid, goal)
        chart = costmap(room, inflation(body, self._unknown), before=None)
        start, planner = (here.x, here.y), Planner()
        found, beside = planner.plan(chart, start, (goal.x, goal.y)), ""
        if isinstance(found, Unreachable) and found.nearest and found.distance <= ARRIVED_M:
            beside = f"; {_beside(found)}"
            found = planner.plan(chart, start, found.nearest)
        if isinstance(found, Unreachable):
            raise Refused(found.reason)
        return f"on the way, {found.remaining[0]:.1f} m{beside}"

    def _with_room(self, grid: OccupancyGrid, goal: Goal) -> OccupancyGrid:
        """The map to look for a goal in: one who may go anywhere may also leave the map."""
        return widened(grid, goal) if self._unknown == "allow" else grid

    def _forget(self, number: int, tick: int) -> None:
        self._number = number
        self._path: Path | None = None
        self._found: Path | None = None  # the last way to this goal that there was
        self._goal: Goal | None = None
        self._settled: tuple[Goal, str] | None = None  # where it is to stay near its goal, and why
        self._been: list[tuple[float, float]] = []
        self._doing = ""  # what the local planner did last, in words
        self._progress, self._last_tick = Progress(tick), tick
        self._open_tick = tick  # when there was something left to be seen
        self._version += 1
        self._courtesy = Courtesy()

    def _note(self, asked: Asked) -> None:
        """Take note of what became of the last route."""
        driven = asked.driven
        passed, self._last_tick = max(0, asked.tick - self._last_tick), asked.tick
        self._progress.hold(min(asked.held_ticks, passed))  # whoever is held back is not stuck
        self._doing = driven.reason if driven else self._doing
        if driven and driven.blocked and driven.version == self._version:
            self._in_the_way, self._in_the_way_tick = asked.seen, asked.tick
        elif asked.tick - self._in_the_way_tick > REMEMBERED_TICKS:
            self._in_the_way = np.empty((0, 2))

    def _chart(self, asked: Asked) -> Costmap:
        drawn = (asked.grid, asked.body, self._in_the_way_tick if len(self._in_the_way) else 0)
        same = self._drawn and all(
            a is b or a == b for a, b in zip(drawn, self._drawn, strict=True)
        )
        if self._costmap is None or not same:
            rules = inflation(asked.body, self._unknown)
            self._costmap = costmap(asked.grid, rules, self._in_the_way, self._costmap)
            self._drawn = drawn
        return self._costmap

    def _to(self, goal: Goal, asked: Asked, chart: Costmap) -> Route:
        first, wanted = self._goal is None, goal
        goal, beside = self._settled or (goal, "")
        found = self._plan(goal, asked.here, chart)
        room = None if first else self._making_room(goal, asked, chart)
        if room:
            return room
        near = ARRIVED_M if first else BESIDE_M
        if isinstance(found, Unreachable) and found.nearest and found.distance <= near:
            beside = _beside(found)
            goal = Goal(x=found.nearest[0], y=found.nearest[1], yaw=goal.yaw)
            found = self._planner.plan(chart, (asked.here.x, asked.here.y), found.nearest)
        if isinstance(found, Unreachable):
            if first or self._progress.stuck(asked.tick, GIVE_UP_TICKS):
                return self._ended("failed", found.reason)
            if self._found:  # noise closes narrow ways in the map; what is near shows up there
                return self._going(goal, self._found)
            return self._looking(found, asked, chart)
        self._found = found
        self._progress.measure(float(found.remaining[0]), asked.tick)
        if self._progress.stuck(asked.tick, GIVE_UP_TICKS):
            if not self._settles(wanted, asked):
                left = f"{found.remaining[0]:.2f} m from the goal"
                return self._ended("failed", f"gave up: {NO_PROGRESS}, {left}{self._why(asked)}")
            return self._to(wanted, asked, chart)
        return self._going(goal, found, beside)

    def _settles(self, goal: Goal, asked: Asked) -> bool:
        """Whether it is to stay where it is, as it cannot come nearer and is near enough."""
        x, y = asked.here.x, asked.here.y
        off = math.hypot(goal.x - x, goal.y - y)
        if self._settled or not THERE_M < off <= BESIDE_M:
            return False
        why = f"{off:.2f} m beside what was asked for: {NO_PROGRESS}{self._why(asked)}"
        self._settled, self._progress = (Goal(x=x, y=y, yaw=goal.yaw), why), Progress(asked.tick)
        self._version += 1
        return True

    def _why(self, asked: Asked) -> str:
        """What is known of why it makes no progress."""
        why = asked.slowed_by or self._doing
        return f" ({why})" if why else ""

    def _making_room(self, goal: Goal, asked: Asked, chart: Costmap) -> Route | None:
        """Out of the way of whoever stands at the goal, and may wait for the robot to leave."""
        here, stuck = (asked.here.x, asked.here.y), self._progress.stuck(asked.tick, TAKEN_TICKS)
        search = self._planner.search
        if self._courtesy.look(goal, here, asked.tick, stuck, chart, search):
            self._progress, self._found = Progress(asked.tick), None
            self._version += 1
        place = self._courtesy.place
        way = self._planner.plan(chart, here, (place.x, place.y)) if place else None
        if place is None or not isinstance(way, Path):
            return None
        return replace(self._going(place, way, "making room: something is at the goal"), aside=True)

    def _looking(self, found: Unreachable, asked: Asked, chart: Costmap) -> Route:
        """As near as it can come to a goal: what stood there may have gone out of its sight."""
        nearest = found.nearest
        way = self._planner.plan(chart, (asked.here.x, asked.here.y), nearest) if nearest else None
        if nearest is None or not isinstance(way, Path):
            return self._waiting(found.reason)
        x, y = nearest
        reason = f"looking whether there is room: {found.reason.partition(';')[0]}"
        return replace(self._going(Goal(x=x, y=y), way, reason), aside=True)

    def _anywhere(self, asked: Asked, chart: Costmap) -> Goal:
        """A place in the open that can be reached; where it is, if there is no other."""
        start, here = chart.cell(asked.here.x, asked.here.y), asked.here
        if start is not None:
            way = self._planner.search.field(chart.cost, start, "from") * chart.resolution
            rows, columns = np.nonzero((chart.cost < OPEN) & (way > FAR_M) & np.isfinite(way))
            if len(rows):
                one = int(np.random.default_rng(asked.order.number).integers(len(rows)))
                x, y = chart.points(rows[one : one + 1], columns[one : one + 1])[0].tolist()
                return Goal(x=x, y=y)
        return Goal(x=here.x, y=here.y)

    def _onward(self, asked: Asked, chart: Costmap) -> Route:
        """To the next place from which something new can be seen."""
        here = asked.here.x, asked.here.y
        arrived = asked.driven is not None and asked.driven.arrived
        if self._goal and (arrived or self._progress.stuck(asked.tick, LEAVE_TICKS)):
            self._been.append((self._goal.x, self._goal.y))
            self._leave(asked.tick)
        for _ in range(len(self._been) + 10):
            goal = self._frontier(chart, here)
            if goal is None:
                return self._mapped(asked, chart)
            self._open_tick = asked.tick
            if self._goal and math.hypot(goal.x - self._goal.x, goal.y - self._goal.y) > SAME_M:
                self._leave(asked.tick)
            found = self._plan(goal, asked.here, chart)
            if isinstance(found, Path):
                self._progress.measure(float(found.remaining[0]), asked.tick)
                return self._going(goal, found)
            self._been.append((goal.x, goal.y))
        return self._waiting("no way leads to what is still unknown")

    def _mapped(self, asked: Asked, chart: Costmap) -> Route:
        """Nothing is left to be seen, if that is still so once the map has caught up."""
        cell = chart.cell(asked.here.x, asked.here.y)
        if cell is None or chart.cells[cell] < 0:
            return self._waiting("the map does not reach here yet")
        if asked.tick - self._open_tick < SURE_TICKS:
            return self._waiting("nothing new in sight; looking once more")
        return self._ended("done", "all is mapped that can be reached")

    def _frontier(self, chart: Costmap, here: tuple[float, float]) -> Goal | None:
        """The best frontier; the present one, unless another is much better."""
        found = frontiers(chart, here, self._been, self._planner.search)
        if not found:
            return None
        best = min(found, key=lambda one: one.score)
        if self._goal:
            x, y = self._goal.x, self._goal.y
            same = min(found, key=lambda one: math.hypot(one.x - x, one.y - y))
            near = math.hypot(same.x - x, same.y - y) <= SAME_M
            if near and same.score < best.score + MUCH_BETTER_M:
                best = same
        return Goal(x=best.x, y=best.y)

    def _plan(self, goal: Goal, here: Pose, chart: Costmap) -> Path | Unreachable:
        start, end = (here.x, here.y), (goal.x, goal.y)
        if self._path is None or goal != self._goal:
            found = self._planner.plan(chart, start, end)
        else:
            found = self._planner.replan(chart, start, end, self._path)
        self._goal = goal
        self._path = found if isinstance(found, Path) else None
        return found

    def _leave(self, tick: int) -> None:
        """This goal is done with; the next is another."""
        self._goal = self._path = self._found = None
        self._progress = Progress(tick)
        self._version += 1

    def _going(self, goal: Goal, path: Path, reason: str = "") -> Route:
        number, version = self._number, self._version
        return Route(number=number, version=version, goal=goal, points=path.points, reason=reason)

    def _waiting(self, reason: str) -> Route:
        return Route(number=self._number, version=self._version, reason=reason)

    def _ended(self, state: Literal["done", "failed"], reason: str) -> Route:
        return Route(number=self._number, version=self._version, state=state, reason=reason)


def _beside(found: Unreachable) -> str:
    """How far from its goal the robot goes instead, and why."""
    fault = found.reason.partition(";")[0]
    return f"{found.distance:.2f} m beside what was asked for: {fault}"
