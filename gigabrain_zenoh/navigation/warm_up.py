"""Compiles all kernels of a driving robot before it drives."""

import numpy as np

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import Obstacle
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.navigation import dynamic_obstacles
from gigabrain_zenoh.navigation.cost_to_go import CostToGo
from gigabrain_zenoh.navigation.local_costmap import LocalCostmap
from gigabrain_zenoh.navigation.local_planner import LocalPlanner, LocalSettings, PlanRequest


def warm_up_local_planner(body: BodyDescription) -> None:
    """Compile all kernels of the local planner, for the array shapes of `body`."""
    _warm_up_traffic()
    goal, here = Goal(x=0.5, y=0.0), Pose(x=0.0, y=0.0, yaw=0.0)
    planner = LocalPlanner(body, LocalSettings(samples=64, steps=10, window=2.0))
    for tick, x in ((1, 0.9), (51, 0.7)):  # the second one after looking round
        obstacle = Obstacle(id=1, x=x, y=0.0, velocity_x=1.0, radius=0.3)
        planner.plan(
            PlanRequest(
                tick=tick,
                pose=here,
                velocity=Velocity(),
                goal=goal,
                hits=np.array([[x, 0.0]]),
                obstacles=(obstacle,),
            )
        )


def _warm_up_traffic() -> None:
    """Compile the kernels of fast bodies in traffic."""
    traffic, disc = (
        dynamic_obstacles.TrafficMap(1.0, 1.0, 1.0),
        np.array([[0.5, 0.0, 1.0, 0.0, 0.3, 0.0]]),
    )
    for tick in (1, 1 + dynamic_obstacles.UPDATE_TICKS):
        traffic.update(tick, 0.0, 0.0, disc)
    window, goal = LocalCostmap(1.0, 1.0), (9.0, 0.0)
    grid = window.grid(1, np.empty((0, 2)), np.empty((0, 6)))
    CostToGo(window.cells).field(grid, 0.1, goal, None, traffic.ways(goal))
