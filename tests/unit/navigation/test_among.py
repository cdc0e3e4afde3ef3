"""A quick body among quick obstacles has its own plans; other bodies are not affected."""

import math
from dataclasses import replace

import numpy as np
import pytest

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import Obstacle
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.navigation import cost, dynamic_obstacles
from gigabrain_zenoh.navigation.cost import NO_DISC_M
from gigabrain_zenoh.navigation.footprint import outline_of
from gigabrain_zenoh.navigation.local_costmap import LocalCostmap, Pose2D
from gigabrain_zenoh.navigation.local_planner import (
    LocalPlan,
    LocalPlanner,
    LocalSettings,
    PlanRequest,
)
from gigabrain_zenoh.navigation.motion_model import (
    COSINE,
    DISC_COST,
    DISC_DISTANCE,
    LANES,
    STATE,
    X,
    model_of,
)
from gigabrain_zenoh.navigation.mppi import Sampler
from gigabrain_zenoh.navigation.planning_problem import Weights
from gigabrain_zenoh.qa.bench.barn import drive_functions
from gigabrain_zenoh.qa.bench.barn_course import HARD, JACKAL, BarnWorld, MovingDisc
from tests.unit.navigation.drives import OMNI, WAFFLE, wall

NO_POINTS = np.empty((0, 2))
NO_DISCS = np.empty((0, 6))
FEW = LocalSettings(samples=128, window=6.0)
LOOKED = round(dynamic_obstacles.LOOK_AROUND_S / 0.02) + 1  # ticks


def plans(body: BodyDescription, speed: float, cycles: int = 3) -> list[LocalPlan]:
    """Return the plans made while a person 1.5 m ahead crosses at `speed` [m/s]."""
    planner, made = LocalPlanner(body, FEW), []
    for tick in (1, *range(LOOKED, LOOKED + 4 * cycles, 4)):
        y = -1.0 + speed * 0.02 * tick
        away = math.hypot(1.5, y)
        hit = np.array([(1.5, y)]) * (1.0 - 0.3 / away)
        obstacle = Obstacle(id=1, x=1.5, y=y, velocity_y=speed, radius=0.3)
        made.append(
            planner.plan(
                PlanRequest(
                    tick=tick,
                    pose=Pose(x=0.0, y=0.0, yaw=0.0),
                    velocity=Velocity(),
                    goal=Goal(x=2.5, y=0.0),
                    hits=hit,
                    obstacles=(obstacle,),
                )
            )
        )
    return made[1:]


@pytest.mark.parametrize(
    ("body", "speed"), [(WAFFLE, 1.2), (OMNI, 1.2), (WAFFLE, 0.0), (JACKAL, 0.0), (JACKAL, 0.25)]
)
def test_plans_are_unchanged_if_body_or_obstacles_are_slow(
    body: BodyDescription, speed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = plans(body, speed)
    monkeypatch.setattr(dynamic_obstacles, "quick_discs", lambda discs: discs[:0])
    assert plans(body, speed) == here


def test_a_quick_body_among_quick_obstacles_plans_two_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    here = plans(JACKAL, 1.2)
    assert here[0].trajectory[-1].t == pytest.approx(2.0)
    monkeypatch.setattr(dynamic_obstacles, "quick_discs", lambda discs: discs[:0])
    there = plans(JACKAL, 1.2)
    assert there[0].trajectory[-1].t == pytest.approx(1.5)
    assert there != here


def test_a_quick_body_looks_round_before_it_drives() -> None:
    planner = LocalPlanner(JACKAL, FEW)
    request = PlanRequest(
        tick=100,
        pose=Pose(x=0.0, y=0.0, yaw=0.0),
        velocity=Velocity(),
        goal=Goal(x=2.5, y=0.0),
        hits=NO_POINTS,
    )
    first, last = planner.plan(request), planner.plan(replace(request, tick=129))
    for one in (first, last):
        assert (one.twist, one.kind) == (Velocity(), "waiting")
        assert one.reason == "waiting: looking round for moving obstacles"
    assert planner.plan(replace(request, tick=130)).twist.linear_x > 0.0
    slow = LocalPlanner(WAFFLE, FEW)
    assert slow.plan(request).twist.linear_x > 0.0


def near(discs: list[tuple[float, ...]], seconds: float) -> tuple[float, float]:
    """Return the distance [m] of the nearest disc from a Jackal at (0, 0), and the cost of all."""
    weights = Weights(disc=9.0, disc_over=0.3, disc_lead=0.1, trust=0.7)
    state = np.zeros(STATE)
    state[COSINE : COSINE + LANES] = 1.0
    state[X : X + LANES - 1] = 50.0  # the other lanes are far away
    cost.fill_disc_distances(weights, np.array(discs), outline_of(JACKAL.footprint), seconds, state)
    assert (state[DISC_DISTANCE], state[DISC_COST]) == (NO_DISC_M, 0.0)
    return float(state[DISC_DISTANCE + LANES - 1]), float(state[DISC_COST + LANES - 1])


def test_a_faster_disc_costs_more_at_the_same_distance() -> None:
    slow = (1.0, 0.0, 0.0, 0.0, 0.3, 0.0)
    quick = (1.0, -2.0, 0.0, 2.0, 0.3, 0.0)
    away, cost = near([slow], 1.0)
    assert away == pytest.approx(1.0 - 0.229 - 0.3)
    assert cost == pytest.approx(9.0 * math.exp(-0.471 / 0.3))
    assert near([quick], 1.0) == pytest.approx((0.471, 9.0 * math.exp(-0.471 / 0.5)))
    assert near([slow, quick], 1.0)[1] == pytest.approx(
        9.0 * (math.exp(-0.471 / 0.3) + math.exp(-0.471 / 0.5))
    )
    assert near([quick], 0.0)[0] == pytest.approx(math.hypot(0.771, 1.792) - 0.3)


def test_a_plan_is_resampled_when_its_steps_become_longer() -> None:
    sampler = Sampler(model_of(JACKAL), 64, 30, 0.05, 0)
    times = (np.arange(30) + 0.5) * 0.05
    sampler.last = np.tile(times[:, None], 3)
    sampler.step_by(2.0 / 30)
    assert sampler.dt == pytest.approx(0.0667, abs=1e-4)
    want = np.minimum((np.arange(30) + 0.5) * 2.0 / 30, times[-1])
    assert sampler.last[:, 0] == pytest.approx(want)


def test_hits_of_a_moving_disc_are_cleared_but_not_those_of_a_wall() -> None:
    window, here = LocalCostmap(4.0, 10.0), Pose2D(0.0, 0.0, 0.0)
    beside = wall((0.4, 0.38), (1.6, 0.38))
    for tick in range(1, 40, 2):
        x = 1.5 - 0.02 * tick  # 1 m/s, towards the lidar
        front = wall((x - 0.3, -0.15), (x - 0.3, 0.15))
        window.add_scan(tick, here, (0.0, 0.0), np.concatenate([front, beside]))
        moving = np.array([(x, 0.0, -1.0, 0.0, 0.3, 0.0)])
        assert len(window.moving(tick, moving)) == 1
        window.clear_tracks(tick, moving)
    left = window.grid(39, NO_POINTS, NO_DISCS).distance
    assert left[80, 80 + 32] == pytest.approx(0.38, abs=0.04)
    assert left[80 + 15, 80 + 32] < 0.03


@pytest.mark.slow
def test_a_stream_of_quick_discs_is_crossed_under_hard_conditions() -> None:
    lanes = [
        MovingDisc(8.0, np.array([(0.0, 3.0 + i % 2, s * 6.4), (8.0, 3.0 + i % 2, -s * 6.4)]), 0.5)
        for i, s in enumerate((1.0, -1.0))
    ]
    later = [
        MovingDisc(8.0, np.roll(lane.keys, 0, axis=0) + np.array((0.0, 2.5, 0.0)), 0.5)
        for lane in lanes
    ]
    world = BarnWorld(5, np.empty((0, 3)), (*lanes, *later), (0.0, 0.0, 0.0), (9.0, 0.0), 9.0)
    trial = drive_functions(world, 0, HARD, 200)
    assert trial.result == "success"
    assert trial.least_clearance > 0.02
