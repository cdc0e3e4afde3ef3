"""Before a thing that an arm is to pick up, the body drives slowly enough to get near it."""

import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.navigator import EXACT_M, close_up
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.navigation.local_planner import PlanRequest, no_points


def request(away: float, max_speed: float | None = None) -> PlanRequest:
    return PlanRequest(
        tick=1,
        pose=Pose(x=1.0, y=2.0, yaw=0.0),
        velocity=Velocity(),
        goal=Goal(x=1.0 + away, y=2.0),
        hits=no_points(),
        max_speed=max_speed,
    )


def test_it_stands_exactly_and_drives_freely_until_it_is_near() -> None:
    asked = close_up(request(0.4), load_robot("lekiwi").description())
    assert (asked.tolerance, asked.max_speed) == (EXACT_M, None)
    assert close_up(request(0.4, 0.12), load_robot("lekiwi").description()).max_speed == 0.12


@pytest.mark.parametrize("margin", [0.05, 0.08, 0.2])
def test_near_by_safety_stops_it_no_sooner_than_where_it_should_stand(margin: float) -> None:
    body = load_robot("lekiwi").description()
    body = replace(body, thresholds=replace(body.thresholds, stop_margin=margin))
    slow = close_up(request(0.2), body).max_speed
    assert slow
    assert 0.04 < slow < body.max_linear_speed / 2
    assert brakes(body)["forward"].distance(slow) < margin + EXACT_M / 2


def test_a_speed_zone_holds_as_well() -> None:
    assert close_up(request(0.2, 0.03), load_robot("lekiwi").description()).max_speed == 0.03
