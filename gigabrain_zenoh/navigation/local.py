"""The local planner: from what is near now to the motion of the next seconds."""

import math
from dataclasses import replace

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from gigabrain_schemas.base import TICK_NS, Pose, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import Obstacle, TrajectoryPoint
from gigabrain_zenoh.navigation import among, traffic
from gigabrain_zenoh.navigation.cost_to_go import CostToGo
from gigabrain_zenoh.navigation.footprint import clearance, outline_of
from gigabrain_zenoh.navigation.manner import kind_of, reason_of
from gigabrain_zenoh.navigation.models import lag_of, model_of, slowed
from gigabrain_zenoh.navigation.moment import Goal, LocalPlan, LocalSettings, Moment, Sent
from gigabrain_zenoh.navigation.mppi import Planned, Sampler, past_of, step_of
from gigabrain_zenoh.navigation.rating import Scene, Weights, distance_in
from gigabrain_zenoh.navigation.rollout import Start
from gigabrain_zenoh.navigation.window import Window
from gigabrain_zenoh.navigation.window_cells import Place

__all__ = ["Goal", "LocalPlan", "LocalPlanner", "LocalSettings", "Moment", "Sent", "warm_up"]

Floats = NDArray[np.float64]

DEFAULTS = LocalSettings()
TICK_S = TICK_NS / 1e9
MOVING = 0.15  # [m/s], slower things are part of the grid
SURE = 3.0  # standard deviations of its velocity that a thing must be faster than to move
UNSURE = 0.05  # [m/s], standard deviation of a velocity that comes without
MOST_GROWTH = 0.3  # [m/s], of a disc: how fast what is known of it fades at most
IN_PLACE = 0.3  # [m], who gets no farther than this is in one place
MAKES_WAY = "making way: it looks round for what moves"
SLOW = 0.05  # share of the largest speeds at which a body has arrived


class LocalPlanner:
    """Drives one body. It keeps what it saw and planned, and no clock."""

    def __init__(self, body: BodyDescription, settings: LocalSettings = DEFAULTS) -> None:
        self._body, self._settings = body, settings
        self._model = model_of(body, settings.linear_speed)
        self._outline = outline_of(body.footprint)
        self._lidar = (body.lidar.x, body.lidar.y) if body.lidar else (0.0, 0.0)
        half_y = (self._outline.left - self._outline.right) / 2
        half_x = (self._outline.front - self._outline.rear) / 2
        self._half_width = min(half_x, half_y) if self._model.lateral > 0 else half_y
        self._sampler, self._traffic = self._sampler_of(), self._traffic_of()
        self._weights = Weights()
        self.reset()

    def limit_speed(self, linear_speed: float | None) -> None:
        """Drive no faster than this [m/s] from now on; what was seen and planned is kept."""
        self._settings = structs.replace(self._settings, linear_speed=linear_speed)
        self._model = model_of(self._body, linear_speed)
        before = self._sampler
        self._sampler, self._traffic = self._sampler_of(), self._traffic_of()
        self._sampler.last, self._sampler.dt = before.last, before.dt

    def _sampler_of(self) -> Sampler:
        model, settings = self._model, self._settings
        return Sampler(model, settings.samples, settings.steps, step_of(model), settings.seed)

    def _traffic_of(self) -> traffic.Traffic | None:
        """What a quick body looks out for."""
        lidar, model = self._body.lidar, self._model
        if not among.is_quick(model):
            return None
        sight = lidar.range_max if lidar else 0.0
        return traffic.Traffic(2.0 * self._half_width, model.forward, sight)

    def reset(self) -> None:
        """Forget all that was seen and planned: the odometry has begun anew."""
        self._window = Window(self._settings.window, self._settings.memory)
        self._costs = CostToGo(self._window.cells)
        self._sampler.forget()
        if self._traffic:
            self._traffic.reset()
        self._tick: int | None = None
        self._began = 0
        self._anchor, self._anchor_tick = Pose(x=0.0, y=0.0, yaw=0.0), 0

    def plan(self, moment: Moment) -> LocalPlan:
        """What to do at this moment. Raises ValueError for a goal that is no place."""
        goal = moment.goal
        if not all(math.isfinite(v) for v in (goal.x, goal.y, goal.yaw or 0.0)):
            raise ValueError(f"a goal has finite numbers, got {goal}")
        self._pass_time(moment)
        place = Place(moment.pose.x, moment.pose.y, moment.pose.yaw)
        discs = _discs(moment.obstacles)
        hits = np.ascontiguousarray(moment.hits, dtype=np.float64)
        self._window.see(moment.tick, place, self._lidar, hits)
        discs = self._window.moving(moment.tick, discs)
        weights = self._look_out(moment.tick, place, discs)
        if self._arrived(moment):
            return _standing("arrived: at the goal", arrived=True)
        looks_round = self._looks_round(moment.tick)
        if looks_round:
            if weights is self._weights or among.keep_away(discs, place.x, place.y):
                return _standing("waiting: it looks round for what moves")
            moment = replace(moment, goal=Goal(x=place.x, y=place.y), path=None)
        scene = self._scene(moment, discs)
        model = slowed(self._model, moment.delayed)
        planned = self._sampler.plan(
            model if moment.may_back else model._replace(backward=0.0),
            self._outline,
            weights,
            scene,
            self._start(moment, place),
        )
        answer = self._answer(moment, scene, planned)
        return replace(answer, reason=MAKES_WAY) if looks_round else answer

    def _look_out(self, tick: int, place: Place, discs: Floats) -> Weights:
        """Get ready for what moves: a quick body among quick things plans in another way."""
        quick = among.moving_quickly(discs) if self._traffic else discs[:0]
        if self._traffic:
            self._traffic.see(tick, place.x, place.y, quick)
        if not len(quick):
            self._sampler.step_by(step_of(self._model))
            return self._weights
        self._window.take_back(tick, quick)
        self._sampler.step_by(among.HORIZON_S / self._settings.steps)
        return among.WEIGHTS

    def _looks_round(self, tick: int) -> bool:
        """Whether a quick body has yet to see what moves, and where, before it drives off."""
        if not self._traffic:
            return False
        looks = among.SIZES_UP_S if self._traffic.any else among.LOOKS_S
        return (tick - self._began) * TICK_S < looks

    def _scene(self, moment: Moment, discs: Floats) -> Scene:
        goal = moment.goal
        grid = self._window.grid(moment.tick, moment.known, discs)
        ways = self._traffic.ways((goal.x, goal.y)) if self._traffic else None
        field = self._costs.field(grid, self._half_width, (goal.x, goal.y), moment.path, ways)
        yaw = math.nan if goal.yaw is None else goal.yaw
        near, turned = self._settings.position_tolerance, self._settings.yaw_tolerance
        return Scene(grid, field, discs, goal.x, goal.y, yaw, near, turned)

    def _start(self, moment: Moment, place: Place) -> Start:
        v, sent, dt = moment.velocity, moment.sent, self._sampler.dt
        times = [((one.tick - moment.tick) * TICK_S, *_axes(one.velocity)) for one in sent]
        rows = np.array([row for row in times if row[0] <= 0.0]).reshape(-1, 4)
        gain = moment.response.turn_gain
        rows[:, 3] *= gain  # what the floor makes of it; control undoes that in what is to come
        before = tuple(rows[-1, 1:].tolist()) if len(rows) else _axes(v)
        past, share = past_of(rows, _axes(v), moment.response.delay, dt)
        lag = lag_of(moment.response.lag, dt)
        return Start(*place, *_axes(v), before, past, share, lag, gain)

    def _answer(self, moment: Moment, scene: Scene, planned: Planned) -> LocalPlan:
        place = moment.pose
        cosine, sine = math.cos(place.yaw), math.sin(place.yaw)
        room = clearance(scene.grid, self._outline, place.x, place.y, cosine, sine)
        left = distance_in(scene.field, place.x, place.y)
        blocked = self._stuck(moment)
        kind = kind_of(self._model, planned.track, self._sampler.dt, moment.goal)
        vx, vy, w = planned.commands[0].tolist()
        return LocalPlan(
            twist=Velocity(linear_x=vx, linear_y=vy, angular_z=w),
            trajectory=_trajectory(planned.track, self._sampler.dt),
            kind=kind,
            reason=reason_of(kind, planned.track, scene.discs, room, left),
            blocked=blocked,
            remaining=left,
        )

    def _pass_time(self, moment: Moment) -> None:
        if self._tick is None:
            self._began = moment.tick
        elif moment.tick > self._tick:
            self._sampler.shift((moment.tick - self._tick) * TICK_S)
        self._tick = moment.tick

    def _arrived(self, moment: Moment) -> bool:
        goal, pose, v = moment.goal, moment.pose, moment.velocity
        off = math.hypot(goal.x - pose.x, goal.y - pose.y)
        turn = 0.0 if goal.yaw is None else abs(math.remainder(goal.yaw - pose.yaw, math.tau))
        settings, model = self._settings, self._model
        slow = math.hypot(v.linear_x, v.linear_y) <= max(0.02, SLOW * model.forward)
        near = off <= settings.position_tolerance and turn <= settings.yaw_tolerance
        return near and slow and abs(v.angular_z) <= max(0.05, SLOW * model.turning)

    def _stuck(self, moment: Moment) -> bool:
        """Whether it has been in one place for too long."""
        here, then = moment.pose, self._anchor
        gone = math.hypot(here.x - then.x, here.y - then.y) > IN_PLACE
        if gone or not self._anchor_tick:
            self._anchor, self._anchor_tick = here, moment.tick
        return (moment.tick - self._anchor_tick) * TICK_S > self._settings.stuck_after


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
    """`track` (T + 1, 6) as seen from its first pose."""
    rows = track.tolist()  # plain numbers are quicker where they are few
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


def _axes(of: Velocity) -> tuple[float, float, float]:
    return of.linear_x, of.linear_y, of.angular_z


def _discs(obstacles: tuple[Obstacle, ...]) -> Floats:
    """(m, 6): what moves, and how fast what is known of it fades."""
    rows = [
        (one.x, one.y, one.velocity_x, one.velocity_y, one.radius, min(MOST_GROWTH, _growth(one)))
        for one in obstacles
        if math.hypot(one.velocity_x, one.velocity_y) > max(MOVING, SURE * _growth(one))
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def _growth(obstacle: Obstacle) -> float:
    """Standard deviation of the velocity [m/s]."""
    if not obstacle.covariance:
        return UNSURE
    return math.sqrt(max(0.0, obstacle.covariance[10], obstacle.covariance[15]))


def warm_up(body: BodyDescription) -> None:
    """Compile all that a driving robot will call, with `body`'s own shapes."""
    traffic.warm_up()
    goal, here = Goal(x=0.5, y=0.0), Pose(x=0.0, y=0.0, yaw=0.0)
    planner = LocalPlanner(body, LocalSettings(samples=64, steps=10, window=2.0))
    for tick, x in ((1, 0.9), (51, 0.7)):  # once it has looked round
        somebody = Obstacle(id=1, x=x, y=0.0, velocity_x=1.0, radius=0.3)
        planner.plan(
            Moment(
                tick=tick,
                pose=here,
                velocity=Velocity(),
                goal=goal,
                hits=np.array([[x, 0.0]]),
                obstacles=(somebody,),
            )
        )
