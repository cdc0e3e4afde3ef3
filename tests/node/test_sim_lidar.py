"""The simulated lidar: directions of beams, range limits, and noise."""

import math
from importlib.resources import files

import mujoco
import numpy as np
import pytest

from gigabrain_drivers.sim.body import SimBody, SimLidar
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.world import Cylinder, Pose, Shape, WalkingPath, World
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import Unsupported

EXACT = SimLidar(noise_m=0.0)
LIDAR_AT_ORIGIN = Pose(0.064, 0, 0)  # the lidar is 0.064 m behind the origin of the base


def waffle(lidar: SimLidar | None) -> SimBody:
    model = files("gigabrain_drivers") / "bodies/turtlebot3_waffle/model.xml"
    return SimBody(model=model.read_text(), wheel_radius=0.033, wheel_separation=0.287, lidar=lidar)


def room(half: float, *shapes: Shape, start: Pose = LIDAR_AT_ORIGIN) -> World:
    """Return a square room; by default the lidar starts in its middle."""
    return World(name="room", description="", half_x=half, half_y=half, shapes=shapes, start=start)


def test_beams_without_a_hit_are_infinite_and_the_robot_is_not_seen() -> None:
    scan = Simulation(waffle(SimLidar()), room(10), 0).scan()
    assert scan.shape == (360,)
    assert scan.dtype == np.float32
    assert np.isposinf(scan).all()


def test_the_first_beam_points_ahead_and_the_others_follow_counter_clockwise() -> None:
    pillars = (Cylinder(2, 0, 0.1, 1), Cylinder(0, 1, 0.1, 1), Cylinder(-3, 0, 0.1, 1))
    scan = Simulation(waffle(EXACT), room(10, *pillars), 0).scan()
    assert scan[[0, 90, 180]] == pytest.approx([1.9, 0.9, 2.9], abs=1e-3)
    assert np.isposinf(scan[[45, 135, 225, 270, 315]]).all()


def test_beams_turn_with_the_robot() -> None:
    pillar = Cylinder(2, 0, 0.1, 1)
    turned = room(10, pillar, start=Pose(0, 0.064, math.pi / 2))
    scan = Simulation(waffle(EXACT), turned, 0).scan()
    assert scan[270] == pytest.approx(1.9, abs=1e-3)


def test_walls_are_measured_to_a_millimetre_at_every_angle() -> None:
    scan = Simulation(waffle(EXACT), room(2), 0).scan()
    angle = np.arange(360) * math.tau / 360
    wall = 2 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    assert np.abs(scan - wall).max() < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_beams_beyond_range_are_infinite_and_all_others_agree_with_single_rays(seed: int) -> None:
    lidar = SimLidar(noise_m=0.0, range_max=1.5)
    simulation = Simulation(waffle(lidar), load_world("random:2", seed), 0)
    scan = simulation.scan()
    single = _single_rays(simulation)
    assert np.array_equal(np.isinf(scan), single > 1.5)
    assert np.abs(scan - single)[single <= 1.5].max() < 1e-6


def _single_rays(simulation: Simulation) -> np.ndarray:
    """Return the 360 ranges by one `mj_ray` each, without a cutoff."""
    model, data = simulation.model, simulation.data
    site = data.site("robot/lidar")
    groups, hit, ranges = np.array([1, 1, 0, 1, 1, 1], np.uint8), np.zeros(1, np.int32), []
    for angle in np.arange(360) * math.tau / 360:
        ray = site.xmat.reshape(3, 3) @ [math.cos(angle), math.sin(angle), 0]
        ranges.append(mujoco.mj_ray(model, data, site.xpos, ray, groups, 1, -1, hit, None))
    return np.array(ranges)


def test_noise_has_the_given_deviation_and_depends_on_the_seed() -> None:
    lidar = SimLidar(noise_m=0.02, beams=2000)
    exact = Simulation(waffle(SimLidar(noise_m=0.0, beams=2000)), room(1.5), 0).scan()
    error = Simulation(waffle(lidar), room(1.5), 0).scan() - exact
    assert abs(error.mean()) < 0.002
    assert error.std() == pytest.approx(0.02, abs=0.002)
    again = Simulation(waffle(lidar), room(1.5), 0).scan() - exact
    other = Simulation(waffle(lidar), room(1.5), 1).scan() - exact
    assert np.array_equal(error, again)
    assert not np.array_equal(error, other)


def test_an_obstacle_nearer_than_range_min_is_reported_at_range_min() -> None:
    near = SimLidar(range_min=1.0)
    scan = Simulation(waffle(near), room(3, Cylinder(0.6, 0, 0.1, 1)), 0).scan()
    assert scan[0] == 1.0


def test_a_walking_person_is_seen_at_the_present_place() -> None:
    world = World(
        name="street",
        description="",
        half_x=20,
        half_y=20,
        shapes=(),
        people=(WalkingPath(((3, -8), (3, 8), (9, 8), (9, -8)), start=7.2),),
        start=Pose(0.064, 0, 0),
    )
    simulation = Simulation(waffle(EXACT), world, 0)
    for _ in range(100):
        simulation.advance()
    assert simulation.scan()[0] == pytest.approx(2.75, abs=2e-3)
    assert np.isposinf(simulation.scan()[[330, 30, 180]]).all()


def test_a_scan_without_a_lidar_is_refused() -> None:
    with pytest.raises(Unsupported, match="no lidar"):
        Simulation(waffle(None), room(3), 0).scan()
