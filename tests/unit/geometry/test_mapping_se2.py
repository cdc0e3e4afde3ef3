"""Poses in the plane."""

import numpy as np
import pytest

from gigabrain_zenoh.geometry.se2 import between, compose, inverse, transform, turned, wrap, wrapped


def test_a_pose_to_the_north_is_ahead_of_a_robot_that_faces_north() -> None:
    here, there = np.array((1.0, 2.0, np.pi / 2)), np.array((1.0, 3.0, np.pi))
    assert between(here, there) == pytest.approx((1.0, 0.0, np.pi / 2))


def test_a_pose_composed_with_its_inverse_is_the_identity() -> None:
    poses = np.random.default_rng(3).uniform(-4, 4, (50, 3))
    assert np.abs(compose(poses, inverse(poses))).max() < 1e-12
    a, b = poses[:25], poses[25:]
    assert np.abs(compose(a, between(a, b)) - wrapped(b)).max() < 1e-12


@pytest.mark.parametrize("yaw", [0.0, np.pi, -np.pi, 3 * np.pi, 2.5])
def test_a_single_pose_gives_the_same_result_as_one_in_an_array(yaw: float) -> None:
    for a, b in np.random.default_rng(4).uniform(-7, 7, (50, 2, 3)):
        b[2] = yaw
        for move in (compose, between):
            assert move(a, b) == pytest.approx(move(a[None], b[None])[0], abs=1e-12)
        assert inverse(b) == pytest.approx(inverse(b[None])[0], abs=1e-12)


def test_angles_are_within_a_half_turn() -> None:
    assert wrap(np.array((3 * np.pi / 2, -3 * np.pi / 2, 0.5))) == pytest.approx(
        (-np.pi / 2, np.pi / 2, 0.5)
    )


def test_points_are_turned_and_then_moved() -> None:
    points = np.array(((1.0, 0.0), (0.0, 2.0)))
    moved = transform(np.array((10.0, 20.0, np.pi / 2)), points)
    assert moved == pytest.approx(np.array(((10.0, 21.0), (8.0, 20.0))))


def test_a_covariance_turned_left_swaps_x_and_y() -> None:
    covariance = turned(np.diag((0.01, 4.0, 0.5)), np.pi / 2)
    assert covariance == pytest.approx(np.diag((4.0, 0.01, 0.5)))
