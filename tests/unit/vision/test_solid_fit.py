"""Shapes of things from the points that a depth camera sees of them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.vision.solid_fit import MIN_POINTS, SolidFit, fit_solid

ABOVE, BESIDE = np.array([0.17, 0.0, 0.55]), np.array([0.0, 0.0, 0.1])  # [m], of cameras
STEP_M = 0.002  # between points
NOISE_M = 0.0004


def grid(wide: float, tall: float) -> Floats:
    """Points (n, 2) of a rectangle, as a picture's pixels meet them [m]."""
    x = np.arange(-wide / 2 + STEP_M / 2, wide / 2, STEP_M)
    y = np.arange(-tall / 2 + STEP_M / 2, tall / 2, STEP_M)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def placed(points: Floats, at: tuple[float, float], yaw: float = 0.0) -> Floats:
    """Points (n, 3), turned, put somewhere, and with noise."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    flat = points[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + at
    noise = np.random.default_rng(0).normal(0.0, NOISE_M, points.shape)
    return np.asarray(np.column_stack((flat, points[:, 2])) + noise)


def found(points: Floats, eye: Floats) -> SolidFit:
    fit = fit_solid(points, eye, STEP_M)
    assert fit
    return fit


def top(points: Floats, height: float) -> Floats:
    return np.column_stack((points, np.full(len(points), height)))


@pytest.mark.long
@given(st.floats(-math.pi / 4, math.pi / 4), st.floats(0.03, 0.06), st.floats(0.02, 0.029))
def test_a_box_seen_from_above_has_its_sides_and_its_turn(
    yaw: float, long: float, wide: float
) -> None:
    fit = found(placed(top(grid(long, wide), 0.03), (0.2, 0.1), yaw), ABOVE)
    assert fit.shape == "box"
    assert sorted(fit.size[:2]) == pytest.approx([wide, long], abs=0.004)
    assert fit.size[2] == pytest.approx(0.03, abs=0.0015)
    assert fit.position == pytest.approx((0.2, 0.1, 0.015), abs=0.0015)
    off = math.remainder(fit.yaw - yaw, math.pi / 2)
    assert abs(off) < math.radians(7)


@pytest.mark.parametrize("radius", [0.01, 0.015, 0.03])
def test_a_cylinder_seen_from_above_is_round(radius: float) -> None:
    points = grid(2 * radius, 2 * radius)
    disc = points[np.hypot(*points.T) < radius]
    fit = found(placed(top(disc, 0.04), (0.2, -0.1)), ABOVE)
    assert fit.shape == "cylinder"
    assert fit.size == pytest.approx((radius, 0.04), abs=0.002)
    assert fit.position == pytest.approx((0.2, -0.1, 0.02), abs=0.001)


@pytest.mark.parametrize("radius", [0.0105, 0.02, 0.033])
def test_a_ball_seen_from_above_is_one(radius: float) -> None:
    points = grid(2 * radius, 2 * radius)
    away = np.hypot(*points.T)
    cap = away < 0.95 * radius
    height = radius + np.sqrt(radius**2 - away[cap] ** 2)
    fit = found(placed(np.column_stack((points[cap], height)), (0.2, 0.0)), ABOVE)
    assert fit.shape == "sphere"
    assert fit.size == pytest.approx((radius,), abs=0.002)
    assert fit.position == pytest.approx((0.2, 0.0, radius), abs=0.002)


def test_a_can_seen_from_the_side_is_as_thick_as_its_front_is_round() -> None:
    radius, far = 0.033, 0.6
    across = grid(2 * 0.9 * radius, 0.1)  # y, and height from its middle
    depth = far - np.sqrt(radius**2 - across[:, 0] ** 2)
    points = np.column_stack((depth, across[:, 0], across[:, 1] + 0.06))
    fit = found(placed(points, (0.0, 0.0)), BESIDE)
    assert fit.shape == "cylinder"
    assert fit.size == pytest.approx((radius, 0.11), abs=0.003)
    assert fit.position[:2] == pytest.approx((far, 0.0), abs=0.003)


@pytest.mark.parametrize("bearing", [0.0, 0.6, -1.2])
def test_a_box_of_which_one_side_is_seen_is_as_thick_as_wide(bearing: float) -> None:
    across = grid(0.06, 0.05)
    points = np.column_stack((np.full(len(across), 0.6), across[:, 0], across[:, 1] + 0.03))
    fit = found(placed(points, (0.0, 0.0), bearing), BESIDE)
    assert fit.shape == "box"
    assert fit.size == pytest.approx((0.06, 0.06, 0.055), abs=0.005)
    middle = 0.63 * math.cos(bearing), 0.63 * math.sin(bearing)
    assert fit.position[:2] == pytest.approx(middle, abs=0.004)


def test_a_box_that_shows_two_sides_has_both_lengths() -> None:
    front, side = grid(0.08, 0.05), grid(0.04, 0.05)
    points = np.concatenate((
        np.column_stack((np.full(len(front), -0.02), front[:, 0], front[:, 1] + 0.03)),
        np.column_stack((side[:, 0], np.full(len(side), -0.04), side[:, 1] + 0.03)),
    ))  # fmt: skip
    fit = found(placed(points, (0.6, 0.3), 0.2), np.array([0.0, -0.2, 0.05]))
    assert fit.shape == "box"
    assert sorted(fit.size[:2]) == pytest.approx([0.04, 0.08], abs=0.006)
    assert fit.position[:2] == pytest.approx((0.6, 0.3), abs=0.006)


def test_too_few_points_fit_nothing() -> None:
    assert fit_solid(np.zeros((MIN_POINTS - 1, 3)), ABOVE, STEP_M) is None


@pytest.mark.long
@given(st.integers(0, 2**32 - 1), st.integers(MIN_POINTS, 60))
def test_any_points_give_finite_sizes_or_nothing(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).uniform(0.0, 0.3, (count, 3))
    for eye in (ABOVE, BESIDE):
        fit = fit_solid(points, eye, STEP_M)
        assert fit is None or (np.isfinite(fit.size).all() and min(fit.size) > 0.0)
