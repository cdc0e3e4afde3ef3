"""The example bodies of all drive types drive as commanded, with exact odometry."""

import logging
import math
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.world import Pose, World
from gigabrain_schemas.base import Pose as Place
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.pose import relative

Twist = tuple[float, float, float]
ROOM = World(name="room", description="", half_x=20.0, half_y=20.0, shapes=())


def simulation_of(name: str) -> Simulation:
    robot = load_robot(name)
    assert robot.sim
    run = Run(folder=robot_path(name).parent)
    return Simulation(sim_body(robot, msgspec.convert(robot.sim, MujocoOptions), run), ROOM, 0)


def drive(simulation: Simulation, twist: Twist, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        simulation.drive(*twist)
        simulation.advance()


def place(pose: Pose) -> Place:
    return Place(x=pose.x, y=pose.y, yaw=pose.yaw)


@pytest.mark.parametrize(
    ("name", "twist"),
    [
        ("skid_rover", (0.3, 0.0, 0.0)),
        ("mecanum_cart", (0.3, 0.0, 0.0)),
        ("mecanum_cart", (0.0, 0.3, 0.0)),
        ("mecanum_cart", (0.0, -0.2, 0.5)),
        ("omni_disc", (0.0, 0.4, 0.0)),
        ("omni_disc", (-0.2, 0.2, 0.7)),
        ("ackermann_car", (0.45, 0.0, 1.0)),
        ("ackermann_car", (-0.2, 0.0, 0.3)),
    ],
)
def test_it_drives_the_commanded_velocity_within_three_percent(name: str, twist: Twist) -> None:
    simulation = simulation_of(name)
    drive(simulation, twist, 1.0)
    before = simulation.truth.pose()
    drive(simulation, twist, 0.5)
    moved = relative(place(before), place(simulation.truth.pose()))
    half = moved.yaw / 2
    straight = math.hypot(twist[0], twist[1]) * 0.5 * (math.sin(half) / half if half else 1.0)
    assert math.hypot(moved.x, moved.y) == pytest.approx(straight, rel=0.03)
    assert moved.yaw == pytest.approx(0.5 * twist[2], rel=0.03, abs=0.002)
    heading = math.atan2(twist[1], twist[0]) + half
    assert math.remainder(math.atan2(moved.y, moved.x) - heading, math.tau) == pytest.approx(
        0.0, abs=0.03
    )
    assert simulation.velocity() == pytest.approx(twist, rel=0.03, abs=0.03)


@pytest.mark.parametrize("name", ["skid_rover", "mecanum_cart", "omni_disc", "ackermann_car"])
def test_odometry_follows_a_mixed_drive_within_three_percent(name: str) -> None:
    simulation = simulation_of(name)
    sideways = 0.2 if load_robot(name).max_lateral_speed else 0.0
    for twist in ((0.3, 0.0, 0.3), (0.2, sideways, -0.4), (-0.2, -sideways, 0.2), (0.3, 0.0, 0.0)):
        drive(simulation, twist, 2.0)
    truth, odometry = simulation.truth.pose(), simulation.odometry()
    off = math.hypot(truth.x - odometry.x, truth.y - odometry.y)
    assert off < 0.03 * simulation.truth.distance_m
    assert abs(math.remainder(truth.yaw - odometry.yaw, math.tau)) < math.radians(2)


def test_a_skid_steered_base_turns_on_the_spot_with_scrubbing_wheels() -> None:
    simulation = simulation_of("skid_rover")
    drive(simulation, (0.0, 0.0, 1.0), 3.0)
    pose = simulation.truth.pose()
    assert math.hypot(pose.x, pose.y) < 0.03
    assert simulation.velocity().angular_z == pytest.approx(1.0, rel=0.15)
    left = next(one for one in simulation.motors() if one.name == "wheel_front_left_joint")
    rolling = 1.0 * 0.32 / 2 / 0.07
    assert abs(left.velocity) > 1.5 * rolling  # the speed of wheels that roll without scrubbing


def test_a_car_does_not_turn_on_the_spot_and_keeps_its_radius() -> None:
    simulation = simulation_of("ackermann_car")
    drive(simulation, (0.0, 0.0, 1.0), 1.0)
    assert simulation.truth.pose().yaw == pytest.approx(0.0, abs=0.01)
    returned = simulation.drive(0.2, 0.0, 1.0)
    assert returned.angular_z == pytest.approx(0.2 / 0.45, rel=0.01)
    drive(simulation, (0.2, 0.0, 1.0), 3.0)
    v, w = simulation.truth.speed()
    assert v / w == pytest.approx(0.45, rel=0.03)


def test_missing_dimensions_of_a_base_are_named(tmp_path: Path) -> None:
    robot = msgspec.structs.replace(load_robot("mecanum_cart"), wheel_base=0.0, wheel_radius=0.0)
    run = Run(folder=robot_path("mecanum_cart").parent)
    with pytest.raises(ConfigError, match=r"'mecanum' needs its wheel_radius and wheel_base"):
        sim_body(robot, MujocoOptions(driver="mujoco"), run)


def test_the_wheels_in_example_models_agree_with_the_robot_files(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING):
        for name in ("skid_rover", "mecanum_cart", "omni_disc", "ackermann_car"):
            simulation_of(name)
    assert caplog.messages == []
