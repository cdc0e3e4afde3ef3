"""Local planner: plans the motion of the next seconds, and explains it."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S, Fraction, Pose, Positive, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import ActuationModel, Obstacle, TrajectoryPoint
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.geometry.limits import SentCommand
from gigabrain_zenoh.geometry.se2 import from_pose, transform
from gigabrain_zenoh.navigation import dynamic_obstacles
from gigabrain_zenoh.navigation.car_track import no_track, track_of
from gigabrain_zenoh.navigation.cost import COST_PER_S
from gigabrain_zenoh.navigation.cost_to_go import CostToGo
from gigabrain_zenoh.navigation.footprint import outline_of
from gigabrain_zenoh.navigation.local_costmap import LocalCostmap, Pose2D
from gigabrain_zenoh.navigation.looked_ground import LookedGround
from gigabrain_zenoh.navigation.motion_model import (
    InitialState,
    MotionModel,
    delayed_model,
    first_order_lag,
    model_of,
    slowed_model,
)
from gigabrain_zenoh.navigation.mppi import SampledPlan, Sampler, mean_past_commands, step_duration
from gigabrain_zenoh.navigation.plan_reason import PlanKind, classify_plan, explain_plan
from gigabrain_zenoh.navigation.planning_problem import Scene, Weights

TURN_COST_SHARE = 1.0  # of the cost of time, at full turn, for strafing bodies with a goal yaw
STUCK_RADIUS_M = 0.3  # a body within this radius is in one place
SLOW_PATIENCE = 2.0  # times the time to leave the radius at the speed of a speed zone
LOOK_AFTER_S, LOOK_UNTIL_S = 2.0, 8.0  # time in one place in which the body looks at the ground
LOOK_EVERY_S = 12.0  # then again
WAY_ON_M = 0.4  # distance of the point of the path that it looks at
FACES_RAD = 0.35  # heading error at which that point is in view
BACK_M = 0.3  # distance by which it backs off from ground too near to be in view
LOOKING = "looking: the ground ahead is not seen yet"
MAKING_WAY = "making way: looking round for moving obstacles"
STANDARD = Weights()
ARRIVED_SPEED_SHARE = 0.05  # of the maximum speeds, at which a body has arrived


class LocalSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the local planner."""

    samples: Annotated[int, Meta(ge=64, le=20_000)] = 1000  # plans per cycle
    steps: Annotated[int, Meta(ge=10, le=60)] = 30  # of 0.05 s for fast bodies, 0.1 s for slow ones
    window: Annotated[float, Meta(ge=2.0, le=20.0)] = 8.0  # [m], side of the local costmap
    memory: Positive = 10.0  # [s], for which marks that no beam can check are kept
    linear_speed: Positive | None = None  # [m/s], limit besides the body's own
    aggressiveness: Fraction = 0.5  # see `weights_of` and `model_of`; 1: fast in tight places
    near_over: Positive = STANDARD.near_over  # [m], decay length of the cost of obstacles
    position_tolerance: Positive = 0.1  # [m]
    yaw_tolerance: Positive = 0.1  # [rad]
    stuck_after: Positive = 5.0  # [s] in one place, before another path is wanted
    seed: Annotated[int, Meta(ge=0, le=2**32)] = 0


DEFAULTS = LocalSettings()


def weights_of(settings: LocalSettings, base: Weights = STANDARD) -> Weights:
    """Return the weights of a planner's costs.

    An aggressiveness of 1 halves the cost of nearby obstacles and doubles the speed in tight
    places; 0 does the opposite. The distance of a contact does not change.
    """
    factor = 2.0 ** (2.0 * settings.aggressiveness - 1.0)
    return base._replace(
        near=base.near / factor,
        near_over=base.near_over * settings.near_over / STANDARD.near_over,
        tight_speed=base.tight_speed * factor,
        tight_rate=base.tight_rate * factor,
    )


def no_points() -> Floats:
    """Return an empty array of points (0, 2)."""
    return np.empty((0, 2))


@dataclass(frozen=True, kw_only=True)
class PlanRequest:
    """Inputs of the local planner, in the odometry frame, as it does not jump."""

    tick: int  # of the scan
    pose: Pose  # of that tick
    velocity: Velocity  # measured at that tick
    goal: Goal
    hits: Floats  # (n, 2) [m], in the body's frame
    path: Floats | None = None  # (k, 2) [m], to the goal; None: the planner finds one in its window
    headings: Floats | None = None  # (k, 2), of a car's path, see `Path`
    known: Floats = field(default_factory=no_points)  # (m, 2) [m], nearby obstacles of the map
    obstacles: tuple[Obstacle, ...] = ()
    contours: tuple[Floats, ...] = ()  # polygons (k, 2) [m] that cameras see now
    cameras: tuple[str, ...] = ()  # names of the trusted ones
    keepouts: tuple[Floats, ...] = ()  # polygons (k, 2) [m] that the body must not enter
    avoid: tuple[Floats, ...] = ()  # polygons (k, 2) [m] that cost as much as touching an obstacle
    max_speed: float | None = None  # [m/s], of a speed zone
    tolerance: float | None = None  # [m], of the goal's position; None: as in the settings
    response: ActuationModel = field(default_factory=ActuationModel)
    sent: tuple[SentCommand, ...] = ()  # oldest first; those of the last 0.5 s are enough
    delayed: float = 0.0  # [s], additional delay of the commands
    may_back: bool = True  # False if an obstacle is behind, or it cannot see there


@dataclass(frozen=True, kw_only=True)
class LocalPlan:
    """A twist to command, the expected trajectory, and the reason."""

    twist: Velocity  # to command now
    trajectory: tuple[TrajectoryPoint, ...]  # expected, in the body's frame at the request's tick
    kind: PlanKind
    reason: str  # text for people
    blocked: bool = False  # the body is stuck: another path is wanted
    arrived: bool = False
    remaining: float = 0.0  # [m of free way], cost to go from here


class LocalPlanner:
    """Plans for one body. It keeps a costmap and the last plan, but has no clock."""

    def __init__(self, body: BodyDescription, settings: LocalSettings = DEFAULTS) -> None:
        self._body, self._settings = body, settings
        self._model = model_of(body, settings.linear_speed, settings.aggressiveness)
        self._outline = outline_of(body.footprint)
        self._rim = np.vstack((body.footprint, self._outline.groups[:, [1, 4]]))  # (n, 2) [m]
        self._lidar = (body.lidar.x, body.lidar.y) if body.lidar else (0.0, 0.0)
        half_y = (self._outline.left - self._outline.right) / 2
        half_x = (self._outline.front - self._outline.rear) / 2
        self._half_width = min(half_x, half_y) if self._model.lateral > 0 else half_y
        self._sampler, self._traffic = self._sampler_of(), self._traffic_of()
        self._weights = weights_of(settings)
        self.reset()

    def configure(self, body: BodyDescription, settings: LocalSettings) -> None:
        """Change limits, or settings except window and memory.

        The costmap and the last plan are kept. Footprint and lidar must not change.
        """
        self._body, self._settings = body, settings
        self._model = model_of(body, settings.linear_speed, settings.aggressiveness)
        self._weights = weights_of(settings)
        before = self._sampler
        self._sampler, self._traffic = self._sampler_of(), self._traffic_of()
        self._sampler.last, self._sampler.dt = before.last, before.dt

    def _sampler_of(self) -> Sampler:
        model, settings = self._model, self._settings
        return Sampler(model, settings.samples, settings.steps, step_duration(model), settings.seed)

    def _traffic_of(self) -> dynamic_obstacles.TrafficMap | None:
        lidar, model = self._body.lidar, self._model
        if not dynamic_obstacles.is_quick(model):
            return None
        sight = lidar.range_max if lidar else 0.0
        return dynamic_obstacles.TrafficMap(2.0 * self._half_width, model.forward, sight)

    def reset(self) -> None:
        """Discard the costmap and the last plan, when the odometry has restarted."""
        self._window = LocalCostmap(self._settings.window, self._settings.memory)
        self._costs = CostToGo(self._window.cells)
        self._ground = LookedGround(self._body, self._window.cells)
        self._sampler.forget()
        if self._traffic:
            self._traffic.reset()
        self._tick: int | None = None
        self._first_tick = 0
        self._anchor, self._anchor_tick = Pose(x=0.0, y=0.0, yaw=0.0), 0

    def plan(self, request: PlanRequest) -> LocalPlan:
        """Plan the motion from the request's tick. Raise ValueError if the goal is not finite."""
        goal = request.goal
        if not all(math.isfinite(v) for v in (goal.x, goal.y, goal.yaw or 0.0)):
            raise ValueError(f"a goal has finite numbers, got {goal}")
        self._pass_time(request)
        place = Pose2D(request.pose.x, request.pose.y, request.pose.yaw)
        discs = dynamic_obstacles.discs_of(request.obstacles)
        hits = np.ascontiguousarray(request.hits, dtype=np.float64)
        self._window.add_scan(request.tick, place, self._lidar, hits)
        discs = self._window.moving(request.tick, discs)
        model = slowed_model(self._model, request.max_speed)
        weights = self._update_traffic(request.tick, place, discs, model)
        if self._at_goal(request):
            if not self._turns(request.velocity):
                return _standing("arrived: at the goal", arrived=True)
            if goal.yaw is None:
                return _standing("waiting: at the goal")
        looking_round = self._is_looking_round(request.tick)
        if looking_round:
            if weights is self._weights or dynamic_obstacles.stay_clear(discs, place.x, place.y):
                return _standing("waiting: looking round for moving obstacles")
            request = replace(request, goal=Goal(x=place.x, y=place.y), path=None, headings=None)
        viewpoint = self._viewpoint(request, place)
        if viewpoint:
            request = replace(request, goal=viewpoint, path=None, headings=None)
        if self._model.strafes and request.goal.yaw is not None:
            weights = weights._replace(
                turning=TURN_COST_SHARE * COST_PER_S / self._model.turning**2
            )
        scene = self._scene(request, discs)
        model = delayed_model(model, request.delayed)
        planned = self._sampler.plan(
            model if request.may_back else model._replace(backward=0.0),
            self._outline,
            weights,
            scene,
            self._start(request, place),
        )
        answer = self._answer(request, scene, planned)
        if viewpoint:
            return replace(answer, reason=LOOKING)
        return replace(answer, reason=MAKING_WAY) if looking_round else answer

    def _update_traffic(
        self, tick: int, place: Pose2D, discs: Floats, model: MotionModel
    ) -> Weights:
        """Update the traffic, and return the weights. They differ for fast bodies in traffic."""
        quick = dynamic_obstacles.quick_discs(discs) if self._traffic else discs[:0]
        if self._traffic:
            self._traffic.update(tick, place.x, place.y, quick)
        if not len(quick):
            self._sampler.step_by(step_duration(model))
            return self._weights
        self._window.clear_tracks(tick, quick)
        self._sampler.step_by(dynamic_obstacles.HORIZON_S / self._settings.steps)
        return weights_of(self._settings, dynamic_obstacles.WEIGHTS)

    def _is_looking_round(self, tick: int) -> bool:
        """Return whether a fast body must still look for moving obstacles before it drives."""
        if not self._traffic:
            return False
        traffic, alone = dynamic_obstacles.LOOK_AROUND_IN_TRAFFIC_S, dynamic_obstacles.LOOK_AROUND_S
        return (tick - self._first_tick) * TICK_S < (traffic if self._traffic.any else alone)

    def _viewpoint(self, request: PlanRequest, place: Pose2D) -> Goal | None:
        """Return the pose from which a stuck body sees the ground ahead; None if not needed.

        It turns first. If the ground is too near to be in view, it backs off. Without this it would
        wait, as driving over unseen ground costs less the later it begins.
        """
        waited_s = self._time_in_place_s(request) % LOOK_EVERY_S
        differential = self._model.lateral == 0.0 and self._model.radius == 0.0
        if not differential or not LOOK_AFTER_S < waited_s < LOOK_UNTIL_S:
            return None
        path = request.path if request.path is not None else no_points()
        ahead = path[np.hypot(path[:, 0] - place.x, path[:, 1] - place.y) > WAY_ON_M]
        x, y = ahead[0].tolist() if len(ahead) else (request.goal.x, request.goal.y)
        bearing = math.atan2(y - place.y, x - place.x)
        if not self._ground.is_unseen_ahead(place, bearing, self._half_width):
            return None
        faces = abs(math.remainder(bearing - place.yaw, math.tau)) < FACES_RAD
        back = BACK_M if faces else 0.0
        x, y = place.x - back * math.cos(bearing), place.y - back * math.sin(bearing)
        return Goal(x=x, y=y, yaw=bearing)

    def _scene(self, request: PlanRequest, discs: Floats) -> Scene:
        goal = request.goal
        seen = dynamic_obstacles.static_polygons(request.contours, discs)
        inside = request.keepouts or seen  # the body may be in one of them
        body = transform(from_pose(request.pose), self._rim) if inside else None
        grid = self._window.grid(request.tick, request.known, discs, request.keepouts, body, seen)
        place = Pose2D(request.pose.x, request.pose.y, request.pose.yaw)
        if self._stuck(request):
            self._ground.fill_gaps(place)
        looked = self._ground.limited(grid, place, request.cameras, request.contours)
        ways = self._traffic.ways((goal.x, goal.y)) if self._traffic else None
        to, aside = (goal.x, goal.y), self._half_width
        field = self._costs.field(grid, aside, to, request.path, ways, request.avoid)
        yaw = math.nan if goal.yaw is None else goal.yaw
        near, turned = self._tolerance(request), self._settings.yaw_tolerance
        return Scene(looked, field, discs, goal.x, goal.y, yaw, near, turned, self._track(request))

    def _track(self, request: PlanRequest) -> Floats:
        """Return the track of a car; other bodies follow the cost to go only."""
        if request.path is None or request.headings is None:
            return no_track()
        pose = request.pose
        return track_of(
            request.path, request.headings, (pose.x, pose.y, pose.yaw), self._model.radius
        )

    def _start(self, request: PlanRequest, place: Pose2D) -> InitialState:
        v, sent, dt = request.velocity, request.sent, self._sampler.dt
        times = [
            ((command.tick - request.tick) * TICK_S, *_twist_tuple(command.velocity))
            for command in sent
        ]
        rows = np.array([row for row in times if row[0] <= 0.0]).reshape(-1, 4)
        gain = request.response.turn_gain
        rows[:, 3] *= gain  # as the floor changes it; control corrects future commands only
        before = tuple(rows[-1, 1:].tolist()) if len(rows) else _twist_tuple(v)
        past, share = mean_past_commands(rows, _twist_tuple(v), request.response.delay, dt)
        lag = first_order_lag(request.response.lag, dt)
        return InitialState(*place, *_twist_tuple(v), before, past, share, lag, gain)

    def _answer(self, request: PlanRequest, scene: Scene, planned: SampledPlan) -> LocalPlan:
        room, left = planned.room, planned.left
        blocked = self._stuck(request)
        kind = classify_plan(self._model, planned.track, self._sampler.dt, request.goal)
        vx, vy, w = planned.commands[0].tolist()
        return LocalPlan(
            twist=Velocity(linear_x=vx, linear_y=vy, angular_z=w),
            trajectory=_trajectory(planned.track, self._sampler.dt),
            kind=kind,
            reason=explain_plan(
                kind, planned.track, scene.discs, room, left, follows=len(scene.track) > 0
            ),
            blocked=blocked,
            remaining=left,
        )

    def _pass_time(self, request: PlanRequest) -> None:
        if self._tick is None:
            self._first_tick = request.tick
        elif request.tick > self._tick:
            self._sampler.shift((request.tick - self._tick) * TICK_S)
        self._tick = request.tick

    def _at_goal(self, request: PlanRequest) -> bool:
        """Return whether the body stands at its goal; it may still turn there."""
        goal, pose, v = request.goal, request.pose, request.velocity
        off = math.hypot(goal.x - pose.x, goal.y - pose.y)
        turn = 0.0 if goal.yaw is None else abs(math.remainder(goal.yaw - pose.yaw, math.tau))
        slow = max(0.02, ARRIVED_SPEED_SHARE * self._model.forward)
        near = off <= self._tolerance(request) and turn <= self._settings.yaw_tolerance
        return near and math.hypot(v.linear_x, v.linear_y) <= slow

    def _turns(self, velocity: Velocity) -> bool:
        return abs(velocity.angular_z) > max(0.05, ARRIVED_SPEED_SHARE * self._model.turning)

    def _tolerance(self, request: PlanRequest) -> float:
        given = request.tolerance
        return self._settings.position_tolerance if given is None else given

    def _stuck(self, request: PlanRequest) -> bool:
        patience = self._settings.stuck_after
        if request.max_speed:
            patience = max(patience, SLOW_PATIENCE * STUCK_RADIUS_M / request.max_speed)
        return self._time_in_place_s(request) > patience

    def _time_in_place_s(self, request: PlanRequest) -> float:
        """Return the time that the body has been in one place [s]."""
        here, then = request.pose, self._anchor
        gone = math.hypot(here.x - then.x, here.y - then.y) > STUCK_RADIUS_M
        if gone or not self._anchor_tick:
            self._anchor, self._anchor_tick = here, request.tick
        return (request.tick - self._anchor_tick) * TICK_S


def _standing(reason: str, *, arrived: bool = False, blocked: bool = False) -> LocalPlan:
    return LocalPlan(
        twist=Velocity(),
        trajectory=(),
        kind="arrived" if arrived else "waiting",
        reason=reason,
        arrived=arrived,
        blocked=blocked,
    )


def _trajectory(track: Floats, dt: float) -> tuple[TrajectoryPoint, ...]:
    """Return `track` (T + 1, 6) in the frame of its first pose."""
    rows = track.tolist()  # lists are faster than small arrays
    x, y, yaw, *_ = rows[0]
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return tuple(
        TrajectoryPoint(
            n * dt,
            cosine * (to_x - x) + sine * (to_y - y),
            cosine * (to_y - y) - sine * (to_x - x),
            to_yaw - yaw,
            *velocity,
        )
        for n, (to_x, to_y, to_yaw, *velocity) in enumerate(rows)
    )


def _twist_tuple(of: Velocity) -> tuple[float, float, float]:
    return of.linear_x, of.linear_y, of.angular_z
