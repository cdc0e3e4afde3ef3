"""The quadruped in MuJoCo walks by its own estimates, and is judged by the true motion."""

import math
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
from numpy.typing import NDArray

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.kinematics.legs import JOINT_NAMES, WALKER
from gigabrain_drivers.kinematics.wheels import Twist
from gigabrain_drivers.sim.body import SimQuadruped
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.world import Box, Shape, World
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import ConfigError, Unsupported

MODEL = (files("gigabrain_drivers") / "bodies" / "alpha" / "model.xml").read_text()


def alpha() -> SimQuadruped:
    return SimQuadruped(model=MODEL)


def room(*shapes: Shape, half: float = 40.0) -> World:
    return World(name="room", description="", half_x=half, half_y=half, shapes=shapes)


def walk(
    simulation: Simulation, seconds: float, command: Callable[[float], Twist]
) -> NDArray[np.float64]:
    """Return true minus commanded velocity (n, 3) from the third second on."""
    errors = []
    for tick in range(round(seconds * 100)):
        twist = command(tick / 100)
        simulation.drive(*twist)
        simulation.advance()
        assert not simulation.fallen, f"fell after {tick / 100} s"
        if tick >= 300:
            errors.append(np.array(true_velocity(simulation)) - twist)
    return np.array(errors)


def true_velocity(simulation: Simulation) -> tuple[float, float, float]:
    yaw = simulation.truth.pose().yaw
    x, y, _, _, _, turning = simulation.data.qvel[:6].tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    return cos * x + sin * y, cos * y - sin * x, turning


def rms(values: NDArray[np.float64]) -> list[float]:
    return np.sqrt((values**2).mean(axis=0)).tolist()  # type: ignore[no-any-return]


@pytest.mark.slow
def test_it_walks_a_minute_at_0_3_m_s_within_0_02_rms_without_a_fall() -> None:
    simulation = Simulation(alpha(), room(), 0)
    errors = walk(simulation, 60, lambda _: Twist(0.3, 0.0, 0.0))
    forward, sideways, _ = rms(errors)
    assert forward <= 0.02
    assert sideways <= 0.02
    assert errors.mean(axis=0) == pytest.approx((0, 0, 0), abs=0.002)
    truth, odometry = simulation.truth.pose(), simulation.odometry()
    assert truth.x > 17.5
    assert math.hypot(truth.x - odometry.x, truth.y - odometry.y) < 0.01 * truth.x


@pytest.mark.parametrize(
    "twist",
    [Twist(-0.3, 0.0, 0.0), Twist(0.0, 0.15, 0.0), Twist(0.0, 0.0, 0.8), Twist(0.3, 0.1, -0.4)],
    ids=["backwards", "sideways", "turning", "all"],
)
def test_it_walks_in_any_direction(twist: Twist) -> None:
    simulation = Simulation(alpha(), room(), 1)
    errors = walk(simulation, 8, lambda _: twist)
    forward, sideways, _ = rms(errors)
    assert max(forward, sideways) < 0.03
    assert errors.mean(axis=0) == pytest.approx((0, 0, 0), abs=0.01)
    assert simulation.velocity() == pytest.approx(true_velocity(simulation), abs=0.25)


def test_it_follows_changing_commands_up_to_its_limits_without_a_fall() -> None:
    steps = np.random.default_rng(5).uniform(-1, 1, (10, 3)) * (0.5, 0.2, 1.0)
    simulation = Simulation(alpha(), room(), 5)
    walk(simulation, 15, lambda now: Twist(*steps[int(now / 1.5)].tolist()))
    truth, odometry = simulation.truth.pose(), simulation.odometry()
    assert math.hypot(truth.x - odometry.x, truth.y - odometry.y) < 0.1
    assert math.remainder(truth.yaw - odometry.yaw, math.tau) == pytest.approx(0, abs=0.05)


def test_a_push_from_the_side_does_not_make_it_fall() -> None:
    simulation = Simulation(alpha(), room(), 2)
    walk(simulation, 2, lambda _: Twist(0.3, 0.0, 0.0))
    simulation.data.qvel[1] += 0.5
    walk(simulation, 3, lambda _: Twist(0.3, 0.0, 0.0))
    assert true_velocity(simulation)[1] == pytest.approx(0.0, abs=0.1)


def test_it_comes_to_rest_on_four_feet_and_stays_there() -> None:
    simulation = Simulation(alpha(), room(), 3)
    walk(simulation, 2, lambda _: Twist(0.3, 0.0, 0.0))
    walk(simulation, 2, lambda _: Twist(0.0, 0.0, 0.0))
    before = simulation.truth.pose()
    walk(simulation, 2, lambda _: Twist(0.0, 0.0, 0.0))
    after = simulation.truth.pose()
    assert simulation.contacts() == (True, True, True, True)
    assert math.hypot(after.x - before.x, after.y - before.y) < 0.003


def test_it_stops_from_0_3_m_s_within_15_cm() -> None:
    simulation = Simulation(alpha(), room(), 3)
    walk(simulation, 3, lambda _: Twist(0.3, 0.0, 0.0))
    before = simulation.truth.pose()
    walk(simulation, 1.5, lambda _: Twist(0.0, 0.0, 0.0))
    assert simulation.truth.pose().x - before.x < 0.15


@pytest.mark.parametrize(
    "twist",
    [
        Twist(0.25, 0.0, 0.0),
        Twist(-0.25, 0.0, 0.0),
        Twist(0.0, 0.1, 0.0),
        Twist(0.0, 0.0, -0.5),
        Twist(0.2, 0.08, 0.0),
    ],
    ids=["ahead", "backwards", "sideways", "turning", "diagonal"],
)
def test_it_rests_600_ms_after_a_stop_in_any_phase_of_its_gait(twist: Twist) -> None:
    for phase in (0.0, 0.07, 0.14, 0.21):  # [s], within a gait cycle of 0.28 s
        simulation = Simulation(alpha(), room(), 0)
        walk(simulation, 1.2 + phase, lambda _: twist)
        walk(simulation, 0.6, lambda _: Twist(0.0, 0.0, 0.0))
        for _ in range(40):
            for speeds in (true_velocity(simulation), simulation.velocity()):
                assert max(map(abs, speeds[:2])) < 0.01
                assert abs(speeds[2]) < 0.05
            walk(simulation, 0.01, lambda _: Twist(0.0, 0.0, 0.0))


def test_it_stands_at_the_height_of_its_gait() -> None:
    simulation = Simulation(alpha(), room(), 0)
    for _ in range(200):
        simulation.walk(WALKER.to_gait(Twist(0, 0, 0))._replace(height=0.24))
        simulation.advance()
    assert simulation.data.body("robot/base").xpos[2] == pytest.approx(0.262, abs=0.005)


def test_it_goes_limp_after_a_fall() -> None:
    simulation = Simulation(alpha(), room(), 0)
    for tick in range(200):
        simulation.data.qvel[3] = 8.0 if tick < 20 else simulation.data.qvel[3]
        simulation.advance()
    assert simulation.fallen
    assert max(abs(motor.effort) for motor in simulation.motors()) < 20


def test_its_motors_have_names_and_warm_up_and_drain_the_battery() -> None:
    simulation = Simulation(alpha(), room(), 0)
    walk(simulation, 3, lambda _: Twist(0.3, 0.0, 0.0))
    assert tuple(motor.name for motor in simulation.motors()) == JOINT_NAMES
    assert 25.0 < max(motor.temperature for motor in simulation.motors()) < 30.0
    battery = simulation.battery()
    assert 2.0 < battery.current < 8.0
    assert 99.9 < battery.percentage < 100.0
    assert battery.voltage == pytest.approx(29.2, abs=0.2)


def test_hull_and_footprint_contain_the_feet_during_any_motion() -> None:
    simulation = Simulation(alpha(), room(), 0)
    base, model, data = simulation.model.body("robot/base").id, simulation.model, simulation.data
    feet = [model.geom(f"robot/{name}_foot").id for name in
            ("front_left", "front_right", "rear_left", "rear_right")]  # fmt: skip
    footprint, reach = simulation.truth.footprint, np.zeros(2)
    for tick in range(800):
        simulation.drive(*((0.5, 0.0, 1.0) if tick < 400 else (0.3, -0.2, 0.5)))
        simulation.advance()
        offsets = (data.geom_xpos[feet] - data.xpos[base]) @ data.xmat[base].reshape(3, 3)
        reach = np.maximum(reach, np.abs(offsets[:, :2]).max(axis=0) + 0.022)
    assert (footprint.front, footprint.rear, footprint.half_width) == pytest.approx(
        (0.278, -0.278, 0.188)
    )
    assert reach[0] <= 0.28
    assert reach[1] <= 0.19
    assert catalog.load_robot("alpha").footprint[0] == (0.28, 0.19)


def test_walking_is_no_contact_and_hitting_a_wall_is_one() -> None:
    simulation = Simulation(alpha(), room(Box(1.2, 0, 0.1, 2, 0.6)), 0)
    walk(simulation, 2, lambda _: Twist(0.2, 0.0, 0.0))
    assert simulation.truth.contacts == 0
    walk(simulation, 5, lambda _: Twist(0.2, 0.0, 0.0))
    assert simulation.truth.contacts == 1
    assert simulation.truth.min_clearance_m == 0.0


def test_equal_seeds_give_equal_bits_and_other_seeds_others() -> None:
    first, second, other = (_recording(seed) for seed in (3, 3, 4))
    assert first == second
    assert first != other


def _recording(seed: int) -> list[object]:
    simulation = Simulation(alpha(), load_world("warehouse", 3), seed)
    record: list[object] = []
    for _ in range(150):
        simulation.drive(0.2, 0.05, 0.3)
        simulation.advance()
        record += [simulation.odometry(), simulation.imu(), simulation.motors()]
    return [*record, simulation.scan().tobytes(), simulation.truth.pose()]


def test_missing_leg_parts_of_a_model_are_named() -> None:
    model = MODEL.replace("front_left_knee", "knie").replace("rear_right_contact", "touched")
    with pytest.raises(ConfigError, match=r"no joint 'front_left_knee'.*'rear_right_contact'"):
        Simulation(replace(alpha(), model=model), room(), 0)


def test_a_wheeled_base_refuses_to_walk() -> None:
    from gigabrain_drivers.sim.body import SimBody

    waffle = (files("gigabrain_drivers") / "bodies" / "turtlebot3_waffle" / "model.xml").read_text()
    body = SimBody(model=waffle, wheel_radius=0.033, wheel_separation=0.287)
    simulation = Simulation(body, room(), 0)
    with pytest.raises(Unsupported, match="no legs"):
        simulation.walk(WALKER.to_gait(Twist(0.1, 0.0, 0.0)))
    assert simulation.drive(0.1, 0.1, 0.0) == (pytest.approx(0.1), 0.0, 0.0)
