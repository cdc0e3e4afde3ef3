"""A camera that shows nothing new, or nothing at all, is known within half a second."""

from collections.abc import Callable

import numpy as np
import pytest

from gigabrain_schemas.body import Camera
from gigabrain_zenoh.vision.camera_health import CameraHealth

RGBD = Camera(name="front", depth=True)
PLAIN = Camera(name="front")
Exposure = tuple[np.ndarray, np.ndarray | None]


class Room:
    """Exposures of a textured room, 2 m deep, by a camera with noise."""

    def __init__(self, *, depth: bool = True) -> None:
        self.random, self.has_depth = np.random.default_rng(3), depth
        self.scene = self.random.integers(40, 200, (15, 20, 3)).repeat(16, 0).repeat(16, 1)

    def picture(self, scene: np.ndarray | float) -> np.ndarray:
        noisy = scene + self.random.normal(0, 2, (240, 320, 3))
        return np.clip(noisy, 0, 255).astype(np.uint8)

    def depth(self, known: float) -> np.ndarray | None:
        if not self.has_depth:
            return None
        depth = self.random.integers(1990, 2010, (240, 320)).astype(np.uint16)
        depth[:, int(320 * known) :] = 0
        return depth

    def good(self) -> Exposure:
        return self.picture(self.scene), self.depth(0.6)


def known_after_s(
    health: CameraHealth, room: Room, bad: Callable[[int], Exposure | None], name: str
) -> float:
    """Feed 2 s of good exposures at 10 Hz, then bad ones; return when the fault has its name."""
    for number in range(20):
        assert health.take(number / 10, *room.good())
        assert health.problem(number / 10) == ""
    for step in range(1, 101):  # of 10 ms
        now_s = 1.9 + step / 100
        if step % 10 == 0 and (exposure := bad(step // 10)):
            assert not health.take(now_s, *exposure) or name == "repeats pictures"
        if problem := health.problem(now_s):
            assert problem == name
            return now_s - 1.9
    raise AssertionError("it was not noticed")


def bad_exposures(room: Room, name: str) -> Callable[[int], Exposure | None]:
    last, pair = room.good(), [room.good() for _ in range(20)]
    return {
        "frozen": lambda _: last,
        "repeats pictures": lambda number: pair[number // 2],
        "no picture": lambda _: None,
        "covered": lambda _: (room.picture(8.0), room.depth(0.0)),
        "underexposed": lambda _: (room.picture(6.0), room.depth(0.6)),
        "overexposed": lambda _: (room.picture(300.0), room.depth(0.6)),
    }[name]


FAULTS = ["frozen", "repeats pictures", "no picture", "covered", "underexposed", "overexposed"]


@pytest.mark.long
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_a_depth_camera_is_named_within_half_a_second(name: str) -> None:
    room, health = Room(), CameraHealth(RGBD)
    bad = bad_exposures(room, name)
    if name == "frozen":  # the last good exposure is the first of those that stay
        frozen = room.good()
        assert health.take(-0.1, *frozen)
        bad = lambda _: frozen  # noqa: E731
    assert known_after_s(health, room, bad, name) <= 0.5


@pytest.mark.parametrize(
    ("grey", "name"), [(6.0, "covered, or in the dark"), (120.0, "covered"), (300.0, "overexposed")]
)
def test_a_camera_without_depth_is_judged_by_its_picture(grey: float, name: str) -> None:
    room, health = Room(depth=False), CameraHealth(PLAIN)
    after_s = known_after_s(health, room, lambda _: (room.picture(grey), None), name)
    assert after_s <= 0.5


def test_a_hand_in_daylight_covers_a_depth_camera() -> None:
    room, health = Room(), CameraHealth(RGBD)
    skin = lambda _: (room.picture(90.0), room.depth(0.0))  # noqa: E731
    assert known_after_s(health, room, skin, "covered") <= 0.5


def test_a_wall_that_the_robot_comes_too_near_to_is_no_cover() -> None:
    """All depth is gone, but it went slowly."""
    room, health = Room(), CameraHealth(RGBD)
    for number in range(60):
        known = max(0.0, 0.6 - number / 40)
        health.take(number / 10, room.picture(120.0), room.depth(known))
        assert health.problem(number / 10) == ""


def test_one_bad_exposure_is_dropped_and_is_no_fault_yet() -> None:
    room, health = Room(), CameraHealth(RGBD)
    for number in range(40):
        bad = number % 10 == 5
        exposure = (room.picture(300.0), room.depth(0.6)) if bad else room.good()
        assert health.take(number / 10, *exposure) is not bad
        assert health.problem(number / 10) == ""


def test_a_camera_that_sees_again_is_believed_after_a_clean_window() -> None:
    room, health = Room(), CameraHealth(RGBD)
    problems = []
    for number in range(30):
        dark = 10 <= number < 15
        health.take(number / 10, *((room.picture(6.0), room.depth(0.6)) if dark else room.good()))
        problems.append(health.problem(number / 10))
    assert problems[:11] == [""] * 11
    assert set(problems[11:19]) == {"underexposed"}
    assert problems[19:] == [""] * 11


def test_a_cover_that_goes_is_gone() -> None:
    room, health = Room(), CameraHealth(RGBD)
    for number in range(20):
        health.take(number / 10, *room.good())
    for number in range(20, 40):
        health.take(number / 10, room.picture(90.0), room.depth(0.0))
    assert health.problem(3.9) == "covered"
    for number in range(40, 46):
        health.take(number / 10, *room.good())
    assert health.problem(4.5) == ""


def test_compressed_streams_may_repeat_a_still_scene() -> None:
    room, health = Room(depth=False), CameraHealth(PLAIN, repeats=True)
    still = room.good()
    for number in range(20):
        assert health.take(number / 10, *still)
        assert health.problem(number / 10) == ""


def test_a_slow_camera_has_two_and_a_half_periods() -> None:
    room, health = Room(), CameraHealth(Camera(name="slow", rate_hz=2.0, depth=True))
    health.take(0.0, *room.good())
    assert health.problem(1.2) == ""
    assert health.problem(1.3) == "no picture"


def test_a_camera_that_never_sends_is_silent_from_the_first_question_on() -> None:
    health = CameraHealth(RGBD)
    assert health.problem(100.0) == ""
    assert health.problem(100.5) == "no picture"


def test_a_picture_of_a_few_pixels_can_be_judged() -> None:
    health = CameraHealth(Camera(name="tiny", width=16, height=16))
    picture = np.random.default_rng(0).integers(0, 255, (16, 16), np.uint8)
    assert health.take(0.0, picture, None) in (True, False)


@pytest.mark.long
@pytest.mark.parametrize("name", FAULTS)
def test_only_silence_is_a_fault_of_a_camera_on_an_arm(name: str) -> None:
    """A still arm gives still pictures, and what the gripper holds may cover the lens."""
    room = Room(depth=False)
    health, bad = CameraHealth(Camera(name="wrist", link="hand")), bad_exposures(room, name)
    for number in range(20):
        if exposure := bad(number):
            assert health.take(number / 10, *exposure)
    assert health.problem(1.9) == ""
    assert health.problem(2.5) == "no picture"
