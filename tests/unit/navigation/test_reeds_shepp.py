"""Reeds-Shepp words: they end at their pose, and have the shortest length."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_zenoh.navigation.reeds_shepp import SEGMENTS, along, best_word

places, yaws = st.floats(-6.0, 6.0), st.floats(-math.pi, math.pi)
FAIR = (1.0, 0.0)  # reversing costs no more than driving forwards, changing direction nothing


def word(
    x: float, y: float, yaw: float, prices: tuple[float, float] = FAIR
) -> tuple[float, list[float], list[float]]:
    lengths, turns = np.empty(SEGMENTS), np.empty(SEGMENTS)
    cost = best_word(x, y, yaw, prices, lengths, turns)
    return cost, lengths.tolist(), turns.tolist()


@given(places, places, yaws)
def test_a_word_ends_at_its_pose(x: float, y: float, yaw: float) -> None:
    cost, lengths, turns = word(x, y, yaw)
    pose = (0.0, 0.0, 0.0)
    for turn, length in zip(turns, lengths, strict=True):
        pose = along(*pose, turn, length)
    assert pose[:2] == pytest.approx((x, y), abs=1e-6)
    assert math.remainder(pose[2] - yaw, math.tau) == pytest.approx(0.0, abs=1e-6)
    assert cost == pytest.approx(sum(map(abs, lengths)))


@given(places, places, yaws)
def test_the_way_back_is_as_long(x: float, y: float, yaw: float) -> None:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    back = word(-(x * cosine + y * sine), x * sine - y * cosine, -yaw)
    assert back[0] == pytest.approx(word(x, y, yaw)[0], abs=1e-6)


@pytest.mark.parametrize(
    ("pose", "length"),
    [
        ((3.0, 0.0, 0.0), 3.0),
        ((-2.0, 0.0, 0.0), 2.0),
        ((1.0, 1.0, math.pi / 2), math.pi / 2),
        ((0.0, 0.0, math.pi), math.pi),  # three arcs of a third of a turn
        ((0.0, 2.0, math.pi), math.pi),
    ],
)
def test_the_length_of_known_words(pose: tuple[float, float, float], length: float) -> None:
    assert word(*pose)[0] == pytest.approx(length)


def test_expensive_reversing_gives_a_forward_word() -> None:
    shortest, lengths, _ = word(1.0, 2.0, 3.0)
    assert min(lengths) < 0.0
    _, lengths, _ = word(1.0, 2.0, 3.0, (100.0, 100.0))
    assert min(lengths) >= 0.0
    assert sum(lengths) > shortest + 0.5
