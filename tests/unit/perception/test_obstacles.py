"""Tracked obstacles: their positions, speeds, sizes and ids."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.brain import Obstacle
from gigabrain_zenoh.perception.obstacle_tracker import MAX_OBSTACLES, ObstacleTracker

Disc = tuple[float, float, float]  # x, y, radius [m]
Wall = tuple[float, float, float, float]  # from x, y to x, y [m]

ROOM: tuple[Wall, ...] = ((-4, -3, 4, -3), (4, -3, 4, 3), (4, 3, -4, 3), (-4, 3, -4, -3))
WIDE = Lidar(beams=360, rate_hz=10, range_min=0.1, range_max=12.0)
JACKAL = Lidar(beams=720, rate_hz=10, range_min=0.1, range_max=30.0, x=0.1)
HERE = Pose(x=0.0, y=0.0, yaw=0.0)


def measured(
    lidar: Lidar, pose: Pose, walls: tuple[Wall, ...], discs: tuple[Disc, ...], fov: float
) -> tuple[Floats, Floats]:
    """Return ranges and angles of the beams in the lidar's frame."""
    angles = np.linspace(-fov / 2, fov / 2, lidar.beams, endpoint=False)
    cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
    x = pose.x + cosine * lidar.x - sine * lidar.y
    y = pose.y + sine * lidar.x + cosine * lidar.y
    ux, uy = np.cos(angles + pose.yaw), np.sin(angles + pose.yaw)
    ranges = np.full(lidar.beams, np.inf)
    for ax, ay, bx, by in walls:
        ex, ey = bx - ax, by - ay
        cross = ux * ey - uy * ex
        with np.errstate(divide="ignore", invalid="ignore"):
            far = ((ax - x) * ey - (ay - y) * ex) / cross
            along = ((ax - x) * uy - (ay - y) * ux) / cross
        hit = (far > 0) & (along >= 0) & (along <= 1)
        ranges = np.where(hit, np.minimum(ranges, far), ranges)
    for cx, cy, radius in discs:
        ahead = (cx - x) * ux + (cy - y) * uy
        square = radius**2 - (cx - x) ** 2 - (cy - y) ** 2 + ahead**2
        near = ahead - np.sqrt(np.maximum(square, 0.0))
        ranges = np.where((square > 0) & (near > 0), np.minimum(ranges, near), ranges)
    return ranges, angles


class Watch:
    """A lidar on a robot, ten scans a second, with noise, and the tracker."""

    def __init__(
        self,
        lidar: Lidar = WIDE,
        walls: tuple[Wall, ...] = ROOM,
        *,
        fov: float = math.tau,
        hz: float = 10.0,
        seed: int = 1,
        noise: float = 0.01,
        lost: float = 0.0,
    ) -> None:
        self.lidar, self.walls, self.fov, self.hz = lidar, walls, fov, hz
        self.noise, self.lost = noise, lost  # [m], share of the beams
        self.tracker, self.tick, self.t = ObstacleTracker(), 0, 0.0
        self._random = np.random.default_rng(seed)

    def scan(
        self, *discs: Disc, pose: Pose = HERE, believed: Pose | None = None
    ) -> tuple[Obstacle, ...]:
        """Add a scan from `pose`; `believed` is a different pose by the odometry."""
        self.tick += round(50 / self.hz)
        self.t = self.tick * 0.02
        ranges, angles = measured(self.lidar, pose, self.walls, discs, self.fov)
        ranges += self.noise * self._random.standard_normal(len(ranges))
        ranges = ranges.astype("f4").astype(float)
        hit = ranges < self.lidar.range_max
        if self.lost:
            hit &= self._random.random(len(ranges)) >= self.lost
        x = self.lidar.x + ranges[hit] * np.cos(angles[hit])
        y = self.lidar.y + ranges[hit] * np.sin(angles[hit])
        spacing = self.fov / self.lidar.beams
        hits = np.column_stack((x, y))
        return self.tracker.update(hits, self.lidar, spacing, believed or pose, 7, self.tick)

    def walk(
        self, path: Callable[[float], tuple[float, float]], scans: int, radius: float = 0.25
    ) -> list[tuple[Obstacle, ...]]:
        """Add scans of a person at `path(t)` by a robot at the origin."""
        return [self.scan((*path(self.t + 1 / self.hz), radius)) for _ in range(scans)]


def nearest(obstacles: tuple[Obstacle, ...], x: float, y: float) -> Obstacle:
    return min(obstacles, key=lambda one: math.hypot(one.x - x, one.y - y))


def speed(one: Obstacle) -> float:
    return math.hypot(one.velocity_x, one.velocity_y)


@pytest.mark.long
@pytest.mark.parametrize("v", [0.5, 1.0])
@pytest.mark.parametrize("distance", [1.0, 2.0])
def test_a_crossing_person_is_tracked_with_the_right_speed(v: float, distance: float) -> None:
    watch = Watch()
    seen = watch.walk(lambda t: (distance, -1.2 + v * t), round(20 / v / 1.0) + 4)
    ids = set()
    for i, obstacles in enumerate(seen):
        if i < 10:
            continue
        t = (i + 1) / 10
        person = nearest(obstacles, distance, -1.2 + v * t)
        ids.add(person.id)
        assert math.hypot(person.velocity_x, person.velocity_y - v) < 0.1
        assert math.hypot(person.x - distance, person.y - (-1.2 + v * t)) < 0.07
        assert person.radius == pytest.approx(0.25, abs=0.05)
    assert len(ids) == 1


def test_an_approaching_person_is_tracked() -> None:
    watch = Watch()
    *_, obstacles = watch.walk(lambda t: (3.5 - 0.8 * t, 0.1), 25)
    person = nearest(obstacles, 1.5, 0.1)
    assert person.velocity_x == pytest.approx(-0.8, abs=0.1)
    assert person.velocity_y == pytest.approx(0.0, abs=0.1)


def test_posts_walls_and_corners_stand() -> None:
    watch = Watch()
    for _ in range(50):
        obstacles = watch.scan((1.5, 0.5, 0.06), (-1.0, 1.0, 0.15))
        assert all(speed(one) < 0.05 for one in obstacles)
    assert len(obstacles) == 2
    assert [round(one.x, 1) for one in obstacles] == [-1.0, 1.5]


def test_walls_do_not_move_while_the_robot_turns_and_drives() -> None:
    pillars: tuple[Wall, ...] = ((1, 1, 1.4, 1), (1.4, 1, 1.4, 1.4), (1.4, 1.4, 1, 1.4))
    door: tuple[Wall, ...] = ((-4, 1, -2, 1), (-1.2, 1, -0.6, 1), (0.3, 1, 1, 1))
    watch = Watch(walls=(*ROOM, *pillars, *door))
    for i in range(120):
        yaw, x = 0.05 * i, -1.0 + 0.02 * i
        obstacles = watch.scan(pose=Pose(x=x, y=-0.5, yaw=yaw))
        assert all(speed(one) < 0.05 for one in obstacles), (i, obstacles)


def box(x: float, y: float, half_x: float, half_y: float) -> tuple[Wall, ...]:
    left, right, low, high = x - half_x, x + half_x, y - half_y, y + half_y
    return (
        (left, low, right, low),
        (right, low, right, high),
        (right, high, left, high),
        (left, high, left, low),
    )


def test_a_thing_that_only_shows_another_side_to_a_passing_robot_stands() -> None:
    things = (*box(0.0, 0.8, 0.35, 0.2), *box(1.2, -0.9, 0.1, 0.4), *box(2.4, 0.9, 0.3, 0.3))
    stub: tuple[Wall, ...] = ((0.6, 3, 0.6, 2.0), (-1.5, -3, -1.5, -1.9))
    watch, told = Watch(walls=(*ROOM, *things, *stub)), 0
    for i in range(150):
        pose = Pose(x=-2.0 + 0.03 * i, y=0.0, yaw=0.3 * math.sin(0.1 * i))
        obstacles = watch.scan(pose=pose)
        told += len(obstacles)
        assert all(speed(one) == 0.0 for one in obstacles), (i, obstacles)
    assert told > 100


def test_motion_is_detected_without_a_wall_behind() -> None:
    for lidar, fov in ((WIDE, math.tau), (JACKAL, math.radians(270))):
        watch = Watch(lidar, (), fov=fov)
        *_, obstacles = watch.walk(lambda t: (2.0, -0.8 + 0.6 * t), 15)
        assert nearest(obstacles, 2.0, 0.1).velocity_y == pytest.approx(0.6, abs=0.1)


def test_a_thing_that_comes_into_view_as_the_robot_turns_stands() -> None:
    watch = Watch(JACKAL, ROOM, fov=math.radians(270))
    for i in range(80):
        pose = Pose(x=0.0, y=0.0, yaw=0.1 * i)
        obstacles = watch.scan((1.5, 0.4, 0.4), (-1.5, 1.0, 0.3), (0.4, -2.0, 0.4), pose=pose)
        assert all(speed(one) == 0.0 for one in obstacles), (i, obstacles)


@pytest.mark.long
@pytest.mark.parametrize("drift", [-0.03, 0.03])
def test_posts_stand_though_the_odometry_of_a_turning_robot_drifts(drift: float) -> None:
    posts = [(1.2 * i + 0.3 * (j % 2), 0.7 * j, 0.08) for i in range(-2, 4) for j in range(-4, 5)]
    watch = Watch(JACKAL, (), fov=math.radians(270), hz=25.0, noise=0.03, lost=0.1)
    told = moving = 0
    for i in range(200):
        yaw, x = 1.2 * math.sin(0.1 * i), -0.6 + 0.005 * i
        believed = Pose(x=(1 + drift) * x, y=0.35, yaw=(1 + drift) * yaw)
        obstacles = watch.scan(*posts, pose=Pose(x=x, y=0.35, yaw=yaw), believed=believed)
        told += len(obstacles)
        moving += sum(speed(one) > 0.0 for one in obstacles)
    assert told > 1000
    assert moving < 0.01 * told


def test_a_wall_is_no_obstacle_but_a_person_in_front_of_it_is() -> None:
    watch = Watch()
    for _ in range(5):
        assert watch.scan() == ()
    for _ in range(5):
        obstacles = watch.scan((2.0, -2.3, 0.25))
    assert len(obstacles) == 1
    assert (obstacles[0].x, obstacles[0].y) == pytest.approx((2.0, -2.3), abs=0.07)


def test_the_wall_beside_a_persons_shadow_does_not_move() -> None:
    watch = Watch()
    seen = watch.walk(lambda t: (1.0, -2.0 + 0.6 * t), 60)
    for i, obstacles in enumerate(seen[10:], 10):
        y = -2.0 + 0.06 * (i + 1)
        others = [one for one in obstacles if math.hypot(one.x - 1.0, one.y - y) > 0.4]
        assert others == []


def test_a_person_hidden_for_three_scans_keeps_id_and_speed() -> None:
    watch = Watch()
    path: Callable[[float], tuple[float, float]] = lambda t: (2.0, -1.0 + 0.8 * t)  # noqa: E731
    *_, before = watch.walk(path, 12)
    person = nearest(before, *path(watch.t))
    for _ in range(3):
        obstacles = watch.scan()
        assert nearest(obstacles, *path(watch.t)).id == person.id
    *_, after = watch.walk(path, 3)
    found = nearest(after, *path(watch.t))
    assert found.id == person.id
    assert math.hypot(found.velocity_x, found.velocity_y - 0.8) < 0.1


def test_a_person_who_walks_behind_a_post_keeps_the_id() -> None:
    watch, ids = Watch(), set()
    for i in range(30):
        y = -1.2 + 0.08 * (i + 1)
        obstacles = watch.scan((1.2, 0.0, 0.08), (2.5, y, 0.25))
        if i >= 10:
            ids.add(nearest(obstacles, 2.5, y).id)
    assert len(ids) == 1


def test_a_person_who_is_gone_is_forgotten_within_half_a_second() -> None:
    watch = Watch()
    *_, obstacles = watch.walk(lambda t: (1.5, 0.0), 8)
    assert len(obstacles) == 1
    told = [len(watch.scan()) for _ in range(6)]
    assert told == [1, 1, 1, 1, 0, 0]


def test_a_hidden_person_is_forgotten_after_a_second() -> None:
    watch = Watch()
    watch.walk(lambda t: (2.5, 0.0), 8)
    screen = [[one.id for one in watch.scan((1.2, 0.0, 0.5))] for _ in range(11)]
    assert all(1 in ids for ids in screen[:9])
    assert 1 not in screen[10]


def test_a_person_who_stops_stands() -> None:
    watch = Watch()
    watch.walk(lambda t: (2.0, min(0.0, -1.0 + 0.7 * t)), 15)
    *_, obstacles = watch.walk(lambda t: (2.0, 0.0), 15)
    assert speed(nearest(obstacles, 2.0, 0.0)) == 0.0


def test_two_people_who_pass_each_other_keep_their_ids() -> None:
    watch = Watch()
    for i in range(26):
        s = -1.3 + 0.1 * (i + 1)
        obstacles = watch.scan((1.2, s, 0.2), (2.6, -s, 0.2))
        if i == 9:
            first = nearest(obstacles, 1.2, s).id, nearest(obstacles, 2.6, -s).id
    assert (nearest(obstacles, 1.2, s).id, nearest(obstacles, 2.6, -s).id) == first
    assert first[0] != first[1]


def test_the_discs_of_dynabarn_are_seen_in_their_size_with_720_beams() -> None:
    watch = Watch(JACKAL, (), fov=math.radians(270), hz=25)
    paths = [(4.0, -2.0, 0.0, 0.9), (6.0, 1.5, -1.5, 0.0), (3.0, 3.0, 0.6, -0.6)]
    for i in range(50):
        t = (i + 1) / 25
        discs = [(x + vx * t, y + vy * t, 0.5) for x, y, vx, vy in paths]
        obstacles = watch.scan(*discs)
    assert len(obstacles) == 3
    for (x, y, radius), (_, _, vx, vy) in zip(discs, paths, strict=True):
        one = nearest(obstacles, x, y)
        assert (one.x, one.y) == pytest.approx((x, y), abs=0.08)
        assert (one.velocity_x, one.velocity_y) == pytest.approx((vx, vy), abs=0.12)
        assert one.radius == pytest.approx(radius, abs=0.06)


def test_noise_of_3_cm_and_lost_beams_break_nothing_into_pieces() -> None:
    watch = Watch(JACKAL, (), fov=math.radians(270), hz=25, noise=0.03, lost=0.1)
    for i in range(50):
        y = -1.0 + 0.04 * (i + 1)
        obstacles = watch.scan((3.0, y, 0.5), (6.0, -y, 0.5))
        if i >= 25:
            assert len(obstacles) == 2
            assert nearest(obstacles, 3.0, y).radius == pytest.approx(0.5, abs=0.06)
            assert speed(nearest(obstacles, 3.0, y)) == pytest.approx(1.0, abs=0.2)


@pytest.mark.long
def test_the_covariance_matches_the_errors() -> None:
    errors = []
    for seed in range(20):
        watch = Watch(seed=seed)
        *_, obstacles = watch.walk(lambda t: (2.0, -1.0 + 0.5 * t), 20)
        person = nearest(obstacles, 2.0, 0.0)
        c = np.array(person.covariance).reshape(4, 4)
        assert np.all(np.linalg.eigvalsh(c) > 0)
        off = np.array([person.x - 2.0, person.y, person.velocity_x, person.velocity_y - 0.5])
        errors.append(float(off @ np.linalg.solve(c, off)))
    assert 0.05 < np.mean(errors) < 8.0  # 4 if speeds changed as much as the filter assumes


def test_a_turning_robot_tracks_a_crossing_person_in_the_odometry_frame() -> None:
    watch = Watch()
    for i in range(20):
        y = -1.0 + 0.06 * (i + 1)
        obstacles = watch.scan((2.0, y, 0.25), pose=Pose(x=0.02 * i, y=0.1, yaw=0.08 * i))
    person = nearest(obstacles, 2.0, y)
    assert (person.x, person.y) == pytest.approx((2.0, y), abs=0.08)
    assert (person.velocity_x, person.velocity_y) == pytest.approx((0.0, 0.6), abs=0.1)


def test_a_restart_of_the_driver_and_a_long_gap_clear_all_tracks() -> None:
    watch = Watch()
    watch.walk(lambda t: (2.0, 0.0), 5)
    hits = np.array([[2.0, 0.05], [1.98, 0.0], [2.0, -0.05]])
    assert watch.tracker.update(hits, WIDE, 0.0175, HERE, 8, 1) == ()
    watch.walk(lambda t: (2.0, 0.0), 5)
    watch.tick += 51
    assert watch.scan((2.0, 0.0, 0.25)) == ()


def test_a_repeated_scan_changes_nothing() -> None:
    watch = Watch()
    *_, obstacles = watch.walk(lambda t: (2.0, 0.2 * t), 8)
    again = watch.tracker.update(np.empty((0, 2)), WIDE, 0.0175, HERE, 7, watch.tick)
    assert again == obstacles


def test_the_nearest_of_very_many_things_are_published() -> None:
    bearings = [math.tau * i / 80 for i in range(80)]
    many = [((2 + a / 10) * math.cos(a), (2 + a / 10) * math.sin(a), 0.04) for a in bearings]
    lidar = Lidar(beams=2880, rate_hz=10, range_min=0.1, range_max=12.0)
    watch = Watch(lidar, ())
    for _ in range(3):
        obstacles = watch.scan(*many)
    assert len(obstacles) == MAX_OBSTACLES
    assert (obstacles[0].x, obstacles[0].y) == pytest.approx((2.0, 0.0), abs=0.05)
