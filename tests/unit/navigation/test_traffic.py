"""The traffic map: paths that avoid quick obstacles are preferred if not much longer."""

import math
from typing import Any

import numpy as np
import pytest

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.brain import Obstacle
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.navigator import ANY_BODY
from gigabrain_zenoh.navigation import cost_to_go, dynamic_obstacles
from gigabrain_zenoh.navigation.cost_to_go import CostToGo
from gigabrain_zenoh.navigation.dynamic_obstacles import UPDATE_TICKS, TrafficMap
from gigabrain_zenoh.navigation.footprint import distance_at
from gigabrain_zenoh.navigation.local_costmap import LocalCostmap, Pose2D
from gigabrain_zenoh.navigation.local_planner import (
    LocalPlan,
    LocalPlanner,
    LocalSettings,
    PlanRequest,
)
from gigabrain_zenoh.navigation.warm_up import warm_up_local_planner
from gigabrain_zenoh.qa.bench.barn import drive_functions
from gigabrain_zenoh.qa.bench.barn_course import HARD, JACKAL, BarnWorld, MovingDisc

NO_POINTS = np.empty((0, 2))
NO_DISCS = np.empty((0, 6))
GOAL = (12.0, 0.0)


def crossing(seconds: float, speed: float) -> TrafficMap:
    """Return the traffic map of a body of 2 m/s that sees discs cross at `speed` [m/s].

    They go along x = 5 from y = -4 to 4 m, 2 m apart.
    """
    traffic = TrafficMap(0.4, 2.0, 10.0)
    for tick in range(1, round(seconds * 50), 2):
        ys = [(speed * 0.02 * tick + k * 2.0) % 8.0 - 4.0 for k in range(4)]
        discs = np.array([(5.0, y, 0.0, speed, 0.5, 0.0) for y in ys])
        traffic.update(tick, 0.0, 0.0, discs)
    return traffic


def test_without_quick_discs_there_is_no_traffic() -> None:
    traffic = TrafficMap(0.4, 2.0, 10.0)
    traffic.update(1, 0.0, 0.0, NO_DISCS)
    traffic.update(3, 0.0, 0.0, NO_DISCS)
    assert traffic.ways(GOAL) is None


@pytest.mark.long
def test_warm_up_compiles_all_kernels_of_a_drive() -> None:
    warm_up_local_planner(ANY_BODY)
    kernels: list[Any] = [dynamic_obstacles._add_watched, dynamic_obstacles._add_passing]
    kernels += [cost_to_go._scale_costs, cost_to_go._seed_rim]
    before = [kernel.overloads for kernel in kernels]
    drive_functions(crowd(), 0, HARD, 64)
    assert [kernel.overloads for kernel in kernels] == before
    assert 0 not in before


def test_a_metre_in_traffic_costs_more_than_one_beside_it() -> None:
    ways = crossing(2.0, 1.7).ways(GOAL)
    assert ways is not None
    there, beside = (distance_at(ways.price, *at) for at in ((5.0, 0.0), (5.0, -9.0)))
    assert there > 4.0
    assert beside == pytest.approx(1.0)
    assert 12.5 < distance_at(ways.field, 0.0, 0.0) < 2 * math.hypot(6.0, 8.0)  # round it
    assert distance_at(ways.field, 8.5, 0.0) == pytest.approx(3.5, abs=0.4)


def test_faster_discs_cost_more_and_slow_ones_nothing() -> None:
    dear, cheap = crossing(2.0, 1.8).ways(GOAL), crossing(2.0, 1.55).ways(GOAL)
    assert dear
    assert cheap
    there = [distance_at(ways.price, 5.0, 0.0) - 1.0 for ways in (dear, cheap)]
    assert there[0] == pytest.approx(4.0 * there[1], rel=0.1)
    assert crossing(2.0, 1.2).ways(GOAL) is None


def test_it_fades_and_is_forgotten() -> None:
    traffic = crossing(1.0, 1.7)
    dearest = [price_of(traffic)]
    for minute in range(5):
        for tick in range(51 + 3000 * minute, 51 + 3000 * (minute + 1), UPDATE_TICKS):
            traffic.update(tick, 0.0, 0.0, NO_DISCS)
            traffic.ways(GOAL)
        dearest.append(price_of(traffic))
    assert dearest[0] > 4.0
    assert dearest[1] < 1.5
    assert traffic.ways(GOAL) is None


def price_of(traffic: TrafficMap) -> float:
    ways = traffic.ways(GOAL)
    return float(ways.price.distance.max()) if ways else 1.0


@pytest.mark.parametrize("to", [(9.0, 0.0), (-8.0, 7.0), (500.0, 0.0)])
def test_the_traffic_keeps_its_place_when_the_robot_moves(to: tuple[float, float]) -> None:
    traffic = crossing(2.0, 1.7)
    before = traffic.ways(GOAL)
    for tick in range(101, 105 + UPDATE_TICKS, 2):
        traffic.update(tick, *to, NO_DISCS)
    after = traffic.ways(GOAL)
    assert before
    if to[0] > 100.0:
        assert after is None
        return
    assert after
    for at in ((5.0, 0.0), (5.0, 3.0), (0.0, -6.0)):
        assert distance_at(after.price, *at) == pytest.approx(
            distance_at(before.price, *at), rel=0.2
        )


def test_the_local_field_leads_round_traffic_beyond_the_window() -> None:
    window = LocalCostmap(8.0, 10.0)
    window.add_scan(1, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), NO_POINTS)
    grid, costs = window.grid(1, NO_POINTS, NO_DISCS), CostToGo(window.cells)
    traffic = crossing(2.0, 1.7)
    plain = costs.field(grid, 0.2, GOAL, None)
    ahead, aside = ((3.0, 0.0), (2.0, -3.5))
    assert distance_at(plain, *ahead) < distance_at(plain, *aside)
    dear = costs.field(grid, 0.2, GOAL, None, traffic.ways(GOAL))
    assert distance_at(dear, *ahead) > distance_at(dear, *aside) + 1.0


def looks(discs: tuple[Obstacle, ...], seconds: float) -> LocalPlan:
    """Return the plan of a Jackal `seconds` after it gets a goal."""
    planner = LocalPlanner(JACKAL, LocalSettings(samples=128, window=6.0))
    for tick in (1, 1 + round(seconds / 0.02)):
        request = PlanRequest(
            tick=tick,
            pose=Pose(x=0.0, y=0.0, yaw=0.0),
            velocity=Velocity(),
            goal=Goal(x=12.0, y=0.0),
            hits=NO_POINTS,
            obstacles=discs,
        )
        plan = planner.plan(request)
    return plan


def test_in_traffic_it_looks_longer_and_makes_way() -> None:
    far = Obstacle(id=1, x=6.0, y=0.0, velocity_y=1.5, radius=0.5)
    coming = Obstacle(id=2, x=3.0, y=0.0, velocity_x=-1.5, radius=0.5)
    wait = "waiting: looking round for moving obstacles"
    assert looks((), 1.0).reason != wait
    assert looks((far,), 1.0).reason == wait
    assert looks((far,), dynamic_obstacles.LOOK_AROUND_IN_TRAFFIC_S).reason != wait
    makes_way = looks((far, coming), 1.0)
    assert makes_way.reason == "making way: looking round for moving obstacles"
    assert math.hypot(makes_way.trajectory[-1].x, makes_way.trajectory[-1].y) < 3.0


def crowd() -> BarnWorld:
    """Ten discs that move back and forth between a Jackal and its goal."""
    rows = [3.0 + 1.5 * i for i in range(5)]
    times = np.array([0.0, 4.0, 8.0])
    movers = tuple(
        MovingDisc(
            8.0, np.column_stack((times, np.full(3, x), s * np.array([3.4, -3.4, 3.4]))), 0.5
        )
        for k, x in enumerate(rows)
        for s in ((1.0, -1.0) if k % 2 else (-1.0, 1.0))
    )
    return BarnWorld(3, np.empty((0, 3)), movers, (0.0, 0.0, 0.0), (13.0, 0.0), 13.0)


@pytest.mark.slow
def test_it_goes_round_a_crowd() -> None:
    trial = drive_functions(crowd(), 0, HARD, 200)
    assert trial.result == "success"
    assert trial.least_clearance > 0.3
