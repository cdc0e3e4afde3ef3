"""AprilTags at known poses, and the same tags found by pupil-apriltags, which is the judge."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_zenoh.vision.camera_model import CameraModel, rotation
from gigabrain_zenoh.vision.tags import TagFinder, cells, quaternion, yaw_of
from tests.unit.vision.tag_scenes import CAMERA, Plate, draw, facing, judge, project

MODEL = CameraModel(CAMERA)
BENT = CameraModel(replace(CAMERA, distortion=(-0.25, 0.08, 0.001, -0.001)))
RATIONAL = CameraModel(
    replace(CAMERA, distortion=(0.49, -2.66, 0.0006, -0.0002, 1.56, 0.37, -2.48, 1.48))
)
TURNED = CameraModel(replace(CAMERA, x=0.2, y=-0.1, z=0.3, roll=0.1, pitch=0.2, yaw=0.5))


def any_plate(rng: np.random.Generator, model: CameraModel, farthest: float = 1.8) -> Plate:
    """A plate in front of a camera, in any turn that can be read."""
    ahead = rng.uniform(0.4, farthest)
    left, up = rng.uniform(-0.25, 0.25) * ahead, rng.uniform(-0.15, 0.15) * ahead
    plate = facing(
        int(rng.integers(587)), 0.16, (0, 0, 0), rng.uniform(-0.9, 0.9), rng.uniform(-0.3, 0.3),
        rng.uniform(-math.pi, math.pi),
    )  # fmt: skip
    there = model.origin + model.rotation @ np.array((ahead, left, up))
    return plate._replace(position=there, axes=model.rotation @ plate.axes)


def axes_of(orientation: tuple[float, float, float, float]) -> np.ndarray:
    x, y, z, w = orientation
    return np.array((
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ))  # fmt: skip


def turned_deg(one: np.ndarray, other: np.ndarray) -> float:
    return math.degrees(math.acos(np.clip((np.trace(one.T @ other) - 1) / 2, -1, 1)))


@pytest.mark.long
@pytest.mark.parametrize("model", [MODEL, BENT, TURNED], ids=["straight", "bent", "turned"])
def test_tags_are_found_where_they_are_within_1_cm_and_2_degrees_by_depth(model):
    rng, finder = np.random.default_rng(3), TagFinder()
    for _ in range(25):
        plate = any_plate(rng, model)
        picture, depth = draw(plate, model, rng)
        (found,) = finder.find(picture, model, depth)
        assert found.id == plate.tag
        assert found.size == 0.16
        assert np.linalg.norm(np.array(found.position) - plate.position) < 0.01
        assert turned_deg(axes_of(found.orientation), plate.axes) < 2


@pytest.mark.long
def test_without_depth_what_is_reported_is_within_3_cm_and_what_is_open_is_left_out():
    rng, finder, told = np.random.default_rng(4), TagFinder(), 0
    for _ in range(40):
        plate = any_plate(rng, MODEL)
        picture, _ = draw(plate, MODEL, rng)
        for found in finder.find(picture, MODEL):
            told += 1
            assert np.linalg.norm(np.array(found.position) - plate.position) < 0.03
            assert turned_deg(axes_of(found.orientation), plate.axes) < 6
    assert told >= 36


def test_the_corners_begin_at_the_lower_left_and_go_counter_clockwise_as_seen():
    plate = facing(7, 0.2, (1.0, 0.0, 0.1), 0.0, 0.0, 0.0)
    picture, depth = draw(plate, MODEL, np.random.default_rng(0))
    (found,) = TagFinder(size=0.2).find(picture, MODEL, depth)
    (left, low), (right, same_low), (same_right, high), (same_left, same_high) = found.corners
    assert left < right
    assert high < low
    assert (same_low, same_right) == pytest.approx((low, right), abs=0.3)
    assert (same_left, same_high) == pytest.approx((left, high), abs=0.3)
    half_px = 0.1 / 0.94 * 320 / 2 / math.tan(1.047 / 2)
    assert (right - left) / 2 == pytest.approx(half_px, abs=0.15)


def test_a_tag_on_a_wall_ahead_looks_back_at_the_robot_with_its_top_up():
    picture, depth = draw(
        facing(3, 0.16, (1.0, 0.0, 0.1), 0.0, 0.0, 0.0), MODEL, np.random.default_rng(0)
    )
    (found,) = TagFinder().find(picture, MODEL, depth)
    assert abs(yaw_of(found.orientation)) == pytest.approx(math.pi, abs=0.03)
    assert axes_of(found.orientation)[:, 2] == pytest.approx([0, 0, 1], abs=0.03)


def test_a_size_may_be_given_for_one_tag():
    picture, depth = draw(
        facing(9, 0.1, (0.8, 0.0, 0.1), 0.2, 0.0, 0.0), MODEL, np.random.default_rng(0)
    )
    (found,) = TagFinder(sizes={9: 0.1}).find(picture, MODEL, depth)
    assert found.size == 0.1
    assert found.position == pytest.approx((0.8, 0.0, 0.1), abs=0.01)


def test_a_tag_aside_is_placed_through_a_rational_lens():
    plate = facing(9, 0.16, (0.96, 0.4, 0.2), 0.2, 0.0, 0.0)
    picture, depth = draw(plate, RATIONAL, np.random.default_rng(0))
    (found,) = TagFinder().find(picture, RATIONAL, depth)
    assert found.position == pytest.approx(tuple(plate.position), abs=0.01)


def test_a_tag_of_less_than_12_pixels_is_left_out():
    near, far = 0.1 * 277 / 16, 0.1 * 277 / 10
    for ahead, count in ((near, 1), (far, 0)):
        plate = facing(5, 0.1, (ahead + 0.06, 0.0, 0.1), 0.0, 0.0, 0.0)
        picture, depth = draw(plate, MODEL, np.random.default_rng(0), noise=1.0)
        assert len(TagFinder(size=0.1).find(picture, MODEL, depth)) == count


def test_the_distance_of_a_far_tag_is_by_depth_though_its_tilt_is_not():
    rng = np.random.default_rng(2)
    for turned in (0.05, 0.15, -0.1):
        plate = facing(5, 0.2, (3.5, 0.2, 0.3), turned, 0.0, 0.0)
        picture, depth = draw(plate, MODEL, rng, noise=2.0)
        for found in TagFinder(size=0.2).find(picture, MODEL, depth):
            assert found.position[0] == pytest.approx(3.5, abs=0.01)
            break
        else:
            pytest.fail("it was left out")


def test_depth_of_something_else_is_not_believed():
    plate = facing(5, 0.16, (0.8, 0.1, 0.1), 0.6, 0.0, 0.0)
    picture, depth = draw(plate, MODEL, np.random.default_rng(0))
    (found,) = TagFinder().find(picture, MODEL, np.full_like(depth, 3000))
    assert found.position == pytest.approx((0.8, 0.1, 0.1), abs=0.01)
    assert TagFinder().find(picture, MODEL, np.zeros_like(depth))


def test_a_picture_without_tags_has_none():
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (240, 320), dtype=np.uint8)
    assert TagFinder().find(noise, MODEL) == ()
    assert TagFinder().find(np.zeros((240, 320), np.uint8), MODEL) == ()


def test_every_family_has_the_tags_that_it_says():
    assert cells(0, "16h5").shape == (6, 6)
    assert not cells(586)[0].any()
    with pytest.raises(ValueError, match="0 to 586"):
        cells(587)


def test_a_quaternion_turns_as_its_matrix():
    rng = np.random.default_rng(0)
    for _ in range(20):
        axes = rotation(*rng.uniform(-3, 3, 3))
        assert turned_deg(axes_of(quaternion(axes)), axes) < 1e-4
    assert quaternion(np.eye(3)) == pytest.approx((0, 0, 0, 1))


@pytest.mark.long
def test_pupil_apriltags_finds_the_same_corners_and_poses():
    detector = judge()
    rng, finder = np.random.default_rng(6), TagFinder()
    fx, fy, cx, cy = MODEL.camera.pinhole
    compared = 0
    for _ in range(60):
        plate = any_plate(rng, MODEL, farthest=1.5)
        picture, depth = draw(plate, MODEL, rng)
        (found,) = finder.find(picture, MODEL, depth)
        (other,) = (
            one
            for one in detector.detect(picture, True, (fx, fy, cx + 0.5, cy + 0.5), 0.16)
            if one.tag_id == found.id
        )
        corners = other.corners - 0.5  # its pixels begin at their edge, ours in their middle
        assert np.abs(corners - np.array(found.corners)).max() < 0.6
        right, down, ahead = other.pose_t.ravel()
        there = MODEL.origin + np.array((ahead, -right, -down))
        assert np.linalg.norm(there - found.position) < 0.02 + 0.01 * ahead
        compared += 1
    assert compared == 60


def test_the_scenes_project_as_the_model_does():
    points = BENT.origin + np.array(((1.0, 0.2, 0.1), (2.0, -0.5, 0.3)))
    rows, columns, _ = BENT.project(points)
    assert np.abs(project(BENT, points) - np.stack((columns, rows), axis=1)).max() < 0.51
