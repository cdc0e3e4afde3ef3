"""Poses of a scan are implausible if its beams would have passed through walls."""

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import IDENTITY, between
from gigabrain_zenoh.mapping.keyframes import Scan, seen_through
from gigabrain_zenoh.mapping.slam import Slam
from tests.unit.mapping.rooms import Lidar, box, drifting, line

ROOM = np.array([*box(-3, -2, 6, 4), *box(1, 0.5, 0.6, 0.4)])
# a corridor with doors and pillars at irregular distances
CORRIDOR = np.array(
    [
        (-30.0, -1.0, 8.0, -1.0), (-30.0, 1.0, 8.0, 1.0), (8.0, -1.0, 8.0, 1.0),
        (-30.0, -1.0, -30.0, 1.0),
        *box(2.3, -1, 0.3, 0.3), *box(-1.2, 0.75, 0.4, 0.25), *box(-5.5, -1, 0.2, 0.4),
        *box(-8.1, 0.8, 0.6, 0.2), *box(-12.4, -1, 0.5, 0.3), *box(-13.9, 0.7, 0.2, 0.3),
        *box(-18.8, -1, 0.3, 0.5), *box(-23.3, 0.75, 0.4, 0.25),
    ]
)  # fmt: skip


def scan(walls: Floats, pose: Floats) -> Scan:
    return Lidar(180, reach=6.0).scan(walls, pose)


def test_a_scan_at_its_true_pose_passes_through_no_walls() -> None:
    shown, there = scan(ROOM, IDENTITY).points, np.array((0.4, -0.5, 0.6))
    assert seen_through(shown, scan(ROOM, there).points, there) == pytest.approx(0.0, abs=0.02)


@pytest.mark.long
def test_a_scan_passes_through_the_walls_of_a_smaller_room() -> None:
    shown = scan(np.array(box(-1.5, -1.5, 3, 3)), IDENTITY).points
    assert seen_through(shown, scan(ROOM, IDENTITY).points, IDENTITY) > 0.5


def test_points_behind_a_wall_are_not_in_view() -> None:
    shown = scan(ROOM, IDENTITY).points
    near = scan(np.array(box(-1.5, -1.5, 3, 3)), IDENTITY).points
    assert np.isnan(seen_through(shown, near, IDENTITY))


def test_without_points_there_is_no_result() -> None:
    nothing = np.empty((0, 2), np.float32)
    assert np.isnan(seen_through(nothing, scan(ROOM, IDENTITY).points, IDENTITY))
    assert np.isnan(seen_through(scan(ROOM, IDENTITY).points, nothing, IDENTITY))


@pytest.mark.long
def test_a_robot_that_reverses_along_a_corridor_does_not_slip_back_over_known_parts() -> None:
    """Half of each scan is new then, and the best match is too far ahead."""
    poses = line(np.array((5.0, 0.0, 0.0)), np.array((-25.0, 0.1, 0.0)), 1.0)
    steps = np.concatenate((IDENTITY[None], drifting(poses, turn=0.01, scale=1.04)))
    off = []
    for seed in range(1, 4):
        lidar = Lidar(180, reach=6.0, seed=seed)
        lidar.angles = np.radians(np.arange(-90.0, 90.0))  # it faces ahead only
        slam = Slam(poses[0])
        for pose, step in zip(poses, steps, strict=True):
            estimate = slam.add(lidar.scan(CORRIDOR, pose), step)
        off.append(np.hypot(*between(poses[-1], estimate.pose)[:2]))
    assert max(off) < 1.5  # 5 % of the way, along which most places look similar
