"""The errors of a depth camera are those that its model names, and the same for the same seed."""

import math
from dataclasses import replace

import numpy as np
import pytest

from gigabrain_drivers.cameras.depth_noise import NO_ERRORS, SENSOR, DepthSensor
from gigabrain_schemas.body import Camera

CAMERA = Camera(name="front", depth=True, x=0.064, z=0.094)


def flat(depth_m: float) -> np.ndarray:
    return np.full((240, 320), depth_m, np.float32)


def floor() -> np.ndarray:
    """The floor under a camera 0.094 m above it that looks ahead; the upper half sees nothing."""
    _, focal, _, middle = CAMERA.pinhole
    rows = np.arange(240) - middle
    depth = np.where(rows > 0, focal * 0.094 / np.maximum(rows, 0.1), 1000.0)
    return np.repeat(depth[:, None], 320, axis=1).astype(np.float32)


@pytest.mark.parametrize(("depth_m", "sigma_mm"), [(1.0, 1.5), (2.0, 6.0), (4.0, 24.0)])
def test_noise_grows_with_the_square_of_the_depth(depth_m: float, sigma_mm: float) -> None:
    measured = DepthSensor(CAMERA, 1).measure(flat(depth_m))
    known = measured[measured > 0].astype(float)
    assert known.mean() == pytest.approx(1000 * depth_m, abs=0.02 * sigma_mm + 0.1)
    assert known.std() == pytest.approx(sigma_mm, rel=0.05)


def test_two_pixels_of_a_hundred_are_holes_some_of_them_in_patches() -> None:
    sensor = DepthSensor(CAMERA, 1)
    holes = np.array([sensor.measure(flat(1.0)) == 0 for _ in range(20)])
    assert holes.mean() == pytest.approx(0.02, abs=0.001)
    neighbours = holes[:, :, :-1] & holes[:, :, 1:]
    assert neighbours.mean() > 0.005  # of single holes 0.0004


def test_pixels_at_an_edge_measure_something_between() -> None:
    step = flat(1.0)
    step[:, 160:] = 2.0
    only_mixed = replace(NO_ERRORS, mixed=0.5)
    measured = DepthSensor(CAMERA, 1, only_mixed).measure(step)
    between = (measured > 1000) & (measured < 2000)
    assert set(np.nonzero(between)[1].tolist()) == {159, 160}
    assert between[:, 159:161].mean() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("turned", [False, True])
def test_a_floor_seen_at_a_grazing_angle_has_no_edges(turned: bool) -> None:
    depth = np.ascontiguousarray(floor().T) if turned else floor()
    camera = Camera(name="front", width=depth.shape[1], height=depth.shape[0], depth_max=60.0)
    measured = DepthSensor(camera, 1, replace(NO_ERRORS, mixed=1.0)).measure(depth)
    truth = DepthSensor(camera, 1, NO_ERRORS).measure(depth)
    near = (truth > 0) & (truth < 10_000)
    assert np.abs(measured.astype(int) - truth)[near].max() <= 1


@pytest.mark.parametrize(
    ("depth_m", "known"),
    [
        (0.24, 0),
        (0.26, 260),
        (5.99, 5990),
        (6.01, 0),
        (1000.0, 0),
        (np.inf, 0),
        (np.nan, 0),
        (0, 0),
    ],
)
def test_out_of_its_range_a_camera_measures_nothing(depth_m: float, known: int) -> None:
    assert set(DepthSensor(CAMERA, 0, NO_ERRORS).measure(flat(depth_m)).ravel().tolist()) == {known}


def test_a_range_beyond_16_bits_is_unknown() -> None:
    far = Camera(name="far", depth=True, depth_max=100.0)
    assert not DepthSensor(far, 0, NO_ERRORS).measure(flat(70.0)).any()
    assert (DepthSensor(far, 0, NO_ERRORS).measure(flat(65.0)) == 65_000).all()


def test_the_mounting_is_known_to_half_a_degree_and_5_mm() -> None:
    mounted = [DepthSensor(CAMERA, seed).mounted for seed in range(200)]
    off_m = np.array([(one.x - 0.064, one.y, one.z - 0.094) for one in mounted])
    off_rad = np.array([(one.roll, one.pitch, one.yaw) for one in mounted])
    assert 0.0045 < np.abs(off_m).max() <= 0.005
    assert math.radians(0.45) < np.abs(off_rad).max() <= math.radians(0.5)
    assert np.abs(off_m.mean(axis=0)).max() < 0.001


def test_a_seed_gives_the_same_bits_and_another_one_or_another_camera_others() -> None:
    def drawn(name: str, seed: int) -> tuple[Camera, bytes]:
        sensor = DepthSensor(Camera(name=name), seed)
        return sensor.mounted, sensor.measure(flat(1.0)).tobytes()

    assert drawn("front", 3) == drawn("front", 3)
    assert drawn("front", 3) != drawn("front", 4)
    assert drawn("front", 3)[1] != drawn("rear", 3)[1]


def test_an_exposure_has_the_same_errors_whenever_it_is_measured() -> None:
    sensor = DepthSensor(CAMERA, 3)

    def measured(number: int) -> bytes:
        sensor.begin(number)
        return sensor.measure(flat(1.0)).tobytes()

    first = measured(7)
    assert measured(8) != first
    assert measured(7) == first


def test_without_errors_the_truth_is_measured_and_the_mounting_is_the_file_s() -> None:
    sensor = DepthSensor(CAMERA, 7, NO_ERRORS)
    assert sensor.mounted == CAMERA
    assert (sensor.measure(flat(1.2345)) == 1234).all()
    assert SENSOR != NO_ERRORS
