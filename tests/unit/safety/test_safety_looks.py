"""A lidar without a full circle: free space by past scans, and by the body's own path."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.safety import blind_spots
from gigabrain_zenoh.safety.zones import Motion, ProtectiveField
from gigabrain_zenoh.testing.samples import DRIVING, LIDAR, WAFFLE, scan, state

BEAMS = 271  # 1 degree apart, from -135 to 135 degrees
HALF = math.radians(135)
STEP_S = 0.1
REST = Velocity()
AHEAD, BACK = Velocity(linear_x=0.2), Velocity(linear_x=-0.2)
ROUND = Velocity(angular_z=1.0)
BODY = replace(WAFFLE, lidar=replace(LIDAR, beams=BEAMS))
Post = tuple[float, float, float]  # x, y, radius [m]


def sight(pose: Pose, posts: tuple[Post, ...]) -> NDArray[np.float64]:
    """Ranges (BEAMS,) [m] of a lidar at `pose`; inf where nothing is within 3.5 m."""
    bearings = pose.yaw + np.linspace(-HALF, HALF, BEAMS)
    found = np.full(BEAMS, np.inf)
    for x, y, radius in posts:
        dx, dy = x - pose.x, y - pose.y
        along = dx * np.cos(bearings) + dy * np.sin(bearings)
        across = np.abs(dy * np.cos(bearings) - dx * np.sin(bearings))
        hit = (across <= radius) & (along > 0)
        into = np.sqrt(np.maximum(0.0, radius**2 - across**2))
        found = np.where(hit, np.minimum(found, along - into), found)
    return np.where(found < 3.5, found, np.inf)


class Walker:
    """A body in a room of posts, with 10 scans a second and safety's field."""

    def __init__(self, *posts: Post) -> None:
        self.posts, self.pose, self.tick = posts, Pose(x=0.0, y=0.0, yaw=0.0), 0
        self.field, self.history, self.gate = ProtectiveField(), PoseHistory(), DRIVING
        self.wait(0.2)

    def go(self, seconds: float, moves: Velocity) -> "Walker":
        for _ in range(round(seconds / STEP_S)):
            turned = moves.angular_z * STEP_S
            middle, way = self.pose.yaw + turned / 2, moves.linear_x * STEP_S
            self.pose = Pose(
                x=self.pose.x + way * math.cos(middle),
                y=self.pose.y + way * math.sin(middle),
                yaw=math.remainder(self.pose.yaw + turned, math.tau),
            )
            self.look(moves)
        return self

    def wait(self, seconds: float) -> "Walker":
        return self.go(seconds, REST)

    def look(self, moves: Velocity = REST, seen: LaserScan | None = None) -> None:
        self.tick += round(STEP_S / 0.02)
        now = replace(state(self.tick), pose=self.pose, velocity=moves, gate=self.gate)
        self.history = self.history.then(now)
        motion = Motion(measured=moves, commanded=moves, requested=moves)
        seen = seen or self.scan()
        self.field = self.field.then(BODY, seen, now, self.history, motion)

    def scan(self) -> LaserScan:
        step = 2 * HALF / (BEAMS - 1)
        values = sight(self.pose, self.posts)
        return scan(values, self.tick, angle_min=-HALF, angle_increment=step)

    @property
    def back(self) -> float | None:
        """Return the speed cap backwards [m/s]; None without one."""
        return self.field.caps(BODY).backward

    @property
    def behind(self) -> float | None:
        """Return the free distance behind the body [m]; None without an obstacle."""
        return self.field.free["backward"]


def test_the_body_may_back_along_its_path_but_not_at_first() -> None:
    walker = Walker()
    assert walker.back == 0.0  # not seen yet
    walker.go(3.0, AHEAD)
    assert walker.behind is not None
    assert 0.3 < walker.behind <= 0.36  # PROBE_MAX_M: it may creep, not drive
    assert walker.back is None or walker.back > 0.1


@pytest.mark.long
@pytest.mark.parametrize("speed", [0.03, 0.1, 0.26])
def test_the_body_backs_to_its_start_and_no_farther(speed: float) -> None:
    walker = Walker().go(0.5 / speed, Velocity(linear_x=speed)).wait(0.3)
    for _ in range(600):
        if walker.back == 0.0:
            break
        walker.go(0.1, replace(BACK, linear_x=-speed))
    assert -0.05 <= walker.pose.x <= 0.3  # it stops before unseen space


@pytest.mark.long
def test_the_path_is_forgotten_after_half_a_minute() -> None:
    walker = Walker().go(3.0, AHEAD)
    assert walker.wait(25.0).back != 0.0
    assert walker.wait(6.0).back == 0.0


@pytest.mark.long
def test_turning_to_and_fro_keeps_the_past_views() -> None:
    walker = Walker().go(3.0, AHEAD)
    for _ in range(8):
        walker.go(0.5, ROUND).go(1.0, replace(ROUND, angular_z=-1.0)).go(0.5, ROUND)
    assert walker.wait(0.2).behind == pytest.approx(0.35, abs=0.05)


def test_an_obstacle_seen_later_on_the_path_counts() -> None:
    walker = Walker().go(3.0, AHEAD)
    walker.go(1.6, ROUND)  # now it sees its path, on its right
    walker.posts = ((0.2, 0.0, 0.1),)  # 0.1 m behind the body before the turn
    walker.wait(0.2).go(1.6, replace(ROUND, angular_z=-1.0)).wait(0.2)
    assert walker.pose.yaw == pytest.approx(0.0, abs=1e-6)
    assert not np.isfinite(sight(walker.pose, walker.posts)).any()  # out of sight
    assert walker.back == 0.0


def test_a_jump_of_the_odometry_forgets_the_path() -> None:
    walker = Walker().go(3.0, AHEAD)
    walker.pose = replace(walker.pose, x=walker.pose.x + 0.6)
    assert walker.wait(0.2).back == 0.0


def test_the_path_is_forgotten_while_the_gate_is_not_enabled() -> None:
    walker = Walker().go(3.0, AHEAD)
    walker.gate = GateStatus(mode="stopping")
    walker.wait(0.2)
    walker.gate = DRIVING
    assert walker.wait(0.2).back == 0.0


def test_a_scan_without_a_known_pose_counts_at_the_present_one() -> None:
    walker = Walker()
    walker.history = PoseHistory()
    late = scan(sight(walker.pose, ()), 1, angle_min=-HALF, angle_increment=2 * HALF / 270)
    walker.look(seen=late)
    assert walker.field.past[-1].pose == walker.pose


def test_a_lidar_with_a_full_circle_remembers_no_views() -> None:
    body, now = WAFFLE, replace(state(5), gate=DRIVING)
    motion = Motion(measured=REST, commanded=REST, requested=REST)
    values = np.full(360, 2.0)
    values[100] = 2.5
    seen = scan(values, 5)
    field = ProtectiveField().then(body, seen, now, PoseHistory().then(now), motion)
    assert field.scans == 1
    assert field.past == ()


def past(*scans: tuple[Pose, LaserScan]) -> blind_spots.PastViews:
    """Return views of these scans, and an empty one from the origin."""
    nothing = scan(np.full(2, np.nan), 99, angle_min=0.0, angle_increment=0.01)
    here = Pose(x=0.0, y=0.0, yaw=0.0), nothing
    return tuple(blind_spots.PastView(*view) for view in (*scans, here))


def known(points: list[tuple[float, float]], *scans: tuple[Pose, LaserScan]) -> list[bool]:
    found = blind_spots.known_free(BODY, LIDAR, 0.1, past(*scans), np.array(points))
    return [bool(free) for free in found]


def seen_from(pose: Pose, *posts: Post, clockwise: bool = False) -> tuple[Pose, LaserScan]:
    values, step = sight(pose, posts), 2 * HALF / (BEAMS - 1)
    if clockwise:
        return pose, scan(values[::-1], 1, angle_min=HALF, angle_increment=-step)
    return pose, scan(values, 1, angle_min=-HALF, angle_increment=step)


@pytest.mark.parametrize("clockwise", [False, True])
def test_points_at_or_behind_an_obstacle_are_not_free(clockwise: bool) -> None:
    look = seen_from(Pose(x=-2.0, y=0.0, yaw=0.0), (-0.5, 0.0, 0.1), clockwise=clockwise)
    points = [(-1.0, 0.0), (-0.62, 0.0), (-0.2, 0.0), (-0.2, 1.0), (-2.8, 0.0), (-1.9, 0.05)]
    assert known(points, look) == [
        True,
        False,  # at the post
        False,  # behind it
        True,
        False,  # behind the lidar
        True,  # the body stood there
    ]


@pytest.mark.parametrize("clockwise", [False, True])
def test_left_and_right_are_not_mixed_up(clockwise: bool) -> None:
    look = seen_from(Pose(x=-2.0, y=0.0, yaw=0.0), (-1.0, 0.5, 0.2), clockwise=clockwise)
    assert known([(-1.0, 0.5), (-1.0, -0.5)], look) == [False, True]


def test_the_newest_scan_of_a_place_counts() -> None:
    there = Pose(x=-2.0, y=0.0, yaw=0.0)
    empty, taken = seen_from(there), seen_from(there, (-0.5, 0.0, 0.1))
    away = seen_from(Pose(x=-2.0, y=0.0, yaw=math.pi))  # it looks the other way
    assert known([(-0.6, 0.0)], empty, taken, away) == [False]
    assert known([(-0.6, 0.0)], taken, empty, away) == [True]


def test_beams_on_the_housing_and_unknown_ones_show_no_free_space() -> None:
    pose = Pose(x=-1.0, y=0.0, yaw=0.0)
    step = 2 * HALF / (BEAMS - 1)
    housing = scan(np.full(BEAMS, 0.05), 1, angle_min=-HALF, angle_increment=step)
    assert known([(-0.5, 0.0), (-0.95, 0.0)], (pose, housing)) == [False, True]
    nothing = seen_from(pose)
    cannot_tell = replace(LIDAR, no_return="unknown")
    found = blind_spots.known_free(BODY, cannot_tell, 0.1, past(nothing), np.array([(-0.5, 0.0)]))
    assert known([(-0.5, 0.0)], nothing) == [True]
    assert not found.any()
