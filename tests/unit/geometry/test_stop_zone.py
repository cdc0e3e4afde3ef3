"""Stopping distances match a table that was computed by hand, and the stop zone follows them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gigabrain_schemas.body import BodyDescription, Thresholds
from gigabrain_zenoh.geometry.stopping import Brake, brakes
from gigabrain_zenoh.testing.samples import WAFFLE


def body(reaction_time: float = 0.32) -> BodyDescription:
    """Return a body with 1 m/s² of deceleration and a margin of 0.08 m."""
    thresholds = Thresholds(reaction_time=reaction_time, stop_margin=0.08)
    return replace(WAFFLE, thresholds=thresholds)


def forward(reaction_time: float = 0.32) -> Brake:
    """Return the forward brake of `body`."""
    return brakes(body(reaction_time))["forward"]


@pytest.mark.parametrize(
    ("reaction_time", "distances"),
    [
        (0.20, [0.091, 0.105, 0.121, 0.140, 0.166, 0.305, 0.780]),
        (0.32, [0.097, 0.117, 0.139, 0.164, 0.197, 0.365, 0.900]),
        (1.32, [0.147, 0.217, 0.289, 0.364, 0.457, 0.865, 1.900]),
    ],
)
def test_the_stopping_distance_matches_the_table(
    reaction_time: float, distances: list[float]
) -> None:
    speeds = [0.05, 0.10, 0.15, 0.20, 0.26, 0.50, 1.00]
    found = [forward(reaction_time).distance(speed) for speed in speeds]
    assert found == pytest.approx(distances, abs=0.0006)


def test_the_speed_cap_matches_the_table() -> None:
    free = [0.0, 0.08, 0.10, 0.15, 0.20, 0.30, 0.50, 1.0]
    found = [forward().speed(distance) for distance in free]
    assert found == pytest.approx([0, 0, 0.057, 0.172, 0.265, 0.416, 0.651, 1.07], abs=0.004)


@given(st.floats(0.081, 10.0), st.floats(0.01, 2.0), st.floats(0.1, 5.0))
def test_the_speed_cap_needs_exactly_the_free_distance(
    free: float, reaction_time: float, deceleration: float
) -> None:
    some = replace(body(reaction_time), max_linear_deceleration=deceleration)
    brake = brakes(some)["forward"]
    assert brake.distance(brake.speed(free)) == pytest.approx(free)


@pytest.mark.parametrize(
    ("free", "speed", "stopped", "stays"),
    [
        (0.163, 0.2, False, True),  # L(0.2) = 0.164 m
        (0.165, 0.2, False, False),
        (0.165, 0.2, True, True),
        (0.179, 0.0, True, True),  # L(0) = 0.08 m, plus 0.10 m to resume
        (0.181, 0.0, True, False),
        (0.081, 0.0, False, False),
        (0.079, 0.0, False, True),
        (0.081, -0.2, False, False),  # moving away
        (None, 0.26, True, False),
    ],
)
def test_the_stop_zone_is_the_stopping_distance_plus_a_margin_to_resume(
    free: float | None, speed: float, stopped: bool, stays: bool
) -> None:
    assert forward().in_zone(free, speed, stopped) is stays


def test_a_cap_is_returned_only_if_it_limits_the_body() -> None:
    assert forward().cap(None, stopped=False) is None
    assert forward().cap(0.5, stopped=False) is None  # 0.651 m/s is allowed, above the body's 0.26
    assert forward().cap(0.15, stopped=False) == pytest.approx(0.172, abs=0.001)
    assert forward().cap(0.5, stopped=True) == 0.0


def test_only_a_body_that_can_go_sideways_has_a_brake_for_it() -> None:
    assert sorted(brakes(body())) == ["backward", "forward", "turn_left", "turn_right"]
    omni = replace(body(), max_lateral_speed=0.2)
    assert brakes(omni)["left"] == brakes(omni)["right"] == replace(forward(), fastest=0.2)


def test_turning_brakes_by_angles() -> None:
    turn = brakes(body())["turn_left"]
    assert turn.distance(1.82) == pytest.approx(1.82 * 0.32 + 1.82**2 / 6)
    assert turn.resume == pytest.approx(0.10 / 0.253, abs=0.001)  # 10 cm at the farthest corner


def test_a_body_keeps_its_hash_for_caches_such_as_that_of_its_brakes() -> None:
    assert BodyDescription.__struct_config__.cache_hash
    assert hash(body()) == hash(body()) != hash(body(1.32))
