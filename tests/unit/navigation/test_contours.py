"""Contours of cameras in the planners: avoided, removed, and remembered out of sight."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Camera
from gigabrain_schemas.brain import Contour
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.geometry import polygon
from gigabrain_zenoh.navigation.contours import KEPT_TICKS, ContourMemory, covered, placed
from gigabrain_zenoh.navigation.dynamic_obstacles import static_polygons
from gigabrain_zenoh.navigation.local_planner import LocalPlan, PlanRequest
from gigabrain_zenoh.testing.samples import ARMED, WRIST
from tests.unit.navigation.drives import WAFFLE, Drive, wall

NO_POINTS = np.empty((0, 2))
SEEING = replace(WAFFLE, cameras=(Camera(name="front", depth=True, depth_max=5.0),))
ORIGIN = Pose(x=0.0, y=0.0, yaw=0.0)
TABLE = np.array(((0.7, -0.3), (1.0, -0.3), (1.0, 0.25), (0.7, 0.25)))


def box(x: float, y: float, half: float = 0.1) -> Floats:
    """Return the corners of a square (4, 2) [m]."""
    return np.array(
        ((x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half))
    )


class Seen(Drive):
    """A drive among contours that the lidar does not see."""

    def __init__(self, goal: Goal, *contours: Floats) -> None:
        outlines = [
            wall(tuple(a), tuple(b))
            for one in contours
            for a, b in zip(one, np.roll(one, -1, axis=0), strict=True)
        ]
        super().__init__(SEEING, goal, np.concatenate(outlines) if outlines else NO_POINTS)
        self.contours = contours

    def request(self) -> PlanRequest:
        from dataclasses import replace

        return replace(super().request(), hits=NO_POINTS, contours=self.contours)


def kinds(plans: list[LocalPlan]) -> set[str]:
    return {plan.kind for plan in plans}


def test_the_local_planner_avoids_obstacles_that_only_a_camera_sees() -> None:
    drive = Seen(Goal(x=1.8, y=0.0), TABLE)
    assert drive.go(30.0).arrived
    assert drive.least > 0.0
    assert max(abs(pose.y) for pose in drive.poses) > 0.35


@pytest.mark.long
def test_a_removed_contour_has_no_effect_at_once() -> None:
    line = np.array(((0.6, -6.0), (0.65, -6.0), (0.65, 6.0), (0.6, 6.0)))
    drive = Seen(Goal(x=1.5, y=0.0), line)
    drive.go(4.0)
    assert max(pose.x for pose in drive.poses) < 0.6 - 0.075
    drive.contours = ()
    assert drive.go(15.0).arrived


def test_without_contours_plans_are_bit_equal() -> None:
    plain, seen = Drive(WAFFLE, Goal(x=1.0, y=0.3), NO_POINTS), Seen(Goal(x=1.0, y=0.3))
    plain.go(3.0)
    seen.go(3.0)
    assert plain.poses == seen.poses


@pytest.mark.long
@pytest.mark.parametrize("far", [1e5, 1e3, 60.0])
def test_contours_of_extreme_size_are_accepted(far: float) -> None:
    line = np.array(((1.0, -far), (1.02, -far), (1.02, far), (1.0, far)))
    drive = Seen(Goal(x=2.0, y=0.0))
    drive.contours = (line, box(far, far), box(-far, 0.0, 50.0)) * 40
    drive.go(2.0)
    assert max(pose.x for pose in drive.poses) < 1.0 - 0.075


def test_a_body_within_a_contour_can_leave_it() -> None:
    drive = Seen(Goal(x=1.2, y=0.0))
    drive.contours = (box(-0.2, 0.0, 0.15),)  # over its rear
    assert drive.go(15.0).arrived


def test_the_contour_of_a_moving_disc_is_ignored() -> None:
    discs = np.array([[1.0, 0.0, 0.5, 0.0, 0.3, 0.0]])
    person, table = box(1.1, 0.1), box(2.0, 0.0)
    assert static_polygons((person, table), discs) == (table,)
    assert static_polygons((person, table), discs[:0]) == (person, table)


def test_polygons_are_placed_where_the_body_is() -> None:
    one = Contour(polygon=((1.0, 0.0), (2.0, 0.0), (2.0, 1.0)), bottom=0.0, top=0.1)
    (found,) = placed((one,), Pose(x=1.0, y=2.0, yaw=math.pi / 2))
    assert found == pytest.approx(np.array(((1.0, 3.0), (1.0, 4.0), (0.0, 4.0))))


@pytest.mark.parametrize("seed", range(20))
def test_polygons_cover_the_cells_that_each_of_them_covers(seed: int) -> None:
    random, polygons = np.random.default_rng(seed), []
    for _ in range(int(random.integers(1, 8))):
        angles = np.sort(random.uniform(0, math.tau, int(random.integers(3, 9))))
        radii = random.uniform(0.2, 15.0, len(angles))
        corners = np.column_stack((np.cos(angles), np.sin(angles))) * radii[:, None]
        corners += random.uniform(-10, 50, 2)
        polygons.append(corners[:: random.choice((-1, 1))])
    middles = np.stack(np.meshgrid(np.arange(40) + 0.5, np.arange(40) + 0.5), axis=-1)
    away = np.min([polygon.distance(one, middles.reshape(-1, 2)) for one in polygons], axis=0)
    found = covered(polygons, 40).ravel()
    assert found[away == 0.0].all()  # its middle is inside
    assert away[found].max(initial=0.0) <= 0.71  # else an edge crosses it
    near = away <= 0.2
    assert np.count_nonzero(found[near]) >= 0.95 * np.count_nonzero(near)


def test_no_polygons_cover_nothing() -> None:
    assert not covered([], 10).any()


class TestContourMemory:
    """Contours that the global planner remembers."""

    def test_it_covers_the_polygons(self) -> None:
        memory = ContourMemory()
        memory.update(1, ORIGIN, SEEING, (box(2.0, -1.0),))
        assert 16 <= len(memory.points) <= 30
        assert np.abs(memory.points - (2.0, -1.0)).max() < 0.13
        assert memory.version == 1

    def test_what_is_in_view_and_no_contour_any_more_is_gone(self) -> None:
        memory = ContourMemory()
        memory.update(1, ORIGIN, SEEING, (box(3.0, 0.0),))
        memory.update(2, ORIGIN, SEEING, ())
        assert not len(memory.points)
        assert memory.version == 2

    def test_what_is_behind_is_remembered_and_not_for_ever(self) -> None:
        memory = ContourMemory()
        memory.update(1, ORIGIN, SEEING, (box(3.0, 0.0),))
        away = Pose(x=0.0, y=0.0, yaw=math.pi)
        memory.update(2, away, SEEING, ())
        assert len(memory.points)
        assert memory.version == 1
        memory.update(2 + KEPT_TICKS, away, SEEING, ())
        assert not len(memory.points)

    def test_a_camera_on_an_arm_makes_nothing_gone(self) -> None:
        memory = ContourMemory()
        body = replace(ARMED, cameras=(WRIST,))
        memory.update(1, ORIGIN, body, (box(3.0, 0.0),))
        memory.update(2, ORIGIN, body, ())
        assert len(memory.points)

    def test_near_by_perception_knows_better(self) -> None:
        memory = ContourMemory()
        memory.update(1, ORIGIN, SEEING, (box(1.0, 0.0),))
        memory.update(2, Pose(x=0.0, y=0.0, yaw=math.pi), SEEING, ())
        assert not len(memory.points)

    def test_a_restart_forgets_all(self) -> None:
        memory = ContourMemory()
        memory.update(9, ORIGIN, SEEING, (box(3.0, 0.0),))
        memory.forget()
        assert not len(memory.points)
        assert memory.version == 2

    def test_without_contours_it_does_nothing(self) -> None:
        memory = ContourMemory()
        memory.update(9, ORIGIN, SEEING, ())
        assert (memory.version, len(memory.points)) == (0, 0)

    def test_extreme_polygons_are_borne(self) -> None:
        memory = ContourMemory()
        far = np.array(((-1e5, -1e5), (1e5, -1e5), (1e5, 1e5), (-1e5, 1e5)))
        memory.update(1, ORIGIN, SEEING, (far,) * 128)
        assert len(memory.points) <= 20_000
        memory.update(2, Pose(x=1e5, y=-1e5, yaw=0.0), SEEING, (far,))
        assert len(memory.points) <= 20_000
