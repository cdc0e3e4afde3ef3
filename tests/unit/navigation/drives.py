"""A body with delay and lag that a local planner drives past points and discs."""

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, Lidar
from gigabrain_schemas.brain import ActuationModel, Obstacle
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.geometry.sweep import depth, edges
from gigabrain_zenoh.navigation.local_planner import (
    LocalPlan,
    LocalPlanner,
    LocalSettings,
    PlanRequest,
    SentCommand,
)
from gigabrain_zenoh.navigation.motion_model import first_order_lag, lagged_step

WAFFLE = BodyDescription(
    robot_type="waffle",
    drive_type="differential",
    footprint=((0.075, 0.155), (-0.2, 0.155), (-0.2, -0.155), (0.075, -0.155)),
    max_linear_speed=0.26,
    max_angular_speed=1.82,
    lidar=Lidar(beams=360, rate_hz=10, range_min=0.12, range_max=3.5, x=-0.064),
)
CAR = BodyDescription(
    robot_type="car",
    drive_type="ackermann",
    footprint=((0.3, 0.15), (-0.1, 0.15), (-0.1, -0.15), (0.3, -0.15)),
    max_linear_speed=1.0,
    max_angular_speed=2.0,
    max_linear_acceleration=2.0,
    max_linear_deceleration=2.0,
    max_angular_acceleration=8.0,
    lidar=Lidar(beams=360, rate_hz=10, range_min=0.12, range_max=8.0),
)
OMNI = BodyDescription(
    robot_type="omni",
    drive_type="omni",
    footprint=((0.12, 0.3), (-0.12, 0.3), (-0.12, -0.3), (0.12, -0.3)),  # wider than long
    max_linear_speed=0.6,
    max_lateral_speed=0.6,
    max_angular_speed=1.5,
    max_linear_acceleration=1.0,
    max_linear_deceleration=1.5,
    max_angular_acceleration=3.0,
    lidar=Lidar(beams=360, rate_hz=10, range_min=0.12, range_max=8.0),
)
AT_ONCE = ActuationModel()
QUICK = LocalSettings(samples=300, window=5.0)


def wall(begin: tuple[float, float], end: tuple[float, float]) -> Floats:
    """Return points every 2 cm."""
    count = max(2, round(math.dist(begin, end) / 0.02))
    return np.linspace(begin, end, count)


class Drive:
    """One drive. All of `walls` (n, 2) is visible; `someone` returns the discs at a time."""

    def __init__(
        self,
        body: BodyDescription,
        goal: Goal,
        walls: Floats,
        *,
        settings: LocalSettings = QUICK,
        response: ActuationModel = AT_ONCE,
        someone: Callable[[float], tuple[Obstacle, ...]] = lambda _: (),
    ) -> None:
        self.body, self.goal, self.walls, self.someone = body, goal, walls, someone
        self.planner = LocalPlanner(body, settings)
        self.response = response
        self.pose = Pose(x=0.0, y=0.0, yaw=0.0)
        self.velocity = Velocity()
        self._queue = deque([Velocity()] * round(response.delay / TICK_S))
        self._sent: deque[SentCommand] = deque(maxlen=25)
        self.tick = 0
        self.least = math.inf  # [m], smallest clearance so far
        self.plans: list[LocalPlan] = []
        self.poses: list[Pose] = []

    def go(self, seconds: float) -> LocalPlan:
        """Drive for `seconds`, or until the robot has arrived."""
        for _ in range(round(seconds / 0.1)):
            plan = self.planner.plan(self.request())
            self.plans.append(plan)
            if plan.arrived:
                break
            for _ in range(5):
                self._tick(plan.twist)
        return self.plans[-1]

    def request(self) -> PlanRequest:
        """Return the planner's request for the present tick."""
        cosine, sine = math.cos(self.pose.yaw), math.sin(self.pose.yaw)
        off = self.walls - (self.pose.x, self.pose.y)
        hits = off @ np.array(((cosine, -sine), (sine, cosine)))
        return PlanRequest(
            tick=self.tick,
            pose=self.pose,
            velocity=self.velocity,
            goal=self.goal,
            hits=hits,
            obstacles=self.someone(self.tick * TICK_S),
            response=self.response,
            sent=tuple(self._sent),
        )

    def _tick(self, command: Velocity) -> None:
        self._sent.append(SentCommand(self.tick, command))
        self._queue.append(command)
        active, lag = self._queue.popleft(), first_order_lag(self.response.lag, TICK_S)
        vx, ahead = lagged_step(self.velocity.linear_x, active.linear_x, lag, TICK_S)
        vy, aside = lagged_step(self.velocity.linear_y, active.linear_y, lag, TICK_S)
        w, turned = lagged_step(self.velocity.angular_z, active.angular_z, lag, TICK_S)
        middle = self.pose.yaw + 0.5 * turned
        self.pose = Pose(
            x=self.pose.x + math.cos(middle) * ahead - math.sin(middle) * aside,
            y=self.pose.y + math.sin(middle) * ahead + math.cos(middle) * aside,
            yaw=self.pose.yaw + turned,
        )
        self.velocity = Velocity(linear_x=vx, linear_y=vy, angular_z=w)
        self.tick += 1
        self.poses.append(self.pose)
        self.least = min(self.least, self._room())

    def _room(self) -> float:
        """Return the footprint's distance to the nearest obstacle [m]; negative if they overlap."""
        rows = [(o.x, o.y, o.radius) for o in self.someone(self.tick * TICK_S)]
        discs = np.array([*rows, *((x, y, 0.0) for x, y in self.walls.tolist())])
        if not len(discs):
            return math.inf
        cosine, sine = math.cos(self.pose.yaw), math.sin(self.pose.yaw)
        off = discs[:, :2] - (self.pose.x, self.pose.y)
        here = off @ np.array(((cosine, -sine), (sine, cosine)))
        return float((depth(edges(self.body.footprint), here) - discs[:, 2]).min())
