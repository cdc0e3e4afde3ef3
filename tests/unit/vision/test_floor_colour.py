"""The floor's boundary by colour: a second source, marked as such."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_zenoh.vision.obstacle_contours import ObstacleContours
from tests.unit.vision.scenes import FAR_M, HIGH, START, Box, body, depth_of, near

FLOOR, THING, SKY = (120, 110, 100), (60, 60, 170), (200, 210, 240)


def picture(*boxes: Box, floor: tuple[int, ...] = FLOOR, seed: int = 0) -> NDArray[np.uint8]:
    """Return a noisy picture of boxes on a floor of one colour."""
    random = np.random.default_rng(seed)
    empty, seen = depth_of(HIGH), depth_of(HIGH, boxes)
    pixels = np.where((empty < FAR_M)[..., None], floor, SKY).astype(float)
    pixels[seen < empty - 1e-6] = THING
    return (pixels + random.normal(0, 3, pixels.shape)).clip(0, 255).astype(np.uint8)


def shown(eyes: ObstacleContours, *boxes: Box, begin: float = 0.0, pictures: int = 4) -> None:
    for number in range(pictures):
        pixels = picture(*boxes, seed=number)
        assert eyes.add_colour("front", pixels, START, begin + number / 10) == ""


@pytest.mark.long
def test_an_even_floor_has_no_contours() -> None:
    eyes = ObstacleContours(body(HIGH))
    shown(eyes, pictures=10)
    assert eyes.contours(START, 1.0) == ()


@pytest.mark.long
def test_the_foot_of_a_thing_is_found_and_marked() -> None:
    eyes = ObstacleContours(body(HIGH))
    shown(eyes, Box(1.5, 0.0, 0.1, 0.2, 0.3))
    contours = eyes.contours(START, 0.4)
    assert near(contours, 1.4, 0.0, 0.03)
    assert not near(contours, 1.3, 0.0, 0.03)
    assert {one.source for one in contours} == {"floor_colour"}
    assert all(one.confidence <= 0.5 for one in contours)


def test_a_camera_that_hangs_upside_down_finds_the_same() -> None:
    box = Box(1.2, 0.3, 0.1, 0.2, 0.3)
    eyes = ObstacleContours(body(replace(HIGH, roll=math.pi)))
    for number in range(4):
        pixels = np.rot90(picture(box, seed=number), 2)
        assert eyes.add_colour("front", pixels, START, number / 10) == ""
    contours = eyes.contours(START, 0.4)
    assert near(contours, 1.1, 0.3, 0.03)
    assert not near(contours, 1.0, 0.3, 0.03)
    shown = np.rot90(picture(seed=9), 2)
    for number in range(5):
        eyes.add_colour("front", shown, START, 0.4 + number / 10)
    assert eyes.contours(START, 0.9) == ()


@pytest.mark.long
def test_it_is_gone_when_floor_is_seen_there() -> None:
    eyes = ObstacleContours(body(HIGH))
    shown(eyes, Box(1.5, 0.0, 0.1, 0.2, 0.3))
    shown(eyes, begin=0.4, pictures=5)
    assert eyes.contours(START, 0.9) == ()


@pytest.mark.long
def test_the_colour_of_a_thing_right_before_it_is_not_learnt() -> None:
    eyes = ObstacleContours(body(HIGH))
    shown(eyes)
    shown(eyes, Box(0.9, 0.0, 0.3, 3.0, 0.3), begin=0.4, pictures=30)
    assert near(eyes.contours(START, 3.4), 0.6, 0.0, 0.05)


def test_without_a_floor_to_learn_from_nothing_is_said() -> None:
    eyes = ObstacleContours(body(HIGH))
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    assert eyes.add_colour("front", noise, START, 0.0)
    assert eyes.contours(START, 0.0) == ()
