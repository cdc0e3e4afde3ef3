"""Route planning for drive commands: the next place, the path to it, and when to give up."""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.behaviours import DriveCommand, Target
from gigabrain_zenoh.decision.enlarging import enlarged
from gigabrain_zenoh.decision.give_way import NEAR_M, SAME_M, GiveWay, nearest, standing
from gigabrain_zenoh.decision.progress import AT_GOAL_M, ProgressMonitor
from gigabrain_zenoh.decision.seeking import LookAround, place_before, random_place
from gigabrain_zenoh.navigation.contours import ContourMemory
from gigabrain_zenoh.navigation.costmap import (
    LETHAL,
    Costmap,
    Unknown,
    ZoneOverlay,
    costmap,
    inflation,
    with_zones,
)
from gigabrain_zenoh.navigation.global_planner import NO_WAY, Path, Unreachable, frontiers
from gigabrain_zenoh.navigation.local_planner import LocalSettings
from gigabrain_zenoh.navigation.path_planner import PathPlanner
from gigabrain_zenoh.navigation.zones import NO_ZONES, ZoneMap

GIVE_UP_TICKS = 1500  # 30 s of driving without progress
NO_PROGRESS = "no progress for 30 s"
LEAVE_FRONTIER_TICKS = 500  # 10 s without progress towards a frontier or a place to look from
BLOCKED_MEMORY_TICKS = 500  # plans avoid for 10 s the hits that blocked a route
FRONTIER_HYSTERESIS_M = 1.5  # minimum gain for another frontier
SAME_FRONTIER_M = 0.6  # a frontier moves as the map grows
FRONTIER_CONFIRM_TICKS = 125  # 2.5 s: the map is published once a second
ARRIVED_M = LocalSettings().position_tolerance
NEAR_GOAL_M = 0.25  # tolerance for a goal that was free when it was requested: maps shift
OCCUPIED_TICKS = 500  # give way after 10 s without progress towards an occupied goal,
STANDING_TICKS = 250  # or after 5 s near a person who walked there and stands

WAY_OPENS_TICKS = 500  # wait 10 s for people to clear the way before giving up
LOOKING = "looking around"  # activity of a search

Point = tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Route:
    """A path through the map for one drive command, or why there is none."""

    number: int  # of the command
    version: int  # changes with the destination
    goal: Goal | None = None
    points: Floats | None = None  # (n, 2) [m] in the map
    headings: Floats | None = None  # (n, 2), only for cars, see navigation.global_planner.Path
    state: Literal["running", "done", "failed"] = "running"
    reason: str = ""  # shown to users
    activity: str = ""  # set if the destination is temporary: the command is not done there


@dataclass(frozen=True, kw_only=True)
class RouteFeedback:
    """The local planner's feedback on a route after one scan."""

    version: int
    arrived: bool = False
    blocked: bool = False  # another route is needed
    reason: str = ""  # what the local planner did, shown to users


@dataclass(frozen=True, kw_only=True, eq=False)
class RouteRequest:
    """Input of the route planner."""

    tick: int
    command: DriveCommand
    here: Pose  # in the map
    grid: OccupancyGrid
    body: BodyDescription
    feedback: RouteFeedback | None  # of the last route
    seen: Floats  # (n, 2) [m], hits of the newest scan, in the map
    contours: tuple[Floats, ...] = ()  # polygons (n, 2) [m] in the map, seen by cameras
    walkers: Floats = field(default_factory=lambda: np.empty((0, 3)))  # see give_way.Walkers
    zones: ZoneMap = NO_ZONES
    inflation: float | None = None  # [m], see NavigationConfig
    held_ticks: int = 0  # time since the last request in which the body could not follow a route
    slowed_by: str = ""  # causes that safety reports, shown to users


@dataclass(frozen=True, kw_only=True)
class PathCheck:
    """Length of the path to a goal [m], and why the path ends elsewhere; empty if it does not."""

    length_m: float
    offset: str = ""


class RoutePlanner:
    """Plans routes for one command after another. Not thread-safe."""

    def __init__(self, unknown_space: Unknown = "avoid") -> None:
        self._planner, self._unknown_space = PathPlanner(), unknown_space
        self._costmap: Costmap | None = None
        self._bare: Costmap | None = None  # `_costmap` without zones
        self._costmap_key: tuple[object, ...] = ()
        self._overlay: ZoneOverlay | None = None
        self._overlay_key: tuple[object, ...] = ()
        self._zones = NO_ZONES
        self._zones_changed = False  # since the last plan
        self._blocking: Floats = np.empty((0, 2))  # hits that blocked a route
        self._blocking_tick = 0
        self._contours = ContourMemory()
        self._looks = LookAround()
        self._version = 0
        self._reset(0, 0)

    def plan(self, request: RouteRequest) -> Route:
        """Return the route for a command from the robot's current place."""
        restarted = request.tick < self._last_tick  # the driver
        command = request.command
        if restarted:
            self._contours.forget()
            self._blocking = np.empty((0, 2))
            self._looks = LookAround()
        if restarted or command.number != self._number:
            self._reset(command.number, request.tick)
        self._contours.update(request.tick, request.here, request.body, request.contours)
        self._update(request)
        if command.goal:
            request = replace(request, grid=self._enlarged(request.grid, command.goal))
            return self._to_goal(command.goal, request, self._update_costmap(request))
        costs = self._update_costmap(request)
        if command.target:
            return self._to_target(command.target, request, costs)
        if command.kind == "look":
            return self._look(request, costs)
        if command.kind == "visit":
            return self._to_goal(
                self._goal
                or random_place(costs, request.here, command.number, self._planner.search),
                request,
                costs,
            )
        return self._explore(request, costs)

    def check(
        self,
        grid: OccupancyGrid,
        body: BodyDescription,
        here: Pose,
        goal: Goal,
        zones: ZoneMap = NO_ZONES,
    ) -> PathCheck | Unreachable:
        """Return the length of the path to a goal, or why there is none."""
        rules, grid = inflation(body, self._unknown_space), self._enlarged(grid, goal)
        bare = costmap(grid, rules, before=None)
        costs = with_zones(bare, zones.overlay(grid, rules))
        planner = PathPlanner()
        found, offset = planner.plan(costs, body, here, goal), ""
        if isinstance(found, Unreachable) and found.nearest and found.distance <= ARRIVED_M:
            offset = _offset(found)
            x, y = found.nearest
            found = planner.plan(costs, body, here, Goal(x=x, y=y, yaw=goal.yaw))
        if isinstance(found, Unreachable):
            return explained(found, zones, bare, body, here, goal)
        return PathCheck(length_m=float(found.remaining[0]), offset=offset)

    def _enlarged(self, grid: OccupancyGrid, goal: Goal) -> OccupancyGrid:
        return enlarged(grid, goal) if self._unknown_space == "allow" else grid

    def _reset(self, number: int, tick: int) -> None:
        self._number = number
        self._path: Path | None = None
        self._last_path: Path | None = None  # the last path to this goal that was found
        self._goal: Goal | None = None
        self._settled: tuple[Goal, str] | None = None  # place accepted near the goal, and why
        self._visited: list[Point] = []  # frontiers that were reached
        self._missed: list[Point] = []  # frontiers that were given up
        self._local_reason = ""  # of the local planner, shown to users
        self._progress, self._last_tick = ProgressMonitor(tick), tick
        self._last_frontier_tick = tick
        self._version += 1
        self._give_way = GiveWay()

    def _update(self, request: RouteRequest) -> None:
        """Record how the last route was followed."""
        feedback = request.feedback
        elapsed_ticks, self._last_tick = max(0, request.tick - self._last_tick), request.tick
        self._progress.hold(min(request.held_ticks, elapsed_ticks))
        self._zones_changed = request.zones is not self._zones
        if self._zones_changed:  # old paths may lead through new zones
            self._zones, self._path, self._last_path = request.zones, None, None
        self._local_reason = feedback.reason if feedback else self._local_reason
        if feedback and feedback.blocked and feedback.version == self._version:
            self._blocking, self._blocking_tick = request.seen, request.tick
        elif request.tick - self._blocking_tick > BLOCKED_MEMORY_TICKS:
            self._blocking = np.empty((0, 2))

    def _arrived(self, request: RouteRequest) -> bool:
        """Return whether the robot arrived by the current route, not by an older one."""
        feedback = request.feedback
        return feedback is not None and feedback.arrived and feedback.version == self._version

    def _update_costmap(self, request: RouteRequest) -> Costmap:
        blocked = self._blocking_tick if len(self._blocking) else 0
        seen = self._contours.version
        key = (request.grid, request.body, blocked, seen, request.inflation, request.zones)
        old_key = self._costmap_key
        same = old_key and all(a is b or a == b for a, b in zip(key, old_key, strict=True))
        if self._costmap is None or not same:
            rules = inflation(request.body, self._unknown_space, request.inflation)
            points = np.concatenate((self._blocking, self._contours.points))
            self._bare = costmap(request.grid, rules, points, self._bare, reuse=True)
            self._costmap = with_zones(self._bare, self._zone_overlay(request, self._bare))
            self._costmap_key = key
        return self._costmap

    def _zone_overlay(self, request: RouteRequest, bare: Costmap) -> ZoneOverlay | None:
        """Return the overlay of the zones, cached until they or the grid's bounds change."""
        shape = (bare.resolution, bare.origin_x, bare.origin_y, bare.cost.shape)
        key = (request.zones, bare.inflation, *shape)
        if key != self._overlay_key:
            self._overlay = request.zones.overlay(request.grid, bare.inflation)
            self._overlay_key = key
        return self._overlay

    def _to_goal(self, goal: Goal, request: RouteRequest, costs: Costmap) -> Route:
        first, requested = self._goal is None, goal
        goal, offset = self._settled or (goal, "")
        found = self._find(goal, request, costs)
        aside = None if first else self._move_aside(goal, request, costs)
        if aside:
            return aside
        tolerance = ARRIVED_M if first else NEAR_GOAL_M
        if isinstance(found, Unreachable) and found.nearest and found.distance <= tolerance:
            offset = _offset(found)
            goal = Goal(x=found.nearest[0], y=found.nearest[1], yaw=goal.yaw)
            found = self._planner.plan(costs, request.body, request.here, goal)
        if isinstance(found, Unreachable):
            assert self._bare
            why = explained(found, self._zones, self._bare, request.body, request.here, goal)
            closed_by_zone = self._zones_changed and why is not found
            may_open = found.fault == NO_WAY or len(self._contours.points) > 0  # seen things move
            stuck = self._progress.stuck(request.tick, GIVE_UP_TICKS)
            if (first and not may_open) or closed_by_zone or stuck:
                return self._route(state="failed", reason=why.reason)
            if self._last_path:  # noise in the map closes narrow ways that the scan shows open
                return self._go(goal, self._last_path)
            return self._approach(found, request, costs)
        self._last_path = found
        self._progress.measure(float(found.remaining[0]), request.tick)
        if self._progress.stuck(request.tick, GIVE_UP_TICKS):
            if not self._settle(requested, request):
                left = f"{found.remaining[0]:.2f} m from the goal"
                reason = f"gave up: {NO_PROGRESS}, {left}{self._why_slow(request)}"
                return self._route(state="failed", reason=reason)
            return self._to_goal(requested, request, costs)
        return self._go(goal, found, offset)

    def _settle(self, goal: Goal, request: RouteRequest) -> bool:
        """Accept the current place as the goal if it is near enough; return whether it is."""
        x, y = request.here.x, request.here.y
        distance = math.hypot(goal.x - x, goal.y - y)
        if self._settled or not AT_GOAL_M < distance <= NEAR_GOAL_M:
            return False
        why = f"{distance:.2f} m from the requested goal: {NO_PROGRESS}{self._why_slow(request)}"
        self._settled = Goal(x=x, y=y, yaw=goal.yaw), why
        self._progress = ProgressMonitor(request.tick)
        self._version += 1
        return True

    def _why_slow(self, request: RouteRequest) -> str:
        why = request.slowed_by or self._local_reason
        return f" ({why})" if why else ""

    def _move_aside(self, goal: Goal | None, request: RouteRequest, costs: Costmap) -> Route | None:
        """Return a route away from a person at the goal or in the way, if the robot gives way."""
        here = request.here.x, request.here.y
        give_way, search = self._give_way, self._planner.search
        if give_way.place and give_way.left:
            other = nearest(request.walkers, give_way.left, SAME_M)
        else:
            other = nearest(standing(request.walkers, request.seen), here, NEAR_M)
        why = "a person or a moving obstacle is in the way"
        stuck = self._progress.stuck(request.tick, STANDING_TICKS)
        cell = costs.cell(goal.x, goal.y) if goal else None
        if goal and cell is not None and costs.cost[cell] > LETHAL:
            ahead = math.atan2(here[1] - goal.y, here[0] - goal.x)
            other, why = (goal.x, goal.y, ahead), "the goal is occupied"
            stuck = self._progress.stuck(request.tick, OCCUPIED_TICKS)
        if give_way.update(other, here, request.tick, stuck, costs, search):
            self._progress, self._last_path = ProgressMonitor(request.tick), None
            self._version += 1
        place = give_way.place
        way = self._planner.plan(costs, request.body, request.here, place) if place else None
        if place is None or not isinstance(way, Path):
            return None
        return self._go(place, way, why, "giving way")

    def _approach(self, found: Unreachable, request: RouteRequest, costs: Costmap) -> Route:
        """Return a route to the nearest reachable place, to check if the goal is free again."""
        place = Goal(x=found.nearest[0], y=found.nearest[1]) if found.nearest else None
        way = self._planner.plan(costs, request.body, request.here, place) if place else None
        if place is None or not isinstance(way, Path):
            return self._route(reason=found.reason)
        return self._go(place, way, found.fault, "checking whether the goal is free")

    def _explore(self, request: RouteRequest, costs: Costmap) -> Route:
        """Return a route to the best frontier."""
        here = request.here.x, request.here.y
        arrived = self._arrived(request)
        if self._goal and (arrived or self._progress.stuck(request.tick, LEAVE_FRONTIER_TICKS)):
            (self._visited if arrived else self._missed).append((self._goal.x, self._goal.y))
            self._drop_frontier(request.tick)
        for _ in range(len(self._visited) + len(self._missed) + 10):
            goal = self._frontier(costs, here)
            if goal is None:
                return self._explored(request, costs)
            self._last_frontier_tick = request.tick
            if (
                self._goal
                and math.hypot(goal.x - self._goal.x, goal.y - self._goal.y) > SAME_FRONTIER_M
            ):
                self._drop_frontier(request.tick)
            found = self._find(goal, request, costs)
            if isinstance(found, Path):
                self._progress.measure(float(found.remaining[0]), request.tick)
                return self._go(goal, found)
            self._missed.append((goal.x, goal.y))
        return self._route(reason="no path to unexplored space")

    def _to_target(self, target: Target, request: RouteRequest, costs: Costmap) -> Route:
        """Return a route to a place in front of an object or a tag."""
        around = costs, request.body, request.here
        goal = self._goal or place_before(*around, target, self._planner.search)
        if goal is None:
            if aside := self._move_aside(None, request, costs):
                return aside
            reason = f"no free and reachable place in front of {target.name}"
            ended = self._progress.stuck(request.tick, WAY_OPENS_TICKS)
            return self._route(state="failed" if ended else "running", reason=reason)
        route = self._to_goal(goal, request, costs)
        before = f"in front of {target.name}"
        return replace(route, reason=f"{before}, {route.reason}" if route.reason else before)

    def _look(self, request: RouteRequest, costs: Costmap) -> Route:
        """Return a route to a place from where unseen space is visible, or to a frontier."""
        if request.command.seek != self._looks.seek:
            self._looks = LookAround(request.command.seek, request.tick)
        looks, around = self._looks, (costs, request.body, request.here)
        on_the_way = looks.goal is not None and self._goal == looks.goal
        looks.look(*around, request.tick)
        arrived = self._arrived(request)
        stuck = self._progress.stuck(request.tick, LEAVE_FRONTIER_TICKS)
        if on_the_way and looks.goal and (arrived or stuck):
            looks.give_up()
        if on_the_way and looks.goal is None:
            self._drop_frontier(request.tick)
        while goal := looks.next_goal(*around, self._planner.search):
            if self._goal not in (None, goal):
                self._drop_frontier(request.tick)
            found = self._find(goal, request, costs)
            if isinstance(found, Path):
                looks.ended_tick = None
                self._progress.measure(float(found.remaining[0]), request.tick)
                return self._go(goal, found, activity=LOOKING)
            looks.give_up()
        route = self._explore(request, costs)
        if route.points is not None:
            looks.ended_tick = None
            return replace(route, activity=LOOKING)
        if route.state == "running":
            return route
        if not looks.settled(request.tick):
            return self._route(reason="looking at the last unseen places")
        if looks.look_closer():
            self._missed.clear()
            return self._route(reason="looking at everything again, from nearer")
        if looks.ended_tick is None:
            looks.ended_tick = request.tick
        if aside := self._move_aside(None, request, costs):
            looks.ended_tick = request.tick
            return aside
        if request.tick - looks.ended_tick < WAY_OPENS_TICKS:
            return self._route(reason="everything reachable was seen; waiting for another way")
        if self._missed and looks.try_again():
            self._missed.clear()
            return self._route(reason="trying again to reach unexplored space")
        return replace(route, reason="everything reachable was seen")

    def _explored(self, request: RouteRequest, costs: Costmap) -> Route:
        """End the exploration once updates of the map bring no new frontier."""
        cell = costs.cell(request.here.x, request.here.y)
        if cell is None or costs.cells[cell] < 0:
            return self._route(reason="the robot is outside the map")
        if request.tick - self._last_frontier_tick < FRONTIER_CONFIRM_TICKS:
            return self._route(reason="no frontier left; waiting for the next map")
        return self._route(state="done", reason="everything reachable is explored")

    def _frontier(self, costs: Costmap, here: Point) -> Goal | None:
        """Return the best frontier, but keep the current one unless another is much better."""
        found = frontiers(costs, here, (*self._visited, *self._missed), self._planner.search)
        if not found:
            return None
        best = min(found, key=lambda frontier: frontier.score)
        if self._goal:
            x, y = self._goal.x, self._goal.y
            current = min(found, key=lambda frontier: math.hypot(frontier.x - x, frontier.y - y))
            same = math.hypot(current.x - x, current.y - y) <= SAME_FRONTIER_M
            if same and current.score < best.score + FRONTIER_HYSTERESIS_M:
                best = current
        return Goal(x=best.x, y=best.y)

    def _find(self, goal: Goal, request: RouteRequest, costs: Costmap) -> Path | Unreachable:
        here, body = request.here, request.body
        if self._path is None or goal != self._goal:
            found = self._planner.plan(costs, body, here, goal)
        else:
            found = self._planner.replan(costs, body, here, goal, self._path)
        self._goal = goal
        self._path = found if isinstance(found, Path) else None
        return found

    def _drop_frontier(self, tick: int) -> None:
        self._goal = self._path = self._last_path = None
        self._progress = ProgressMonitor(tick)
        self._version += 1

    def _go(self, goal: Goal, path: Path, reason: str = "", activity: str = "") -> Route:
        points, headings = path.points, path.headings
        return self._route(
            goal=goal, points=points, headings=headings, reason=reason, activity=activity
        )

    def _route(self, **fields: Any) -> Route:
        return Route(number=self._number, version=self._version, **fields)


def explained(
    found: Unreachable, zones: ZoneMap, bare: Costmap, body: BodyDescription, here: Pose, goal: Goal
) -> Unreachable:
    """Return `found`, with the zone that closes the way if one does; `bare` is without zones."""
    if problem := zones.problem(goal.x, goal.y, bare.inflation.fits):
        return replace(found, fault=f"the goal {problem}")
    if found.fault != NO_WAY or zones.empty:
        return found
    path = PathPlanner().plan(bare, body, here, goal)
    if isinstance(path, Unreachable):
        return found
    return replace(found, fault=f"{NO_WAY} {zones.in_the_way(path.points)}")


def _offset(found: Unreachable) -> str:
    """Return, for users, how far from its goal the robot goes instead, and why."""
    return f"{found.distance:.2f} m from the requested goal: {found.fault}"
