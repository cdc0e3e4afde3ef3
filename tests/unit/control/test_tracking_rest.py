"""Control off its trajectory: it comes back, comes to rest, brakes, and keeps to limits."""

import math

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.brain import ActuationModel, TrajectoryPoint
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_schemas.topics import BODY, CMD_VEL, INTENT, STATE
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.control.node import ControlInputs, step
from gigabrain_zenoh.control.tracking import predict
from gigabrain_zenoh.geometry.pose import compose
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import body, state
from tests.unit.control.tracking import SLOW, Course, Plant, errors, ess, relocated


def test_beside_its_trajectory_a_body_comes_back_to_it() -> None:
    course, plant = Course(ess, 11.0), Plant()
    plant.pose = Pose(x=-0.1, y=0.15, yaw=0.3)
    found = errors(course, plant, 6.0)
    assert max(found[200:]) < 0.02


def test_what_the_body_will_do_with_commands_on_their_way_is_foreseen() -> None:
    plant, seen = Plant(), []
    course = Course(ess, 11.0)
    for i in range(150):
        if i % 5 == 1:
            intent = course.intent(plant.tick, SLOW)
        seen.append((plant.pose, plant.velocity, plant.memory.sent))
        plant.go(intent if i else None)
    pose, velocity, _ = seen[100]
    sent = seen[101][2]  # before that state
    found = predict(pose, velocity, sent, 5, SLOW)
    later = seen[105][0]
    assert (found.x, found.y, found.yaw) == pytest.approx((later.x, later.y, later.yaw), abs=1e-3)


def test_when_the_trajectory_is_over_the_body_comes_to_rest() -> None:
    course, plant = Course(ess, 11.0), Plant()
    errors(course, plant, 3.0)
    last = course.intent(plant.tick, SLOW)
    short = replace(last, trajectory=last.trajectory[:6])  # half a second
    speeds = [plant.go(short).linear_x for _ in range(70)]
    assert speeds[10] > 0.3
    assert speeds[50:] == [0.0] * 20


def test_without_a_trajectory_it_comes_to_rest() -> None:
    plant = Plant()
    errors(Course(ess, 11.0), plant, 3.0)
    empty = replace(Course(ess, 1.0).intent(plant.tick, SLOW), trajectory=())
    assert [plant.go(empty).linear_x for _ in range(40)][30:] == [0.0] * 10


@pytest.mark.parametrize("jump", [Pose(x=0.4, y=0.0, yaw=0.0), Pose(x=0.0, y=0.0, yaw=1.2)])
def test_too_far_off_the_trajectory_it_brakes_and_says_so(jump: Pose) -> None:
    course, plant = Course(ess, 11.0), Plant()
    errors(course, plant, 3.0)
    intent = course.intent(plant.tick, SLOW)
    plant.go(relocated(intent, course, plant))
    assert not plant.memory.off_track
    plant.pose = compose(plant.pose, jump)
    before = plant.go(relocated(intent, course, plant)).linear_x
    assert plant.memory.off_track
    assert before - plant.go(relocated(intent, course, plant)).linear_x == pytest.approx(0.02)


async def test_the_process_brakes_and_says_so_once_when_it_is_too_far_off(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", "gigabrain_zenoh.control.node")
    course, speeds = Course(lambda t: Velocity(linear_x=0.2), 6.0), []
    async with NodeBench(control.run) as bench:
        bench.send(BODY, body())
        x = 0.0
        for tick in range(1, 121):
            x += 0.02 * (speeds[-1] if speeds else 0.0) + (0.5 if tick in (51, 81) else 0.0)
            now = state(tick, v=speeds[-1] if speeds else 0.0, pose=(x, 0.0, 0.0))
            bench.send(STATE, now)
            basis = max(1, 10 * ((tick - 1) // 10))  # decision does not know of the jump yet
            bench.send(INTENT, replace(course.intent(basis, ActuationModel()), tick=tick))
            speeds += [command.linear_x for command in bench.sent(CMD_VEL)][-1:]
    assert [record.message for record in caplog.records] == [
        "braking: too far from the trajectory",
        "on the trajectory again",
    ] * 2
    assert speeds[48] == pytest.approx(0.2, abs=0.02)
    assert speeds[59] == 0.0
    assert speeds[79] == pytest.approx(0.2, abs=0.02)
    assert speeds[119] == pytest.approx(0.2, abs=0.02)


def test_a_basis_of_which_the_place_is_not_known_moves_nothing() -> None:
    plant = Plant()
    intent = replace(Course(ess, 11.0).intent(0, SLOW), basis=0)
    assert {plant.go(intent).linear_x for _ in range(10)} == {0.0}
    assert not plant.memory.off_track


def test_caps_of_safety_and_the_bodys_limits_hold_on_a_trajectory_too() -> None:
    course, plant = Course(lambda t: Velocity(linear_x=1.4, angular_z=2.2), 11.0), Plant()
    before, caps = 0.0, SpeedCaps(forward=0.2, rotation=0.3)
    for i in range(200):
        intent = course.intent(plant.tick, SLOW)
        command = plant.go(intent, caps if i >= 100 else None)
        assert abs(command.linear_x - before) <= 2.0 * 0.02 + 1e-9
        assert command.linear_x <= 1.0
        assert command.angular_z <= 1.82
        before = command.linear_x
    assert 0.15 < command.linear_x <= 0.2
    assert 0.2 < command.angular_z <= 0.3


def test_asked_again_within_a_tick_it_answers_the_same() -> None:
    course, plant = Course(ess, 11.0), Plant()
    errors(course, plant, 2.0)
    pose = plant.pose
    now = replace(state(plant.tick + 1, pose=(pose.x, pose.y, pose.yaw)), velocity=plant.velocity)
    inputs = ControlInputs(state=now, intent=course.intent(plant.tick, SLOW))
    once = step(plant.body, plant.memory, inputs)
    assert step(plant.body, once[0], inputs) == once
    without = replace(inputs, intent=None)
    assert step(plant.body, step(plant.body, plant.memory, without)[0], inputs) == once


def test_a_response_beyond_reason_makes_no_command_beyond_reason() -> None:
    plant, course = Plant(), Course(ess, 11.0)
    errors(course, plant, 2.0)
    mad = ActuationModel(delay=1e9, lag=1e9, turn_gain=1e-310)
    still = replace(course.intent(plant.tick, mad), trajectory=(TrajectoryPoint(60.0, 0, 0, 0),))
    assert max(abs(plant.go(still).linear_x) for _ in range(5)) <= 0.52
    assert all(math.isfinite(plant.go(still).angular_z) for _ in range(5))


def test_points_at_one_time_and_out_of_order_make_no_command_that_is_not_a_number() -> None:
    plant = Plant()
    errors(Course(ess, 11.0), plant, 2.0)
    point = TrajectoryPoint(0.3, 0.1, 0.0, 0.0, 0.5)
    for points in ((point,) * 4, (point, replace(point, t=0.0), replace(point, t=9.0))):
        intent = replace(Course(ess, 1.0).intent(plant.tick, SLOW), trajectory=points)
        assert all(math.isfinite(plant.go(intent).linear_x) for _ in range(30))
