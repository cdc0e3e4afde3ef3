"""The BARN bench: its plant, its worlds and its score."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.bench import barn
from gigabrain_zenoh.qa.bench.barn import drive_functions
from gigabrain_zenoh.qa.bench.barn_course import (
    HARD,
    IDEAL,
    LIDAR,
    MUJOCO,
    BarnWorld,
    Conditions,
    KinematicJackal,
    MovingDisc,
    choose_worlds,
    read_worlds,
)
from gigabrain_zenoh.qa.bench.jackal import MujocoJackal

NO_POSTS = np.empty((0, 3))
SAMPLES = 128  # plans per cycle, few for a quick test


def world_of(posts: np.ndarray) -> BarnWorld:
    return BarnWorld(7, posts, (), (0.0, 0.0, 0.0), (4.0, 0.0), 4.0)


def test_the_hard_plant_follows_commands_after_its_delay_and_lag() -> None:
    no_drift = Conditions(slip=1.0, drift=0.0)
    plant, speeds = KinematicJackal(no_drift, (0.0, 0.0, 0.0), 1), []
    for _ in range(13):
        plant.tick(Velocity(linear_x=0.6))
        speeds.append(plant.v)
    assert speeds[4] == 0.0
    assert speeds[5] == pytest.approx(0.6 * (1 - math.exp(-0.02 / 0.15)))
    assert speeds[12] == pytest.approx(0.6 * (1 - math.exp(-0.16 / 0.15)))


def test_slip_reduces_a_turn_and_the_odometry_drifts() -> None:
    plant = KinematicJackal(HARD, (0.0, 0.0, 0.0), 5)
    for _ in range(200):
        plant.tick(Velocity(linear_x=0.5, angular_z=0.3))
    assert 0.6 <= plant.w / 0.3 <= 1.0
    assert plant.odometry.x != plant.x
    assert plant.velocity.linear_x == pytest.approx(plant.v, rel=0.02)


def test_clearance_is_exact() -> None:
    plant = KinematicJackal(IDEAL, (0.0, 0.0, math.pi / 2), 1)
    assert plant.clearance(np.array([(0.0, 0.5, 0.1)])) == pytest.approx(0.5 - 0.229 - 0.1)
    assert plant.clearance(np.array([(0.5, 0.0, 0.1)])) == pytest.approx(0.5 - 0.208 - 0.1)
    corner = math.hypot(0.4 - 0.208, 0.4 - 0.229) - 0.1
    assert plant.clearance(np.array([(0.4, 0.4, 0.1)])) == pytest.approx(corner)
    assert plant.clearance(np.array([(0.1, 0.1, 0.05)])) < 0.0
    assert plant.clearance(NO_POSTS) == math.inf


def test_a_beam_ends_at_the_first_disc() -> None:
    still = Conditions(noise=0.0, dropouts=0.0)
    plant = KinematicJackal(still, (0.0, 0.0, 0.0), 1)
    seen = plant.scan(LIDAR, np.array([(2.055, 0.0, 0.5), (4.0, 0.0, 0.5), (0.055, 3.0, 0.1)]))
    middle = seen[359:361]
    assert middle == pytest.approx([1.5, 1.5], abs=1e-4)
    assert seen.min() == pytest.approx(1.5, abs=1e-4)
    left = round(math.radians(135 + 90) / math.radians(270) * 719)
    assert seen[left] == pytest.approx(2.9, abs=1e-3)
    assert seen[0] == math.inf


def test_an_empty_world_is_driven_fast_enough_for_the_full_score() -> None:
    trial = drive_functions(world_of(NO_POSTS), 0, HARD, SAMPLES)
    assert (trial.result, trial.score) == ("success", 0.5)
    assert trial.least_clearance == math.inf
    again = drive_functions(world_of(NO_POSTS), 0, HARD, SAMPLES)
    assert again.seconds == trial.seconds


def test_the_hard_plant_is_driven_round_posts() -> None:
    posts = np.array([(2.0, 0.1 * i, 0.075) for i in range(-4, 5)])
    trial = drive_functions(world_of(posts), 0, HARD, SAMPLES)
    assert trial.result == "success"
    assert 0.0 < trial.least_clearance < 0.6


def test_a_contact_ends_a_trial() -> None:
    trial = drive_functions(world_of(np.array([(0.25, 0.0, 0.075)])), 0, HARD, SAMPLES)
    assert (trial.result, trial.score) == ("collision", 0.0)


@pytest.mark.parametrize("plant", [HARD, MUJOCO])
def test_the_nodes_of_the_robot_reach_the_goal(plant: Conditions) -> None:
    posts = np.array([(2.0, 0.1 * i, 0.075) for i in range(-3, 4)])
    trial = barn.drive_nodes(world_of(posts), 0, plant, SAMPLES)
    assert trial.result == "success"
    assert 0.03 < trial.least_clearance < 0.6


def test_a_repeated_trial_has_the_same_result() -> None:
    posts = np.array([(1.5, 0.3, 0.075), (1.5, -0.5, 0.075)])
    one = barn.drive_nodes(world_of(posts), 1, HARD, SAMPLES)
    assert one.result == "success"
    assert barn.drive_nodes(world_of(posts), 1, HARD, SAMPLES) == one


def test_fake_time_does_not_pass_while_kernels_compile() -> None:
    """Else the bench would fail on a new installation: the robot is not localized in time."""
    course = barn.JudgedCourse(world_of(NO_POSTS), 0, HARD)
    nodes = barn._nodes(course, SAMPLES, "nowhere")
    for name in ("perception", "decision"):
        settings = nodes[name].args[0]  # type: ignore[attr-defined]
        assert settings.compile_first


def jackal(*posts: tuple[float, float, float]) -> MujocoJackal:
    no_drift = Conditions(delay=0.1, drift=0.0, noise=0.0, dropouts=0.0, physics=True)
    return MujocoJackal(no_drift, (0.0, 0.0, 0.0), np.array(posts).reshape(-1, 3), 1)


def drive(body: MujocoJackal, seconds: float, v: float, w: float) -> None:
    for _ in range(round(seconds * 50)):
        body.tick(Velocity(linear_x=v, angular_z=w))


def test_in_mujoco_it_turns_too_little_on_the_spot_and_too_much_at_speed() -> None:
    slow, quick = jackal(), jackal()
    drive(slow, 2.0, 0.0, 1.0)
    drive(quick, 2.0, 2.0, 1.0)
    assert 0.6 < slow.velocity.angular_z < 0.85
    assert 1.2 < quick.velocity.angular_z < 1.5
    assert abs(slow.x) < 0.1
    assert abs(slow.y) < 0.1


def test_in_mujoco_it_reaches_the_commanded_speed_after_delay_and_lag() -> None:
    body = jackal()
    drive(body, 0.1, 1.0, 0.0)
    assert abs(body.velocity.linear_x) < 0.01
    drive(body, 2.0, 1.0, 0.0)
    assert body.velocity.linear_x == pytest.approx(1.0, abs=0.02)
    assert body.odometry.x == pytest.approx(body.x, abs=0.03)


def test_in_mujoco_it_is_stopped_by_a_post_that_its_lidar_sees() -> None:
    post = (1.0, 0.0, 0.075)
    body, posts = jackal(post), np.array([post])
    assert body.scan(LIDAR, posts)[359:361] == pytest.approx([0.87, 0.87], abs=1e-3)
    assert body.clearance(posts) == pytest.approx(1.0 - 0.229 - 0.075)
    drive(body, 3.0, 0.5, 0.0)
    assert body.x == pytest.approx(0.696, abs=0.03)
    assert body.clearance(posts) < 0.01


def test_moving_discs_repeat_their_keyframes() -> None:
    mover = MovingDisc(4.0, np.array([(0.0, 0.0, 1.0), (4.0, 2.0, 1.0)]), 0.5)
    world = BarnWorld(1, NO_POSTS, (mover,), (0.0, 0.0, 0.0), (1.0, 0.0), 20.0)
    assert world.discs(1.0).tolist() == [[0.5, 1.0, 0.5]]
    assert world.discs(9.0).tolist() == [[0.5, 1.0, 0.5]]


def test_worlds_are_read_from_a_file_and_chosen_by_number(tmp_path: Path) -> None:
    meta = {"start": [-2.25, 3.0, 1.57], "goal": [-2.25, 13.0]}
    file = tmp_path / "worlds.npz"
    np.savez(
        file, index=np.array([3, 9]), cyl=np.ones((5, 3), np.float32), n_cyl=np.array([2, 3]),
        path_cells=np.zeros((2, 2), np.int16), n_path=np.array([1, 1]), meta=json.dumps(meta),
    )  # fmt: skip
    worlds = read_worlds(file, dynamic=False)
    assert [(w.number, len(w.posts)) for w in worlds] == [(3, 2), (9, 3)]
    assert worlds[0].length == pytest.approx(
        math.hypot(-2.325, 2.075) + math.hypot(2.325, 13.0 - 5.075)
    )
    assert choose_worlds(worlds, "9") == [worlds[1]]
    assert choose_worlds(worlds, "") == worlds
    with pytest.raises(ConfigError, match="no world 4 in the file; it has 2, from 3 to 9"):
        choose_worlds(worlds, "4")
    with pytest.raises(ConfigError, match="expected numbers like 1,7, got 'three'"):
        choose_worlds(worlds, "three")


def test_a_file_without_worlds_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "worlds.npz"
    with pytest.raises(ConfigError, match=r"cannot read .*No such file"):
        read_worlds(file, dynamic=False)
    file.write_bytes(b"PK nonsense")
    with pytest.raises(ConfigError, match="expected BARN worlds"):
        read_worlds(file, dynamic=False)
    with pytest.raises(ConfigError, match="expected DynaBARN worlds"):
        read_worlds(file, dynamic=True)
