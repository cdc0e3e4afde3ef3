"""The simulated bodies: driving, odometry, wear, and repeatability by the seed."""

import logging
import math
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import mujoco
import pytest

from gigabrain_drivers.sim.body import SimBattery, SimBody
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.scene import compile_scene
from gigabrain_drivers.sim.world import Box, Pose, Shape, World
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import BodyLost, ConfigError


def waffle() -> SimBody:
    return _body("turtlebot3_waffle", 0.287)


def burger() -> SimBody:
    return _body("turtlebot3_burger", 0.160)


def _body(name: str, separation: float) -> SimBody:
    model = files("gigabrain_drivers") / "bodies" / name / "model.xml"
    return SimBody(model=model.read_text(), wheel_radius=0.033, wheel_separation=separation)


def room(*shapes: Shape, half: float = 5.0) -> World:
    return World(name="room", description="", half_x=half, half_y=half, shapes=shapes)


def run(simulation: Simulation, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        simulation.advance()


def test_the_bodies_have_size_and_mass_of_their_data_sheets() -> None:
    for body, mass, footprint, lidar in (
        (waffle(), 1.81, (0.069, -0.197, 0.1535), (-0.064, 0.0, 0.155)),
        (burger(), 1.005, (0.037, -0.101, 0.089), (-0.032, 0.0, 0.172)),
    ):
        simulation = Simulation(body, room(), 0)
        measured = simulation.truth.footprint
        assert (measured.front, measured.rear, measured.half_width) == pytest.approx(footprint)
        assert simulation.data.site("robot/lidar").xpos == pytest.approx(lidar)
        assert simulation.model.body("robot/base").subtreemass[0] == pytest.approx(mass)
        base = simulation.model.body("robot/base").id
        own = simulation.model.body_rootid[simulation.model.geom_bodyid] == base
        assert set(simulation.model.geom_group[own]) == {2}


@pytest.mark.parametrize("body", [waffle(), burger()], ids=["waffle", "burger"])
def test_it_drives_the_commanded_velocity_within_a_percent(body: SimBody) -> None:
    simulation = Simulation(body, room(half=20), 0)
    assert simulation.command(0.2, 0.5) == pytest.approx((0.2, 0.5))
    run(simulation, 3)
    assert simulation.truth.speed() == pytest.approx((0.2, 0.5), rel=0.01)
    assert simulation.odometry().linear_x == pytest.approx(0.2, abs=0.002)
    assert simulation.odometry().angular_z == pytest.approx(0.5, abs=0.01)


def test_a_square_closes_within_2_cm_and_a_degree_by_odometry() -> None:
    simulation = Simulation(waffle(), room(half=20), 0)
    for _ in range(4):
        _drive(simulation, 0.2, 1.0)
        _turn(simulation, math.pi / 2)
    odometry, truth = simulation.odometry(), simulation.truth.pose()
    assert math.hypot(odometry.x - truth.x, odometry.y - truth.y) < 0.02
    assert abs(math.remainder(odometry.yaw - truth.yaw, math.tau)) < math.radians(1)
    assert simulation.truth.distance_m == pytest.approx(4.0, rel=0.02)


def _drive(simulation: Simulation, speed: float, metres: float) -> None:
    start = simulation.odometry()
    simulation.command(speed, 0.0)
    while math.hypot(simulation.odometry().x - start.x, simulation.odometry().y - start.y) < metres:
        simulation.advance()
    simulation.command(0.0, 0.0)
    run(simulation, 0.3)


def _turn(simulation: Simulation, radians: float) -> None:
    start = simulation.odometry().yaw
    simulation.command(0.0, 0.5)
    while simulation.odometry().yaw - start < radians:
        simulation.advance()
    simulation.command(0.0, 0.0)
    run(simulation, 0.3)


def test_a_twist_too_fast_for_the_wheels_is_scaled_down() -> None:
    simulation = Simulation(waffle(), room(), 0)
    linear_x, angular_z = simulation.command(0.26, 1.82)
    assert linear_x / angular_z == pytest.approx(0.26 / 1.82)
    assert (linear_x + angular_z * 0.287 / 2) / 0.033 == pytest.approx(9.0)
    assert simulation.command(-0.1, 0.0) == pytest.approx((-0.1, 0.0))


def test_wheel_acceleration_is_limited() -> None:
    body = replace(waffle(), max_wheel_acceleration=10.0)
    simulation = Simulation(body, room(), 0)
    simulation.command(0.2, 0.0)
    run(simulation, 0.3)
    assert simulation.truth.speed()[0] == pytest.approx(0.3 * 10 * 0.033, rel=0.05)


@pytest.mark.parametrize("body", [waffle(), burger()], ids=["waffle", "burger"])
def test_worn_wheels_drive_slower_and_stay_level(body: SimBody) -> None:
    simulation = Simulation(replace(body, wheel_scale=0.9), room(half=20), 0)
    simulation.command(0.2, 0.0)
    run(simulation, 2)
    assert simulation.truth.speed()[0] == pytest.approx(0.18, rel=0.01)
    assert simulation.odometry().linear_x == pytest.approx(0.2, rel=0.01)
    assert simulation.data.body("robot/base").xmat[8] > math.cos(math.radians(0.2))
    assert simulation.data.body("robot/base").xpos[2] == pytest.approx(0.033, abs=5e-4)


def test_a_calibrated_wheel_radius_reports_the_true_speed() -> None:
    body = replace(waffle(), wheel_scale=0.9, odometry_wheel_radius=0.9 * 0.033)
    simulation = Simulation(body, room(half=20), 0)
    simulation.command(0.2, 0.0)
    run(simulation, 2)
    true_speed = simulation.truth.speed()[0]
    assert simulation.odometry().linear_x == pytest.approx(true_speed, rel=0.01)


def test_at_rest_nothing_moves_and_the_imu_measures_gravity() -> None:
    simulation = Simulation(waffle(), load_world("house", 4), 4)
    run(simulation, 5)
    assert simulation.odometry() == (0.0, 0.0, 0.0, 0.0, 0.0)
    assert simulation.truth.distance_m < 1e-4
    sample = simulation.imu()
    assert sample.linear_acceleration == pytest.approx((0, 0, 9.81), abs=0.15)
    assert sample.angular_velocity == pytest.approx((0, 0, 0), abs=0.01)
    assert sample.orientation == pytest.approx((0, 0, 0, 1), abs=0.005)


def test_the_imu_measures_the_heading_from_the_start() -> None:
    world = replace(room(), start=Pose(1, 2, 2.5))
    simulation = Simulation(waffle(), world, 0)
    simulation.command(0.0, 0.5)
    run(simulation, 3)
    _, _, z, w = simulation.imu().orientation
    assert 2 * math.atan2(z, w) == pytest.approx(simulation.odometry().yaw, abs=0.02)
    assert simulation.imu().angular_velocity[2] == pytest.approx(0.5, abs=0.02)
    assert simulation.truth.pose().yaw == pytest.approx(2.5 + 1.49 - math.tau, abs=0.02)


def test_time_is_counted_in_whole_ticks() -> None:
    simulation = Simulation(burger(), room(), 0)
    assert simulation.time_ns == 0
    run(simulation, 1.23)
    assert simulation.time_ns == 1_230_000_000
    assert simulation.data.time == pytest.approx(1.23)


def test_wheels_report_name_angle_speed_and_effort() -> None:
    simulation = Simulation(waffle(), room(), 0)
    simulation.command(0.165, 0.0)
    run(simulation, 2)
    left, right = simulation.motors()
    assert (left.name, right.name) == ("wheel_left_joint", "wheel_right_joint")
    assert left.velocity == pytest.approx(5.0, abs=0.05)
    assert left.position == pytest.approx(10.0, abs=0.3)
    assert abs(left.effort) < 0.1
    tick = math.tau / 4096
    assert right.position / tick == pytest.approx(round(right.position / tick), abs=1e-6)


def test_the_battery_drains_faster_when_driving() -> None:
    resting, driving = (Simulation(waffle(), room(), 0) for _ in range(2))
    driving.command(0.2, 1.0)
    run(resting, 5)
    run(driving, 5)
    assert resting.battery().current == pytest.approx(0.6, abs=0.02)
    assert resting.battery().percentage == pytest.approx(100 - 100 * 0.6 * 5 / 3600 / 1.8, abs=1e-3)
    assert resting.battery().voltage == pytest.approx(12.54, abs=0.01)
    assert driving.battery().percentage < resting.battery().percentage
    assert driving.battery().voltage < resting.battery().voltage


def test_an_empty_battery_stays_empty_at_its_lowest_voltage() -> None:
    body = replace(waffle(), battery=SimBattery(percentage=0.001))
    simulation = Simulation(body, room(), 0)
    run(simulation, 1)
    assert simulation.battery().percentage == 0.0
    assert simulation.battery().voltage == pytest.approx(9.84, abs=0.01)


def test_a_stalled_motor_gets_warmer_than_a_free_one() -> None:
    free = Simulation(waffle(), room(half=20), 0)
    stalled = Simulation(waffle(), room(Box(0.2, 0, 0.1, 1, 0.5)), 0)
    for simulation in (free, stalled):
        simulation.command(0.2, 0.0)
        run(simulation, 10)
    assert free.motors()[0].temperature == pytest.approx(25.6, abs=0.5)
    assert stalled.motors()[0].temperature > free.motors()[0].temperature + 0.5
    assert abs(stalled.motors()[0].effort) > 0.2


def test_the_same_seed_and_commands_give_the_same_bits() -> None:
    first, second = (_recording(seed=3) for _ in range(2))
    assert first == second
    assert first != _recording(seed=4)


def _recording(seed: int) -> list[object]:
    """Return all sensor values of two seconds of driving in the warehouse."""
    simulation = Simulation(waffle(), load_world("warehouse", 3), seed)
    record: list[object] = []
    for tick in range(200):
        simulation.command(0.2, 0.5 if tick % 80 < 40 else -0.3)
        simulation.advance()
        record += [simulation.odometry(), simulation.imu(), simulation.motors()]
        if tick % 10 == 0:
            record.append(simulation.scan().tobytes())
    return [*record, simulation.battery(), simulation.truth.pose()]


def test_an_unstable_simulation_is_a_lost_body_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    simulation = Simulation(waffle(), room(), 0)
    run(simulation, 0.1)
    simulation.data.qvel[0] = math.nan
    with caplog.at_level(logging.WARNING), pytest.raises(BodyLost, match=r"after 0\.11 s"):
        simulation.advance()
    assert list(tmp_path.iterdir()) == []
    assert any("QVEL" in record.getMessage() for record in caplog.records)


def test_an_invalid_model_is_refused() -> None:
    with pytest.raises(ConfigError, match="MJCF"):
        Simulation(replace(waffle(), model="<mujoco><nonsense/></mujoco>"), room(), 0)


def test_missing_parts_of_a_model_are_named() -> None:
    model = waffle().model.replace("wheel_left", "left_wheel").replace("lidar", "laser")
    with pytest.raises(ConfigError, match=r"no joint 'wheel_left_joint'.* no site 'lidar'"):
        Simulation(replace(waffle(), model=model), room(), 0)


def test_scanning_does_not_change_the_simulation() -> None:
    scanned, unscanned = (Simulation(waffle(), load_world("warehouse", 3), 3) for _ in range(2))
    for _ in range(200):
        for simulation in (scanned, unscanned):
            simulation.command(0.2, 0.2)
            simulation.advance()
        scanned.scan()
    assert scanned.truth.pose() == unscanned.truth.pose()
    assert scanned.imu() == unscanned.imu()


def test_the_robot_model_does_not_change_the_options_of_the_world() -> None:
    model = compile_scene(waffle(), load_world("house", 0))
    assert model.opt.timestep == 0.005
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.impratio == 10
