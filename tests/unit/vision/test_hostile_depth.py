"""Depth and cameras that nobody would send: nothing raises, and all contours are valid."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Camera
from gigabrain_schemas.brain import Contour, WorldModel
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.vision.obstacle_contours import ObstacleContours
from tests.unit.vision.scenes import LOW, START, Box, body, feed, image, near

SMALL = Camera(name="front", depth=True, width=32, height=24, z=0.1)
QUICK = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
UNSEEING = replace(SMALL, z=-0.5, field_of_view=1.0, distortion=(1.0,))  # pixels without a ray
angles = st.floats(-math.pi, math.pi)
poses = st.builds(Pose, x=st.floats(-1e3, 1e3), y=st.floats(-1e3, 1e3), yaw=angles)
cameras = st.builds(
    Camera,
    name=st.just("front"),
    width=st.just(32),
    height=st.just(24),
    depth=st.just(True),
    field_of_view=st.floats(0.1, 3.0),
    distortion=st.lists(st.floats(-100, 100), max_size=8).map(tuple),
    x=st.floats(-1, 1),
    z=st.floats(-0.5, 2.0),
    roll=angles,
    pitch=angles,
    yaw=angles,
)
pictures = st.one_of(
    arrays(np.uint16, (24, 32)),
    st.integers(0, 65535).map(lambda value: np.full((24, 32), value, np.uint16)),
    st.integers(0, 2**32 - 1).map(
        lambda seed: np.random.default_rng(seed).integers(0, 7000, (24, 32)).astype(np.uint16)
    ),
)


def check(contours: tuple[Contour, ...]) -> None:
    """Encode and decode them: what decodes is valid."""
    world = WorldModel(scan_ok=True, obstacle_ahead=False, contours=contours)
    again = msgspec.msgpack.decode(msgspec.msgpack.encode(world), type=WorldModel)
    assert again.contours == contours
    assert all(math.isfinite(x) and math.isfinite(y) for c in contours for x, y in c.polygon)


@pytest.mark.long
@QUICK
@given(st.lists(st.tuples(pictures, poses), min_size=1, max_size=4))
def test_any_picture_makes_valid_contours(seen: list[tuple[np.ndarray, Pose]]) -> None:
    eyes = ObstacleContours(body(SMALL))
    for number, (pixels, pose) in enumerate(seen):
        eyes.add_depth("front", image(pixels), pose, number / 10)
        check(eyes.contours(pose, number / 10))


@pytest.mark.long
@QUICK
@given(cameras, pictures, poses)
@example(UNSEEING, np.ones((24, 32), np.uint16), START)
def test_any_camera_makes_valid_contours(camera: Camera, pixels: np.ndarray, pose: Pose) -> None:
    eyes = ObstacleContours(body(camera))
    for number in range(3):
        eyes.add_depth("front", image(pixels), pose, number / 10)
        check(eyes.contours(pose, number / 10))


@pytest.mark.long
@QUICK
@given(cameras, arrays(np.uint8, (24, 32, 3)), poses)
def test_any_colours_make_valid_contours(camera: Camera, pixels: np.ndarray, pose: Pose) -> None:
    eyes = ObstacleContours(body(camera))
    for number in range(4):
        eyes.add_colour("front", pixels, pose, number / 10)
    check(eyes.contours(pose, 0.4))


@QUICK
@given(st.binary(max_size=200), st.floats(allow_nan=False, allow_infinity=False))
def test_broken_planes_are_refused(plane: bytes, now: float) -> None:
    eyes = ObstacleContours(body(LOW))
    picture = DepthImage(frame_id="front", width=320, height=240, planes=(plane,) * 4)
    assert eyes.add_depth("front", picture, START, now)
    assert eyes.contours(START, now) == ()


@pytest.mark.long
def test_wrong_sizes_and_names_are_refused() -> None:
    eyes = ObstacleContours(body(LOW))
    feed(eyes, LOW, Box(1.0, 0.0, 0.1, 0.1, 0.2))
    small = image(np.full((24, 32), 1000, np.uint16))
    assert "320 x 240" in eyes.add_depth("front", small, START, 0.3)
    assert "back" in eyes.add_depth("back", small, START, 0.3)
    for pixels in (np.zeros((24, 32, 3)), np.zeros((240, 320)), np.zeros((240, 320, 4))):
        assert eyes.add_colour("front", pixels.astype(np.uint8), START, 0.3)
    assert near(eyes.contours(START, 0.3), 0.9, 0.0)


def test_depth_of_a_camera_without_depth_is_refused() -> None:
    eyes = ObstacleContours(body(replace(LOW, depth=False)))
    assert "no depth" in eyes.add_depth("front", image(np.ones((240, 320), np.uint16)), START, 0.0)


@pytest.mark.slow
def test_clutter_is_no_more_than_128_contours() -> None:
    random = np.random.default_rng(0)
    eyes = ObstacleContours(body(LOW))
    for degrees in range(0, 360, 15):
        pose = Pose(x=0.0, y=0.0, yaw=math.radians(degrees))
        posts = np.full((240, 320), 0, np.uint16)
        for column in range(5, 315, 12):
            posts[110:150, column : column + 5] = random.integers(500, 2500)
        for number in range(2):
            assert eyes.add_depth("front", image(posts), pose, degrees + number / 10) == ""
        contours = eyes.contours(pose, degrees + 0.1)
        check(contours)
    assert len(contours) == 128
