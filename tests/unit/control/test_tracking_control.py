"""Control keeps to a trajectory with a body that answers late, and brakes when it cannot."""

import math

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import ActuationModel
from tests.unit.control.tracking import AGILE, SLOW, Course, Path, Plant, errors, ess

SIDEWAYS = replace(AGILE, drive_type="omni", max_lateral_speed=1.0)
CAR = replace(AGILE, drive_type="ackermann", max_angular_speed=2.0)


def sideways(t: float) -> Velocity:
    """A circle round something that is looked at all the while."""
    speed = min(0.4, 1.0 * max(0.0, t - 0.2))
    return Velocity(linear_y=speed, angular_z=-speed)


def back(t: float) -> Velocity:
    return replace(ess(t), linear_x=-ess(t).linear_x)


def on_the_spot(t: float) -> Velocity:
    return Velocity(angular_z=min(1.0, 2.0 * max(0.0, t - 0.2)) * math.cos(t))


def test_an_s_curve_is_driven_ten_times_as_exactly_as_with_a_twist_alone() -> None:
    course = Course(ess, 11.0)
    twist = errors(course, Plant(), 8.0, follow=False)
    follow = errors(course, Plant(), 8.0)
    assert max(twist) == pytest.approx(0.160, abs=0.01)
    assert max(follow) < 0.01


@pytest.mark.parametrize(
    ("body", "path"),
    [(AGILE, back), (SIDEWAYS, sideways), (SIDEWAYS, ess), (CAR, ess), (CAR, back)],
)
def test_every_kind_of_body_keeps_to_its_trajectory(body: BodyDescription, path: Path) -> None:
    assert max(errors(Course(path, 9.0), Plant(body), 6.0)) < 0.015


@pytest.mark.parametrize("late", [2, 5, 10])
@pytest.mark.parametrize(("body", "path"), [(AGILE, ess), (SIDEWAYS, sideways)])
def test_a_late_trajectory_begins_where_the_body_was_when_it_was_thought_of(
    body: BodyDescription, path: Path, late: int
) -> None:
    found = errors(Course(path, 9.0), Plant(body), 6.0, late=late)
    assert max(found[100:]) < 0.015  # the first intent arrives after the start of the course


def test_turning_on_the_spot_it_keeps_to_the_heading() -> None:
    course, plant = Course(on_the_spot, 9.0), Plant()
    assert max(errors(course, plant, 6.0)) < 0.001
    assert plant.pose.yaw == pytest.approx(course.at(6.02)[0].yaw, abs=0.02)


@pytest.mark.parametrize("gain", [0.8, 1.2])
def test_a_body_that_goes_slower_or_faster_than_commanded_is_corrected(gain: float) -> None:
    assert max(errors(Course(ess, 11.0), Plant(gain=gain), 8.0)) < 0.07


@pytest.mark.parametrize("slip", [0.6, 0.8, 1.1])
def test_a_body_that_slips_as_it_turns_is_commanded_to_turn_more(slip: float) -> None:
    response, course = replace(SLOW, turn_gain=slip), Course(ess, 11.0)
    assert max(errors(course, Plant(slip=slip), 8.0, response=response)) < 0.02
    assert max(errors(course, Plant(slip=slip), 8.0, response=SLOW)) < 0.12


@pytest.mark.parametrize(
    "believed",
    [ActuationModel(delay=0.04, lag=0.15), ActuationModel(delay=0.1, lag=0.06), ActuationModel()],
)
def test_with_a_response_that_is_not_the_bodys_it_is_still_better_than_the_twist(
    believed: ActuationModel,
) -> None:
    assert max(errors(Course(ess, 11.0), Plant(), 8.0, response=believed)) < 0.1


@pytest.mark.parametrize(
    "response", [ActuationModel(), ActuationModel(delay=0.3, lag=0.0), ActuationModel(lag=0.5)]
)
def test_bodies_without_delay_or_lag_and_slow_ones_are_driven_too(response: ActuationModel) -> None:
    plant = Plant(response=response)
    assert max(errors(Course(ess, 11.0), plant, 8.0, response=response)[150:]) < 0.04
