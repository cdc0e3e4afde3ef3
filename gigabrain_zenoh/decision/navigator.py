"""The navigator: carries out drive commands with a route planner and a local planner.

The import is slow; meanwhile `task_server` already serves goals.
"""

import asyncio
import dataclasses
import math
from typing import Any

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.tasks import MAX_POINTS, Goal
from gigabrain_schemas.zones import Zone
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.decision.behaviours import (
    DriveCommand,
    Idle,
    NavigationConfig,
    StepOutcome,
    StepResult,
    WaitReason,
    describe_goal,
)
from gigabrain_zenoh.decision.context import ContextSource, NavigationContext
from gigabrain_zenoh.decision.route import (
    PathCheck,
    Route,
    RouteFeedback,
    RoutePlanner,
)
from gigabrain_zenoh.decision.route_schedule import RouteSchedule
from gigabrain_zenoh.decision.zones import ZoneSource
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.geometry.pose import compose, inverse
from gigabrain_zenoh.geometry.se2 import from_pose, transform
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.navigation import global_planner, local_planner
from gigabrain_zenoh.navigation.contours import placed
from gigabrain_zenoh.navigation.costmap import inflation
from gigabrain_zenoh.navigation.global_planner import Unreachable
from gigabrain_zenoh.navigation.local_planner import DEFAULTS, LocalSettings
from gigabrain_zenoh.navigation.warm_up import warm_up_local_planner
from gigabrain_zenoh.navigation.zones import NO_ZONES, SpeedCap, ZoneMap

EXACT_M = 0.05  # position tolerance of the body for work of the arm
CLOSE_UP_M = 0.25  # from the goal, where `close_up` slows the body
BAR_STEP_M = 0.02  # between points of a bar, which leaves no gap in the planner's cells
MAX_SCAN_AGE_TICKS = 10  # while driving
MAX_NEAR_OVER_M = 0.25  # a larger value makes all clearances in the window cost the same
NO_ROUTE = Idle("waiting", "waiting: for a path through the map")

ANY_BODY = BodyDescription(
    robot_type="any", drive_type="differential",
    footprint=((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)),
    max_linear_speed=1.0, max_angular_speed=1.0, max_linear_acceleration=1.0,
    max_linear_deceleration=1.0, max_angular_acceleration=1.0,
)  # fmt: skip


class Navigator:
    """Drives one robot by its map."""

    def __init__(
        self,
        config: NavigationConfig,
        bus: Bus,
        source: ContextSource,
        behaviour: str,
        zones: ZoneSource,
    ) -> None:
        self._bus, self._config, self._behaviour = bus, config, behaviour
        self._source, self._zones = source, zones  # the owner passes states to the source
        self._zone_map, self._mapped_zones = NO_ZONES, tuple[Zone, ...]()
        self._routes = RouteSchedule(config, bus)
        self._context: NavigationContext | None = None
        self._boot = 0
        self._got_scan = False  # at least one plausible scan was received
        self._oriented = False  # pose and map were known together at least once
        self._number = 0  # of the current command
        self._longest_m = 0.0  # longest remaining path of this command, for its progress
        self._local: local_planner.LocalPlanner | None = None
        self._body: BodyDescription | None = None

    def configure(self, config: NavigationConfig) -> None:
        """Replace the settings; the local planner keeps its memory."""
        self._config, self._routes.inflation = config, config.inflation
        if self._local and self._body:
            self._local.configure(self._body, _local_settings(config, self._body))

    def at_scan(
        self, state: RobotState, world: WorldModel | None, verdict: SafetyState | None
    ) -> NavigationContext:
        """Collect the inputs of the next step, and install a route that is due."""
        if state.boot != self._boot:  # the driver restarted, and the odometry with it
            self._boot, self._local, self._number = state.boot, None, 0
        if world:
            self._got_scan = self._got_scan or world.scan_ok
            self._routes.at_scan()
        self._context = context = self._source.at_scan(state, world, verdict)
        self._routes.count_held(state.boot, context.tick, context.held)
        if context.zones is not self._mapped_zones and context.zones != self._mapped_zones:
            self._zone_map = ZoneMap(context.zones)
        self._mapped_zones = context.zones
        return context

    def drive(self, command: DriveCommand | None, idle: Idle) -> StepResult:
        """Carry out `command` for one scan, or stand still as `idle` says.

        Call it once after each `at_scan`.
        """
        context = self._context
        assert context
        route = self._update_route(context, command)
        waiting = _reason_to_wait(context, command)
        if waiting or command is None or route is None or route.number != command.number:
            self._routes.report(None)
            return self._stand(command, waiting or (NO_ROUTE if command else idle))
        if command.number != self._number:
            self._number, self._longest_m = command.number, 0.0
        if route.goal is None or route.points is None:
            self._routes.report(None)
            return self._without_path(context, command, route)
        return self._follow(context, command, route, route.goal, route.points)

    def close(self) -> None:
        """Stop the worker thread."""
        self._routes.close()

    @property
    def hung(self) -> bool:
        """Return whether the plan in the worker thread will never finish."""
        return self._routes.hung

    @property
    def located(self) -> bool:
        """Return whether the robot's pose in the map was known at the last scan."""
        return self._context is not None and self._context.here is not None

    @property
    def waits(self) -> WaitReason | None:
        """Return what the start-up waits for; None once pose and map were known."""
        if self._oriented:
            return None
        if not self._got_scan:
            return WaitReason.PERCEPTION_STARTING
        lost = self._source.lost
        return None if lost is WaitReason.NO_LOCALIZATION else lost or WaitReason.NO_MAP

    @property
    def lost(self) -> WaitReason:
        """Return why the robot's pose in the map is unknown, or that there is no map."""
        return self._source.lost or WaitReason.NO_MAP

    async def check(self, goal: Goal) -> PathCheck:
        """Return the path to `goal`. Raises Refused, with the reason, if there is none."""
        now = self._bus.time.boot, self._bus.time.tick + 1
        grid, zones = self._source.grid(*now), ZoneMap(self._zones.newest.zones)
        body, here = self._source.body, self._context.here if self._context else None
        if grid is None or body is None or here is None:
            raise Refused(self.lost)
        # a separate planner: the other one may be planning in the worker thread
        routes = RoutePlanner(self._config.unknown_space)
        result = await asyncio.to_thread(routes.check, grid, body, here, goal, zones)
        if isinstance(result, Unreachable):
            raise Refused(result.reason)
        return result

    def _update_route(
        self, context: NavigationContext, command: DriveCommand | None
    ) -> Route | None:
        here, world = context.here, context.world
        self._routes.watch(context)
        if here and world:
            grid = self._source.grid(world.boot, world.basis)
            self._oriented = self._oriented or grid is not None
            if command and grid:
                self._routes.request(context, here, command, grid, self._zone_map)
        return self._routes.route

    def _stand(self, command: DriveCommand | None, idle: Idle) -> StepResult:
        reason = idle.reason[:500]
        number = command.number if command else 0
        outcome = StepOutcome(number=number, activity=idle.activity, reason=reason)
        return self._intent(reason=reason), outcome

    def _without_path(
        self, context: NavigationContext, command: DriveCommand, route: Route
    ) -> StepResult:
        assert context.map_from_odom
        here = compose(context.map_from_odom, context.pose)
        position_error, heading_error = _errors(command, here)
        outcome = StepOutcome(
            number=command.number, state=route.state, reason=route.reason, activity="waiting",
            position_error=position_error, heading_error=heading_error,
        )  # fmt: skip
        return self._intent(reason=f"waiting: {route.reason}"[:500]), outcome

    def _follow(
        self,
        context: NavigationContext,
        command: DriveCommand,
        route: Route,
        goal: Goal,
        points: Floats,
    ) -> StepResult:
        """Follow `points`, the path of `route` to `goal`, with the local planner."""
        assert context.map_from_odom
        assert context.body
        here = compose(context.map_from_odom, context.pose)
        left = _remaining_path(points, here)
        cap = self._speed_cap(context, here, left)
        request = self._request(context, here, route, goal, points, left, cap)
        if command.target and command.target.away is not None:
            request = close_up(request, context.body)
        plan = self._local_planner(context).plan(request)
        if context.stopped_ahead and plan.twist.linear_x > 0.0:
            plan = self._local_planner(context).plan(barred(request, context.body))
        self._routes.report(
            RouteFeedback(
                version=route.version,
                arrived=plan.arrived,
                blocked=plan.blocked,
                reason=plan.reason,
            )
        )
        outcome = self._outcome(context, command, route, plan, left)
        headline = ": ".join(filter(None, (route.activity, route.reason))) or outcome.activity
        intent = self._intent(
            twist=plan.twist,
            trajectory=plan.trajectory,
            follow=bool(plan.trajectory),
            response=context.actuation,
            progress=outcome.progress,
            reason=f"{headline}: {plan.reason}{self._slowed(context, cap)}"[:500],
        )
        return intent, outcome

    def _request(
        self,
        context: NavigationContext,
        here: Pose,
        route: Route,
        goal: Goal,
        points: Floats,
        left: Floats,
        cap: SpeedCap | None,
    ) -> local_planner.PlanRequest:
        """Return the request to the local planner, in the odometry frame.

        `here`, the path's `points` (n, 2) and the remaining ones `left` (k, 2) are in the map.
        """
        assert context.map_from_odom
        assert context.world
        to_odom = inverse(context.map_from_odom)
        move = from_pose(to_odom)
        around = here.x, here.y, DEFAULTS.window
        keepouts = self._zone_map.keepouts_near(*around)
        lanes = self._zone_map.lanes_beside(*around, left[1:])
        end = compose(to_odom, Pose(x=goal.x, y=goal.y, yaw=goal.yaw or 0.0))
        headings = route.headings
        return local_planner.PlanRequest(
            tick=context.tick,
            pose=context.pose,
            velocity=context.velocity,
            goal=Goal(x=end.x, y=end.y, yaw=None if goal.yaw is None else end.yaw),
            hits=context.world.points().astype(np.float64),
            path=transform(move, points),
            headings=None if headings is None else headings + np.array((to_odom.yaw, 0.0)),
            obstacles=context.world.obstacles,
            contours=placed(context.world.contours, context.pose),
            cameras=tuple(camera.name for camera in context.world.cameras if camera.ok),
            response=context.actuation,
            sent=context.sent,
            delayed=context.delayed_s,
            may_back=context.may_reverse,
            keepouts=tuple(transform(move, polygon) for polygon in keepouts),
            avoid=tuple(transform(move, polygon) for polygon in lanes),
            max_speed=cap.speed if cap else None,
        )

    def _slowed(self, context: NavigationContext, cap: SpeedCap | None) -> str:
        """Return what slows the robot, to be appended to a reason."""
        late_s = context.delayed_s
        text = f"; slower: this host is late by {late_s:.2f} s" if late_s else ""
        if cap and cap.speed < self._max_speed(context):
            text += f"; at most {cap.speed:.2f} m/s: speed zone {cap.zone!r}"
        return text

    def _outcome(
        self,
        context: NavigationContext,
        command: DriveCommand,
        route: Route,
        plan: local_planner.LocalPlan,
        left: Floats,
    ) -> StepOutcome:
        assert context.map_from_odom
        assert route.goal
        here = compose(context.map_from_odom, context.pose)
        position_error, heading_error = _errors(command, here)
        distance_m = float(np.hypot(*np.diff(left, axis=0).T).sum())
        self._longest_m = max(self._longest_m, distance_m, 1e-6)
        arrived = plan.arrived and command.kind != "explore" and not route.activity
        speed = self._max_speed(context)
        place = describe_goal(route.goal)
        driving = "exploring" if command.kind == "explore" else f"going to {place}"
        at = f"at {place}, {route.reason}" if route.reason else f"at {place}"
        return StepOutcome(
            number=command.number,
            state="done" if arrived else "running",
            activity=route.activity or driving,
            reason=at if arrived else context.held or plan.reason,
            held=bool(context.held),
            progress=1.0 if arrived else 1.0 - min(1.0, distance_m / self._longest_m),
            distance=distance_m,
            eta=distance_m / speed,
            goal=route.goal,
            path=_thinned(left),
            position_error=position_error,
            heading_error=heading_error,
        )

    def _max_speed(self, context: NavigationContext) -> float:
        assert context.body
        return min(self._config.max_linear_speed or math.inf, context.body.max_linear_speed)

    def _speed_cap(self, context: NavigationContext, here: Pose, left: Floats) -> SpeedCap | None:
        assert context.body
        v, body = context.velocity, context.body
        return self._zone_map.speed_cap(
            here,
            body.footprint,
            left,
            math.hypot(v.linear_x, v.linear_y),
            body.max_linear_deceleration,
        )

    def _local_planner(self, context: NavigationContext) -> local_planner.LocalPlanner:
        body, config = context.body, self._config
        assert body
        if self._local and (body is self._body or body == self._body):
            return self._local
        settings, before, self._body = _local_settings(config, body), self._body, body
        if self._local and before and _same_shape(before, body):
            self._local.configure(body, settings)
        else:
            self._local = local_planner.LocalPlanner(body, settings)
        return self._local

    def _intent(self, *, twist: Velocity = ZERO, reason: str, **more: Any) -> Intent:
        return Intent(twist=twist, behaviour=self._behaviour, reason=reason, **more)


def _reason_to_wait(context: NavigationContext, command: DriveCommand | None) -> Idle | None:
    """Return why the robot must not drive now; None if it may."""
    if context.must_charge:
        return Idle("resting", "resting: the battery is nearly empty; charge it")
    reason = ""
    if context.world is None:
        reason = "perception is silent"
    elif not context.world.scan_ok:
        reason = context.world.scan_problem
    elif context.body is None:
        reason = "no robot/body from the driver yet"
    elif context.lost and command is not None:
        reason = context.lost
    elif context.late_ticks > MAX_SCAN_AGE_TICKS:
        late_s = context.late_ticks * TICK_S
        reason = f"this host is too busy: its newest scan is {late_s:.2f} s old"
    return Idle("waiting", f"waiting: {reason}") if reason else None


def _local_settings(config: NavigationConfig, body: BodyDescription) -> LocalSettings:
    default = inflation(body).decay
    configured = inflation(body, beyond=config.inflation).decay
    return LocalSettings(
        linear_speed=config.max_linear_speed,
        samples=config.samples,
        aggressiveness=config.aggressiveness,
        near_over=min(DEFAULTS.near_over * configured / default, MAX_NEAR_OVER_M),
    )


def _same_shape(one: BodyDescription, other: BodyDescription) -> bool:
    return (one.footprint, one.lidar) == (other.footprint, other.lidar)


def close_up(
    request: local_planner.PlanRequest, body: BodyDescription
) -> local_planner.PlanRequest:
    """Return a request to stop exactly at a goal right before a thing.

    Near the goal the body drives so slowly that its stop zone reaches only a third of EXACT_M ahead
    of its margin. Else safety would stop it short of the goal until the zone is free again.
    """
    distance = math.hypot(request.goal.x - request.pose.x, request.goal.y - request.pose.y)
    max_speed = request.max_speed
    if distance < CLOSE_UP_M:
        safe_speed = brakes(body)["forward"].speed(body.thresholds.stop_margin + EXACT_M / 3)
        max_speed = min(safe_speed, max_speed or math.inf)
    return dataclasses.replace(request, tolerance=EXACT_M, max_speed=max_speed)


def barred(request: local_planner.PlanRequest, body: BodyDescription) -> local_planner.PlanRequest:
    """Return a request with a bar of obstacles in front of the body, so that it drives elsewhere.

    Safety stops the body for something that decision does not know. For example, an arm took a
    thing away, and its place is too near for any camera to show that the thing is gone.
    """
    corners = np.array(body.footprint)
    x = float(corners[:, 0].max()) + body.thresholds.stop_margin
    left, right = float(corners[:, 1].max()), float(corners[:, 1].min())
    y = np.linspace(right, left, math.ceil((left - right) / BAR_STEP_M) + 1)
    bar = transform(from_pose(request.pose), np.column_stack((np.full_like(y, x), y)))
    return dataclasses.replace(request, known=np.concatenate((request.known, bar)))


def _errors(command: DriveCommand, here: Pose) -> tuple[float | None, float | None]:
    """Return the distance to the goal [m] and the heading error [rad]; None if it has none."""
    goal = command.goal
    if goal is None:
        return None, None
    heading = None if goal.yaw is None else abs(math.remainder(goal.yaw - here.yaw, math.tau))
    return math.hypot(goal.x - here.x, goal.y - here.y), heading


def _remaining_path(points: Floats, here: Pose) -> Floats:
    """Return the rest of a path (k, 2) [m] from `here` on, with k >= 2."""
    nearest = int(np.argmin(np.hypot(points[:, 0] - here.x, points[:, 1] - here.y)))
    rest = points[nearest + 1 :] if nearest + 1 < len(points) else points[-1:]
    return np.vstack(((here.x, here.y), rest))


def _thinned(points: Floats) -> tuple[tuple[float, float], ...]:
    """Return at most MAX_POINTS of a path, with the first and the last, to be drawn."""
    if len(points) > MAX_POINTS:
        points = points[np.linspace(0, len(points) - 1, MAX_POINTS).round().astype(int)]
    return tuple(map(tuple, points.round(3).tolist()))


def warm_up() -> None:
    """Compile all kernels that every body needs for planning and driving, by calling them."""
    global_planner.warm_up()
    warm_up_local_planner(ANY_BODY)
