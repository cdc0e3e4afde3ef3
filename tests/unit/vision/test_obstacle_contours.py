"""Contours of analytic scenes: what stands, hangs or gapes is found, and nothing else."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.cameras.depth_noise import DepthSensor
from gigabrain_schemas.body import Camera
from gigabrain_zenoh.geometry.polygon import area
from gigabrain_zenoh.vision.obstacle_contours import MAX_PIXELS, ObstacleContours, step_of
from tests.unit.vision.scenes import (
    HIGH,
    LOW,
    START,
    Box,
    body,
    covers,
    depth_of,
    feed,
    image,
    millimetres,
    near,
)

CAMERAS = pytest.mark.parametrize("camera", [LOW, HIGH], ids=["low", "high"])
SEEDS = range(4)


def noisy(
    camera: Camera, seed: int, *boxes: Box, pictures: int = 3, pits: tuple[Box, ...] = ()
) -> ObstacleContours:
    """Return eyes that saw a scene through a sensor with errors."""
    sensor = DepthSensor(camera, seed)
    depth = depth_of(sensor.mounted, boxes, pits)
    eyes = ObstacleContours(body(camera))
    for number in range(pictures):
        assert eyes.add_depth("front", image(sensor.measure(depth)), START, number / 10) == ""
    return eyes


@pytest.mark.long
@CAMERAS
def test_an_empty_floor_has_no_contours(camera: Camera) -> None:
    for seed in SEEDS:
        eyes = noisy(camera, seed, pictures=20)
        assert eyes.contours(START, 2.0) == ()


@pytest.mark.long
@CAMERAS
@pytest.mark.parametrize("place", [(0.8, 0.2), (1.4, -0.3), (1.95, 0.0)])
def test_3_cm_are_found_within_2_m(camera: Camera, place: tuple[float, float]) -> None:
    x, y = place
    for seed in SEEDS:
        eyes = noisy(camera, seed, Box(x, y, 0.015, 0.015, 0.03))
        (found,) = eyes.contours(START, 0.3)
        assert near((found,), x, y, 0.05)
        assert found.bottom < 0.02 < found.top < 0.045
        assert area(np.array(found.polygon)) > 0


@CAMERAS
def test_a_wall_is_where_it_is(camera: Camera) -> None:
    contours = feed(ObstacleContours(body(camera)), camera, Box(1.5, 0.0, 0.05, 0.4, 1.0))
    assert near(contours, 1.45, 0.35, 0.01)
    assert near(contours, 1.45, -0.35, 0.01)
    assert not near(contours, 1.40, 0.0, 0.03)
    assert not near(contours, 1.45, 0.45, 0.03)


def test_a_room_is_not_filled_from_corner_to_corner() -> None:
    walls = (Box(2.0, 0.0, 0.05, 1.0, 1.0), Box(1.0, 1.0, 1.05, 0.05, 1.0))
    contours = feed(ObstacleContours(body(LOW)), LOW, *walls)
    assert near(contours, 1.95, 0.5, 0.02)
    assert near(contours, 1.80, 0.95, 0.02)
    assert not near(contours, 1.85, 0.85, 0.02)


@CAMERAS
def test_a_table_bars_the_way_of_tall_bodies_only(camera: Camera) -> None:
    table = Box(1.5, 0.0, 0.3, 0.3, 0.35, bottom=0.30)
    low = ObstacleContours(body(camera, height=0.2))
    assert feed(low, camera, table) == ()
    tall = ObstacleContours(body(camera, height=0.5))
    contours = feed(tall, camera, table)
    assert near(contours, 1.2, 0.0, 0.02)
    assert all(one.bottom > 0.25 for one in contours)


@CAMERAS
def test_a_step_down_is_a_hole(camera: Camera) -> None:
    for depth in (-0.05, -0.15):
        pit = Box(1.3, 0.0, 0.3, 0.5, 0.0, bottom=depth)
        contours = feed(ObstacleContours(body(camera)), camera, pits=(pit,))
        (found,) = contours
        assert depth - 0.01 < found.bottom < -0.02
        assert found.top == 0.0
        assert covers(found, 1.15, 0.0)
        assert not near(contours, 0.94, 0.0, 0.02)


@CAMERAS
def test_a_pit_that_returns_nothing_is_a_hole(camera: Camera) -> None:
    pixels = millimetres(camera, depth_of(camera))
    pit = depth_of(camera, pits=(Box(1.0, 0.0, 0.2, 0.2, 0.0, bottom=-0.5),))
    pixels[abs(pit - depth_of(camera)) > 1e-6] = 0
    eyes = ObstacleContours(body(camera))
    for number in range(3):
        eyes.add_depth("front", image(pixels), START, number / 10)
    contours = eyes.contours(START, 0.3)
    assert any(covers(one, 1.0, 0.0) and one.bottom < -0.5 for one in contours)
    assert all(one.confidence <= 0.5 for one in contours)


def test_a_picture_of_nothing_is_refused_and_frees_nothing() -> None:
    eyes = ObstacleContours(body(LOW))
    feed(eyes, LOW, Box(1.0, 0.0, 0.1, 0.1, 0.3))
    nothing = image(np.zeros((240, 320), np.uint16))
    for number in range(10):
        assert eyes.add_depth("front", nothing, START, 0.3 + number / 10)
    assert near(eyes.contours(START, 1.3), 0.9, 0.0)


@pytest.mark.long
@CAMERAS
def test_a_table_top_or_a_wall_is_never_the_floor(camera: Camera) -> None:
    eyes = ObstacleContours(body(camera))
    contours = feed(eyes, camera, Box(5.0, 0.0, 4.8, 5.0, 0.04), pictures=30)
    assert contours
    wall = ObstacleContours(body(camera))
    assert near(feed(wall, camera, Box(0.6, 0.0, 0.1, 3.0, 2.0), pictures=30), 0.5, 0.0, 0.01)


@pytest.mark.long
@CAMERAS
def test_the_floor_does_not_follow_a_ramp(camera: Camera) -> None:
    steps = tuple(Box(0.8 + 0.02 * n, 0.0, 0.01, 3.0, 0.002 * n + 1e-4) for n in range(60))
    contours = feed(ObstacleContours(body(camera)), camera, *steps, pictures=30)  # 5.7 degrees
    assert near(contours, 1.3, 0.0, 0.15)
    assert all(one.top > 0.02 for one in contours)


@pytest.mark.long
@CAMERAS
def test_mounting_errors_make_no_obstacles(camera: Camera) -> None:
    for roll, pitch, z in ((0.5, 0.5, 5), (-0.5, 0.5, -5), (0.5, -0.5, 5), (-0.5, -0.5, -5)):
        mounted = replace(
            camera,
            roll=camera.roll + math.radians(roll),
            pitch=camera.pitch + math.radians(pitch),
            z=camera.z + z / 1000,
        )
        eyes = ObstacleContours(body(camera))
        picture = image(millimetres(camera, depth_of(mounted)))
        for number in range(3):
            eyes.add_depth("front", picture, START, number / 10)
            assert eyes.contours(START, number / 10) == ()


def test_a_body_that_nods_from_picture_to_picture_makes_no_obstacles() -> None:
    sensor = DepthSensor(LOW, 0)
    eyes = ObstacleContours(body(LOW))
    for number in range(12):
        tilt = math.radians(1.0) * (-1 if number % 6 < 3 else 1)
        mounted = replace(sensor.mounted, pitch=sensor.mounted.pitch + tilt)
        eyes.add_depth("front", image(sensor.measure(depth_of(mounted))), START, number / 10)
        assert eyes.contours(START, number / 10) == ()


def test_the_body_itself_is_no_obstacle() -> None:
    camera = replace(HIGH, x=-0.2)
    own = Box(0.0, 0.0, 0.05, 0.1, 0.15)
    assert feed(ObstacleContours(body(camera)), camera, own) == ()


def test_a_camera_that_looks_back_and_lies_on_its_side_sees_the_same() -> None:
    camera = replace(LOW, x=-0.2, z=0.3, yaw=math.pi, roll=math.pi / 2, pitch=0.2)
    contours = feed(ObstacleContours(body(camera)), camera, Box(-1.2, 0.05, 0.1, 0.1, 0.15))
    assert near(contours, -1.1, 0.05, 0.01)
    assert len(contours) == 1


@pytest.mark.long
@pytest.mark.parametrize(("width", "height"), [(640, 480), (848, 480), (1280, 720), (322, 242)])
def test_larger_pictures_show_the_same_and_cost_no_more(width: int, height: int) -> None:
    camera = replace(LOW, width=width, height=height, field_of_view=1.2)
    step = step_of(camera)
    assert width * height / step**2 < 2 * MAX_PIXELS
    eyes = ObstacleContours(body(camera))
    contours = feed(eyes, camera, Box(x=1.0, y=0.2, half_x=0.05, half_y=0.05, top=0.1))
    (box,) = near(contours, 1.0, 0.2)
    corners = np.array(box.polygon)
    assert corners.min(axis=0) == pytest.approx((0.95, 0.15), abs=0.015)
    assert corners[:, 1].max() == pytest.approx(0.25, abs=0.015)
