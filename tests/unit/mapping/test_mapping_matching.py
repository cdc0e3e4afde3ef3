"""Scans are matched to a map of the same room."""

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import IDENTITY
from gigabrain_zenoh.mapping.keyframes import Scan, from_beams
from gigabrain_zenoh.mapping.local_map import LocalMap, build
from gigabrain_zenoh.mapping.scan_matching import Window, icp, search
from tests.unit.mapping.rooms import Lidar, box

ROOM = np.array([*box(-3, -2, 6, 4), *box(1, 0.5, 0.6, 0.4)])
CORRIDOR = np.array([(-100.0, -1.0, 100.0, -1.0), (-100.0, 1.0, 100.0, 1.0)])
NO_PRIOR = np.zeros((3, 3))


def mapped(lidar: Lidar, walls: Floats) -> LocalMap:
    return build([lidar.scan(walls, IDENTITY)], IDENTITY[None], IDENTITY, 0.05, 0.08)


@pytest.mark.parametrize("beams", [180, 360, 720])
def test_a_displaced_scan_is_matched_to_5_mm_and_a_fifth_of_a_degree(beams: int) -> None:
    lidar, there = Lidar(beams), np.array((0.2, -0.1, np.radians(8)))
    local, scan = mapped(lidar, ROOM), lidar.scan(ROOM, there)
    found = search(local.image, scan.points, IDENTITY, Window(0.35, 0.35))
    assert found.score > 0.8
    assert np.abs(found.pose - there).max() < 0.06
    fit = icp(local.buckets, scan.points, found.pose, 0.3, NO_PRIOR, found.pose)
    assert np.hypot(*(fit.pose - there)[:2]) < 0.005
    assert abs(fit.pose[2] - there[2]) < np.radians(0.2)
    assert fit.inliers > 0.9


def test_a_scan_of_another_room_scores_low() -> None:
    lidar = Lidar(360)
    local = mapped(lidar, ROOM)
    other = lidar.scan(np.array(box(-9, -1.2, 16, 5)), np.array((0.3, 0.2, 0.7)))
    assert search(local.image, other.points, IDENTITY, Window(0.35, 0.35)).score < 0.35


def test_along_an_endless_corridor_only_odometry_decides() -> None:
    lidar = Lidar(360, reach=5.0)
    local = mapped(lidar, CORRIDOR)
    scan, guess = lidar.scan(CORRIDOR, np.array((0.6, 0.05, 0.03))), np.array((0.5, 0.0, 0.0))
    prior = np.diag((100.0, 100.0, 100.0))
    fit = icp(local.buckets, scan.points, guess, 0.3, prior, guess)
    assert fit.pose == pytest.approx((0.5, 0.05, 0.03), abs=0.01)
    along, across = fit.information[0, 0], fit.information[1, 1]
    assert across > 100 * along


@pytest.mark.slow
def test_without_points_nothing_is_found() -> None:
    empty = Scan.of(np.empty((0, 2)))
    local = build([empty], IDENTITY[None], IDENTITY, 0.05, 0.08)
    assert search(local.image, empty.points, IDENTITY, Window(0.3, 0.3)).score == 0.0
    scan = Lidar(180).scan(ROOM, IDENTITY)
    assert search(local.image, scan.points, IDENTITY, Window(0.3, 0.3)).score == 0.0
    assert icp(local.buckets, scan.points, IDENTITY, 0.3, np.eye(3), IDENTITY).inliers == 0.0


def test_normals_are_perpendicular_to_their_walls() -> None:
    scan = Lidar(360, noise=0.0).scan(np.array(box(-2, -2, 4, 4)), IDENTITY)
    ahead = np.abs(scan.points[:, 1]) < 1.5
    right_wall = ahead & (scan.points[:, 0] > 1.9)
    assert right_wall.sum() > 60
    assert np.abs(scan.normals[right_wall]) == pytest.approx(
        np.tile((1.0, 0.0), (right_wall.sum(), 1)), abs=1e-3
    )


def test_beams_become_hits_and_free_ends() -> None:
    angles = np.array((0.0, np.pi / 2, np.pi, -np.pi / 2))
    scan = from_beams(angles, np.array((2.0, np.inf, 0.05, np.nan)), 0.1, 8.0, free_range=3.5)
    assert scan.points == pytest.approx(np.array(((2.0, 0.0),)))
    assert scan.free == pytest.approx(np.array(((0.0, 3.5),)), abs=1e-6)


def test_a_scan_of_the_wrong_length_is_refused() -> None:
    with pytest.raises(ValueError, match=r"expected 360 ranges, got \(359,\)"):
        from_beams(np.zeros(360), np.ones(359), 0.1, 10.0)
    with pytest.raises(ValueError, match=r"points: expected shape \(n, 2\), got \(7, 3\)"):
        Scan.of(np.zeros((7, 3)))
    with pytest.raises(ValueError, match="points: expected finite numbers"):
        Scan.of(np.array(((np.nan, 1.0),)))
