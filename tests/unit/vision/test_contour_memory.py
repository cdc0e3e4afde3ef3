"""Memory of contours: kept while out of view, and removed once a camera sees through them."""

import math

import pytest
from msgspec.structs import replace

from gigabrain_drivers.cameras.depth_noise import DepthSensor
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Camera
from gigabrain_zenoh.vision.obstacle_contours import ObstacleContours
from tests.unit.vision.scenes import HIGH, LOW, START, Box, body, depth_of, feed, image, near
from tests.unit.vision.test_obstacle_contours import CAMERAS

WALL = Box(4.0, 0.0, 0.1, 6.0, 2.0)
BOX = Box(1.2, 0.1, 0.08, 0.08, 0.12)


def turned(degrees: float, x: float = 0.0) -> Pose:
    return Pose(x=x, y=0.0, yaw=math.radians(degrees))


@pytest.mark.long
@CAMERAS
@pytest.mark.parametrize(
    "thing",
    [BOX, Box(1.2, 0.1, 0.08, 0.08, 1.8), Box(1.0, 0.0, 0.1, 0.1, 0.4, bottom=0.1)],
    ids=["low", "tall", "hanging"],
)
def test_what_goes_away_is_gone_within_half_a_second(camera: Camera, thing: Box) -> None:
    for seed in range(2):
        sensor = DepthSensor(camera, seed)
        eyes = ObstacleContours(body(camera))
        there, gone = (depth_of(sensor.mounted, boxes) for boxes in ((thing, WALL), (WALL,)))
        for number in range(8):
            eyes.add_depth("front", image(sensor.measure(there)), START, number / 10)
        assert near(eyes.contours(START, 0.7), thing.x, thing.y, 0.15)
        for number in range(8, 13):
            eyes.add_depth("front", image(sensor.measure(gone)), START, number / 10)
        assert not near(eyes.contours(START, 1.2), thing.x, thing.y, 0.3)


def test_what_moved_away_unseen_is_gone_when_it_is_looked_at() -> None:
    eyes = ObstacleContours(body(LOW))
    feed(eyes, LOW, BOX, WALL)
    feed(eyes, LOW, WALL, pose=turned(90), begin=0.3, pictures=10)
    assert near(eyes.contours(START, 1.3), 1.12, 0.1)
    assert not near(feed(eyes, LOW, WALL, begin=1.4, pictures=4), 1.12, 0.1, 0.2)


def test_a_hole_that_is_covered_is_gone() -> None:
    eyes = ObstacleContours(body(HIGH))
    pit = Box(1.3, 0.0, 0.3, 0.5, 0.0, bottom=-0.2)
    assert feed(eyes, HIGH, pits=(pit,))
    assert feed(eyes, HIGH, begin=0.3, pictures=5) == ()


@CAMERAS
def test_what_is_behind_or_below_is_remembered(camera: Camera) -> None:
    low = Box(0.8, 0.0, 0.1, 0.1, 0.05)
    eyes = ObstacleContours(body(camera))
    (before,) = feed(eyes, camera, low)
    behind = feed(eyes, camera, low, pose=turned(180), begin=0.3, pictures=5)
    assert [one.track for one in near(behind, -0.7, 0.0)] == [before.track]
    below = feed(eyes, camera, low, pose=turned(0, x=0.75), begin=0.8, pictures=5)
    assert near(below, 0.0, 0.0, 0.1)
    assert below[0].age == pytest.approx(0.8 + 0.4 - 0.2)
    assert below[0].confidence < before.confidence


def test_what_hides_behind_another_thing_is_kept() -> None:
    eyes = ObstacleContours(body(LOW))
    far = Box(2.0, 0.0, 0.1, 0.1, 0.5)
    feed(eyes, LOW, far)
    contours = feed(eyes, LOW, far, Box(1.0, 0.0, 0.05, 0.3, 0.5), begin=0.3, pictures=10)
    assert near(contours, 1.9, 0.0)
    assert near(contours, 0.95, 0.0)


def test_pictures_without_depth_free_nothing() -> None:
    eyes = ObstacleContours(body(LOW))
    feed(eyes, LOW, BOX)
    open_hall = depth_of(LOW)
    open_hall[open_hall > 1.0] = 0.0
    for number in range(10):
        eyes.add_depth(
            "front", image((1000 * open_hall).astype("uint16")), START, 0.3 + number / 10
        )
    assert near(eyes.contours(START, 1.3), 1.12, 0.1)


def test_it_is_forgotten_when_the_odometry_has_drifted() -> None:
    eyes = ObstacleContours(body(LOW))
    feed(eyes, LOW, BOX)
    for metre in range(1, 7):
        assert near(eyes.contours(Pose(x=-0.5 * (metre % 2), y=0.0, yaw=0.0), 1.0), 1.2, 0.1, 0.7)
    for _ in range(20):
        eyes.contours(turned(0, x=-1.0), 2.0)
        eyes.contours(turned(0, x=0.0), 2.0)
    assert eyes.contours(START, 2.0) == ()


def test_it_is_forgotten_after_two_minutes_or_5_m() -> None:
    eyes = ObstacleContours(body(LOW))
    feed(eyes, LOW, BOX)
    assert eyes.contours(START, 119.0)
    assert eyes.contours(START, 121.0) == ()
    feed(eyes, LOW, BOX, begin=130.0)
    assert eyes.contours(Pose(x=-5.0, y=0.0, yaw=0.0), 131.0) == ()


def test_a_thing_keeps_its_track_while_the_robot_drives() -> None:
    eyes = ObstacleContours(body(LOW))
    post = Box(1.2, 0.0, 0.03, 0.03, 0.3)
    tracks = set()
    for number in range(10):
        pose = turned(2.0 * number, x=0.03 * number)
        contours = feed(eyes, LOW, post, pose=pose, begin=number / 10, pictures=1)
        tracks |= {one.track for one in contours}
    assert tracks == {1}


def test_two_things_have_two_tracks() -> None:
    eyes = ObstacleContours(body(LOW))
    contours = feed(eyes, LOW, BOX, Box(1.2, -0.3, 0.08, 0.08, 0.12))
    assert len({one.track for one in contours}) == 2


def test_a_restart_of_the_odometry_clears_it() -> None:
    eyes = ObstacleContours(body(LOW))
    feed(eyes, LOW, BOX)
    eyes.reset()
    assert eyes.contours(START, 1.0) == ()


def test_a_clock_that_goes_back_makes_no_negative_age() -> None:
    eyes = ObstacleContours(body(LOW))
    feed(eyes, LOW, BOX, begin=100.0)
    (found,) = eyes.contours(START, 5.0)
    assert found.age == 0.0
    assert eyes.contours(START, 126.0) == ()


def test_two_cameras_share_what_they_know() -> None:
    left, right = replace(LOW, name="left", yaw=0.5), replace(LOW, name="right", yaw=-0.5)
    eyes = ObstacleContours(replace(body(left), cameras=(left, right)))
    (one,) = feed(eyes, left, Box(0.9, 0.5, 0.1, 0.1, 0.2))
    both = feed(eyes, right, Box(0.9, -0.5, 0.1, 0.1, 0.2), begin=0.3)
    assert len(both) == 2
    assert one.track in {contour.track for contour in both}
