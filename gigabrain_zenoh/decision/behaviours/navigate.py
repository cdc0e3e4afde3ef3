"""Be where it is wanted: along a way through the map, round whatever is near."""

import math
from typing import ClassVar

import numpy as np

from gigabrain_schemas.arrays import hits
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.tasks import MOST_POINTS, Goal
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.behaviours import Situation
from gigabrain_zenoh.decision.behaviours.bearings import Bearings, Driven, Floats, Route
from gigabrain_zenoh.decision.tasks.orders import Explore, GoTo, Order, Outcome, where
from gigabrain_zenoh.geometry.planar import compose, inverse
from gigabrain_zenoh.navigation import local

TOO_LATE_TICKS = 10  # a scan so old is not to be driven by


class Navigate:
    """Drives along a route. Without an order, or where anything is uncertain, it stands."""

    SETTINGS = frozenset({"speed_limit", "unknown", "samples", "begin", "scripts"})
    PARAMS: ClassVar = {
        "speed_limit": "a number above 0, up to 10 [m/s], or null for the body's own limit alone",
    }

    def __init__(self, config: DecisionConfig) -> None:
        self._config = config
        self._planner: local.LocalPlanner | None = None
        self._body: object = None
        self._longest = 0.0  # [m], of the present order: what progress is measured by
        self._number = 0
        self.outcome: Outcome | None = None  # of the order, as of the last step
        self.driven: Driven | None = None

    def configure(self, config: DecisionConfig) -> None:
        """Go by another speed limit; what the local planner has seen and planned is kept."""
        self._config = config
        if self._planner:
            self._planner.limit_speed(config.speed_limit)

    def step(self, situation: Situation) -> Intent:
        """What to do now, with the reason in words."""
        self.outcome = self.driven = None
        world, bearings = situation.world, situation.bearings
        why = _why_not(situation)
        order = bearings.order if bearings else None
        if why or world is None or bearings is None:
            return self._wait(order, why)
        route = bearings.route
        if order is None:
            return _stand(bearings.waits)
        if route is None or route.number != order.number:
            return self._wait(order, "waiting: for a way through the map")
        if order.number != self._number:
            self._number, self._longest = order.number, 0.0
        if route.goal is None or route.points is None:
            assert bearings.map_from_odom
            off, turned = _errors(order, compose(bearings.map_from_odom, situation.pose))
            self.outcome = Outcome(
                number=order.number, state=route.state, reason=route.reason,
                position_error=off, heading_error=turned,
            )  # fmt: skip
            return _stand(f"waiting: {route.reason}")
        return self._drive(situation.pose, world, bearings, route)

    def _wait(self, order: Order | None, why: str) -> Intent:
        if order:
            self.outcome = Outcome(number=order.number, reason=why[:500])
        return _stand(why)

    def _drive(self, pose: Pose, world: WorldModel, bearings: Bearings, route: Route) -> Intent:
        assert bearings.map_from_odom
        assert route.goal
        assert route.points is not None
        to_odom, goal = inverse(bearings.map_from_odom), route.goal
        there = compose(to_odom, Pose(x=goal.x, y=goal.y, yaw=goal.yaw or 0.0))
        yaw = None if goal.yaw is None else there.yaw
        moment = local.Moment(
            tick=bearings.tick,
            pose=pose,
            velocity=bearings.velocity,
            goal=local.Goal(x=there.x, y=there.y, yaw=yaw),
            hits=hits(world).astype(np.float64),
            path=moved(to_odom, route.points),
            obstacles=world.obstacles,
            response=bearings.response,
            sent=bearings.sent,
            delayed=bearings.delayed,
            may_back=bearings.may_back,
        )
        plan = self._planner_for(bearings).plan(moment)
        here = compose(bearings.map_from_odom, pose)
        self._tell(plan, here, bearings, route)
        assert self.outcome
        return Intent(
            twist=plan.twist,
            trajectory=plan.trajectory,
            follow=bool(plan.trajectory),
            response=bearings.response,
            progress=self.outcome.progress,
            behaviour="navigate",
            reason=f"{_headline(bearings.order, route)}: {plan.reason}{_slowly(bearings)}"[:500],
        )

    def _tell(self, plan: local.LocalPlan, here: Pose, bearings: Bearings, route: Route) -> None:
        assert bearings.order
        assert bearings.body
        assert route.goal
        assert route.points is not None
        order, goal = bearings.order, route.goal
        off, turned = _errors(order, here)
        left = _ahead(route.points, here)
        distance = float(np.hypot(*np.diff(left, axis=0).T).sum())
        self._longest = max(self._longest, distance, 1e-6)
        self.driven = Driven(
            version=route.version, arrived=plan.arrived, blocked=plan.blocked, reason=plan.reason
        )  # fmt: skip
        arrived = plan.arrived and not isinstance(order, Explore) and not route.aside
        speed = min(self._config.speed_limit or math.inf, bearings.body.max_linear_speed)
        self.outcome = Outcome(
            number=order.number,
            state="done" if arrived else "running",
            reason=_at(route, goal) if arrived else bearings.held or plan.reason,
            held=bool(bearings.held),
            progress=1.0 if arrived else 1.0 - min(1.0, distance / self._longest),
            distance=distance,
            eta=distance / speed,
            goal=goal,
            path=_thinned(left),
            position_error=off,
            heading_error=turned,
        )

    def _planner_for(self, bearings: Bearings) -> local.LocalPlanner:
        body = bearings.body
        assert body
        if self._planner is None or body != self._body:
            settings = local.LocalSettings(
                linear_speed=self._config.speed_limit, samples=self._config.samples
            )
            self._planner, self._body = local.LocalPlanner(body, settings), body
        return self._planner


def _why_not(situation: Situation) -> str:
    """Why it must not drive now, whatever is wanted; or an empty text."""
    world, bearings = situation.world, situation.bearings
    if situation.must_charge:
        return "resting: the battery is nearly empty; charge it"
    if world is None or bearings is None:
        return "waiting: perception is silent"
    if not world.scan_ok:
        return f"waiting: {world.scan_problem}"
    if bearings.body is None:
        return "waiting: the driver has not said what body this is"
    if bearings.lost and bearings.order is not None:
        return f"waiting: {bearings.lost}"
    if bearings.late_ticks > TOO_LATE_TICKS:
        late_s = bearings.late_ticks * 0.02
        return f"waiting: this host is too busy, its newest scan is {late_s:.2f} s old"
    return ""


def _errors(order: Order, here: Pose) -> tuple[float | None, float | None]:
    """How far from its goal [m], and from the heading wanted there [rad], the robot is."""
    if not isinstance(order, GoTo):
        return None, None
    goal = order.goal
    turned = None if goal.yaw is None else abs(math.remainder(goal.yaw - here.yaw, math.tau))
    return math.hypot(goal.x - here.x, goal.y - here.y), turned


def _headline(order: Order | None, route: Route) -> str:
    """What it is at: the same for as long as that does not change."""
    assert route.goal
    if route.aside:
        return route.reason
    return "exploring" if isinstance(order, Explore) else f"going to {where(route.goal)}"


def _at(route: Route, goal: Goal) -> str:
    """Where it has arrived, and why that is not what was asked for, if it is not."""
    return f"at {where(goal)}, {route.reason}" if route.reason else f"at {where(goal)}"


def _slowly(bearings: Bearings) -> str:
    """Why it drives more slowly than it could, if it does."""
    return f"; slower, this host is busy: {bearings.delayed:.2f} s late" if bearings.delayed else ""


def _stand(reason: str) -> Intent:
    return Intent(twist=Velocity(), behaviour="navigate", reason=reason[:500])


def moved(frame: Pose, points: Floats) -> Floats:
    """Points (n, 2) given in `frame`, in the frame that `frame` is given in."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    turned: Floats = points @ np.array(((cosine, sine), (-sine, cosine)))
    there: Floats = turned + np.array((frame.x, frame.y))
    return there


def _ahead(points: Floats, here: Pose) -> Floats:
    """What is left of a path, from here on: (k, 2), at least two points."""
    nearest = int(np.argmin(np.hypot(points[:, 0] - here.x, points[:, 1] - here.y)))
    rest = points[nearest + 1 :] if nearest + 1 < len(points) else points[-1:]
    return np.vstack(((here.x, here.y), rest))


def _thinned(points: Floats) -> tuple[tuple[float, float], ...]:
    """Few enough of them to be drawn, with the first and the last."""
    count = min(len(points), MOST_POINTS)
    chosen = np.linspace(0, len(points) - 1, count).round().astype(int)
    return tuple((round(x, 3), round(y, 3)) for x, y in points[chosen].tolist())
