"""Remembered obstacles of depth pictures between which the body moves far."""

import pytest
from msgspec.structs import replace

from gigabrain_drivers.cameras.depth_noise import NO_ERRORS
from gigabrain_schemas.base import Pose
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.safety.cameras import Cameras, Picture
from gigabrain_zenoh.testing.samples import state
from tests.unit.safety.depth_scene import CAMERA, LOW, SEEING, Eye, Scene

PERIOD_TICKS = 25
SLOW = replace(CAMERA, rate_hz=2.0)
FAST = replace(SEEING, cameras=(SLOW,), max_linear_speed=2.0, max_linear_deceleration=3.0)
EMPTY = Scene(room=20.0)
BESIDE = Scene(room=20.0, boxes=((0.95, 1.05, 0.35, 0.45, 0.0, 0.1),))


@pytest.mark.parametrize(("metres", "kept"), [(0.9, True), (1.8, False)])
def test_a_fast_body_remembers_obstacles_that_left_the_picture(metres: float, kept: bool) -> None:
    """It forgets them if the odometry jumps by more than the body can drive."""
    eye, cameras, history = Eye(SLOW, errors=NO_ERRORS), Cameras(), PoseHistory()
    for number, x in enumerate((0.0, metres), 1):
        pose = Pose(x=x, y=0.0, yaw=0.0)
        now = replace(state(number * PERIOD_TICKS), pose=pose)
        history = history.then(now)
        seen = Picture(image=eye.picture(BESIDE if number == 1 else EMPTY, pose, now.tick))
        cameras = cameras.then(FAST, {"front": seen}, now, history)
        if number == 1:
            assert len(cameras.obstacles(pose))
    assert bool(len(cameras.marks.level)) == kept


@pytest.mark.parametrize("missing", ["forgotten", "left out"])
def test_a_picture_with_an_unknown_pose_is_ignored(missing: str) -> None:
    """The camera's process hung for seconds, or safety received no states for a while."""
    ticks = range(1, 180) if missing == "forgotten" else (1, 30)
    history = PoseHistory()
    for tick in ticks:
        now = replace(state(tick), pose=Pose(x=0.0, y=0.0, yaw=0.02 * tick))
        history = history.then(now)
    old = Eye(errors=NO_ERRORS).picture(Scene(boxes=(LOW,)), Pose(x=0.0, y=0.0, yaw=0.0), 15)
    cameras = Cameras().then(SEEING, {"front": Picture(image=old)}, now, history)
    assert not len(cameras.marks.level)
    assert [cause.code for cause in cameras.causes] == ["camera_lost"]


def test_without_marks_there_are_no_obstacles_at_any_pose() -> None:
    assert Cameras().obstacles(Pose(x=1.0, y=2.0, yaw=0.3)).shape == (0, 2)
