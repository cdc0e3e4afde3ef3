"""Requests of a body right before a thing, or stopped by safety for an unknown reason."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.navigator import EXACT_M, barred, close_up
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.navigation.local_planner import LocalPlan, PlanRequest, no_points
from tests.unit.navigation.drives import WAFFLE, Drive

LEKIWI = load_robot("lekiwi").description()
GHOST = np.array((0.29, 0.02))  # place where safety remembers a can that is gone


def request(away: float, max_speed: float | None = None) -> PlanRequest:
    return PlanRequest(
        tick=1,
        pose=Pose(x=1.0, y=2.0, yaw=0.0),
        velocity=Velocity(),
        goal=Goal(x=1.0 + away, y=2.0),
        hits=no_points(),
        max_speed=max_speed,
    )


def test_it_stops_exactly_and_slows_down_only_near_the_goal() -> None:
    asked = close_up(request(0.4), LEKIWI)
    assert (asked.tolerance, asked.max_speed) == (EXACT_M, None)
    assert close_up(request(0.4, 0.12), LEKIWI).max_speed == 0.12


@pytest.mark.parametrize("margin", [0.05, 0.08, 0.2])
def test_safety_does_not_stop_it_before_the_goal(margin: float) -> None:
    body = replace(LEKIWI, thresholds=replace(LEKIWI.thresholds, stop_margin=margin))
    slow = close_up(request(0.2), body).max_speed
    assert slow
    assert 0.04 < slow < body.max_linear_speed / 2
    assert brakes(body)["forward"].distance(slow) < margin + EXACT_M / 2


def test_a_speed_zone_applies_as_well() -> None:
    assert close_up(request(0.2, 0.03), LEKIWI).max_speed == 0.03


class Stopped(Drive):
    """Safety stops the body for a ghost ahead, until a camera sees the place again."""

    ghost, bars = True, True

    def go(self, seconds: float) -> LocalPlan:
        for _ in range(round(seconds / 0.1)):
            plan = self.planner.plan(self.request())
            if self.stops and self.bars and plan.twist.linear_x > 0.0:
                plan = self.planner.plan(barred(self.request(), self.body))
            if plan.arrived:
                break
            twist = plan.twist
            if self.stops and twist.linear_x > 0.0:
                twist = replace(twist, linear_x=0.0)
            for _ in range(5):
                self._tick(twist)
        return plan

    @property
    def stops(self) -> bool:
        ahead, aside = self._here(GHOST)
        self.ghost = self.ghost and ahead < 0.36  # a camera sees the floor beyond 0.36 m
        return self.ghost and ahead > 0.0 and abs(aside) < 0.18

    def _here(self, point: np.ndarray) -> tuple[float, float]:
        x, y = point - (self.pose.x, self.pose.y)
        cosine, sine = math.cos(self.pose.yaw), math.sin(self.pose.yaw)
        return cosine * x + sine * y, cosine * y - sine * x


@pytest.mark.long
def test_a_body_that_safety_stops_for_a_ghost_turns_away_and_continues() -> None:
    drive = Stopped(WAFFLE, Goal(x=1.0, y=0.0), np.empty((0, 2)))
    drive.bars = False
    assert not drive.go(20.0).arrived
    drive = Stopped(WAFFLE, Goal(x=1.0, y=0.0), np.empty((0, 2)))
    assert drive.go(20.0).arrived
