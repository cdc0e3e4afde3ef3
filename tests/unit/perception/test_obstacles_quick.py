"""Quick things that turn, and partly hidden things."""

import math

import numpy as np
import pytest

from gigabrain_schemas.body import Lidar
from gigabrain_schemas.brain import Obstacle
from gigabrain_zenoh.perception.obstacle_detection import discs_of, find_clusters, fit_disc
from tests.unit.perception.test_obstacles import JACKAL, Watch, nearest

RADIUS = 0.5


def rim(begin: float, end: float, count: int) -> np.ndarray:
    """Return points on the rim of a disc of RADIUS at (2.0, 1.0), between two angles [degrees]."""
    angles = np.radians(np.linspace(begin, end, count))
    return np.column_stack((2.0 + RADIUS * np.cos(angles), 1.0 + RADIUS * np.sin(angles)))


def off(one: Obstacle, vx: float, vy: float) -> float:
    return math.hypot(one.velocity_x - vx, one.velocity_y - vy)


def test_a_third_of_a_rim_shows_the_centre() -> None:
    place = fit_disc(rim(150, 270, 20), 2.1, 1.08, RADIUS)
    assert place is not None
    x, y, noise = place
    assert (x, y) == pytest.approx((2.0, 1.0), abs=0.005)
    assert noise < 0.01


def test_a_shorter_arc_gives_a_less_certain_centre() -> None:
    wide, narrow = (fit_disc(rim(210 - a, 210 + a, 20), 2.0, 1.0, RADIUS) for a in (60, 8))
    assert wide is not None
    assert narrow is not None
    assert narrow[2] > 3 * wide[2]


def test_a_wall_and_a_few_hits_are_no_rim() -> None:
    straight = np.column_stack((np.linspace(1.0, 3.0, 60), np.full(60, 1.4)))
    assert fit_disc(straight, 2.0, 1.0, RADIUS) is None
    assert fit_disc(rim(150, 270, 3), 2.0, 1.0, RADIUS) is None


def test_a_reversal_of_a_quick_thing_is_detected_within_a_fifth_of_a_second() -> None:
    watch = Watch(JACKAL, (), hz=25.0)
    turn = 1.2
    seen = watch.walk(lambda t: (3.0, -1.5 + 1.7 * (turn - abs(t - turn))), 36, RADIUS)
    before, after = seen[28], seen[35]  # at 1.16 s and at 1.44 s
    one, other = nearest(before, 3.0, 0.47), nearest(after, 3.0, 0.13)
    assert off(one, 0.0, 1.7) < 0.2
    assert off(other, 0.0, -1.7) < 0.4
    assert other.id == one.id
    assert len([o for o in after if math.hypot(o.velocity_x, o.velocity_y) > 0.3]) == 1


def test_a_partly_hidden_thing_keeps_its_speed_behind_a_post() -> None:
    watch, post = Watch(JACKAL, (), hz=25.0), (1.5, 0.0, 0.2)
    for scan in range(1, 76):
        y = -1.8 + 1.2 * scan / 25
        obstacles = watch.scan(post, (3.0, y, RADIUS))
        if scan > 20:
            one = nearest(obstacles, 3.0, y)
            assert off(one, 0.0, 1.2) < 0.3
            assert math.hypot(one.x - 3.0, one.y - y) < 0.1


def test_a_thing_that_leaves_the_field_of_view_does_not_seem_to_turn() -> None:
    watch = Watch(JACKAL, (), hz=25.0, fov=math.radians(270))
    for scan in range(1, 66):
        x = 1.5 - 1.5 * scan / 25  # past the robot and on behind it
        obstacles = watch.scan((x, 1.4, RADIUS))
        if scan > 20:
            one = nearest(obstacles, x, 1.4)
            assert off(one, -1.5, 0.0) < 0.3
            assert math.hypot(one.x - x, one.y - 1.4) < 0.15


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, math.pi, -math.pi / 2])
def test_the_field_of_view_turns_with_the_lidar(yaw: float) -> None:
    lidar = Lidar(beams=181, rate_hz=10.0, range_min=0.1, range_max=10.0, yaw=yaw)

    def is_whole(bearing: float) -> bool:
        """Return whether both ends of an arc at `bearing` [rad] from the lidar's axis are seen."""
        bearings = yaw + bearing + np.radians(np.arange(-5, 6))
        hits = 2.0 * np.column_stack((np.cos(bearings), np.sin(bearings)))
        (cluster,) = find_clusters(hits, lidar, math.radians(1.0))
        return cluster.whole

    assert is_whole(0.0)
    assert is_whole(math.radians(60))
    assert not is_whole(math.radians(85))  # reaches the last beam
    assert not is_whole(math.radians(-85))


def test_a_half_of_a_rim_is_a_disc_as_large_as_others() -> None:
    half = rim(206, 270, 20)  # seen from the origin: its left half is hidden
    found = discs_of(half, (0.0, 0.0), RADIUS)
    assert len(found) == 1
    assert found[0][:2] == pytest.approx((2.0, 1.0), abs=0.03)
    two = np.vstack((half, half - np.array((0.0, 3.0))))
    assert len(discs_of(two, (0.0, 0.0), RADIUS)) == 2


def test_a_wall_a_hollow_and_a_few_hits_are_no_disc() -> None:
    straight = np.column_stack((np.full(60, 2.0), np.linspace(-1.0, 1.0, 60)))
    assert discs_of(straight, (0.0, 0.0), RADIUS) == []
    assert discs_of(rim(10, 100, 20), (0.0, 0.0), RADIUS) == []
    assert discs_of(rim(206, 270, 7), (0.0, 0.0), RADIUS) == []
    assert discs_of(np.empty((0, 2)), (0.0, 0.0), RADIUS) == []


def test_a_thing_that_was_never_seen_whole_is_tracked_behind_another() -> None:
    watch = Watch(JACKAL, (), hz=25.0)
    for scan in range(1, 41):
        y = -1.4 + 1.2 * scan / 25
        obstacles = watch.scan((2.2, y, RADIUS), (3.3, 1.5 * y + 0.45, RADIUS))
        if scan > 20:
            one = nearest(obstacles, 3.3, 1.5 * y + 0.45)
            assert off(one, 0.0, 1.8) < 0.4
            assert math.hypot(one.x - 3.3, one.y - 1.5 * y - 0.45) < 0.15


@pytest.mark.parametrize(("speed", "known"), [(1.5, True), (0.45, False)])
def test_a_quick_thing_behind_the_robot_is_remembered_for_longer(speed: float, known: bool) -> None:
    watch = Watch(JACKAL, (), hz=25.0, fov=math.radians(270))
    hidden = 2.0 / speed + 1.3  # it is 1.2 m aside and begins 0.6 m ahead
    for _ in range(round(25 * hidden)):
        x = 0.6 - speed * (watch.t + 0.04)
        obstacles = watch.scan((x, 1.2, 0.3))
    near = [one for one in obstacles if math.hypot(one.x - x, one.y - 1.2) < 0.3]
    assert bool(near) is known
