"""Places are recognised despite much drift, but not if places look alike."""

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import between, compose
from gigabrain_zenoh.mapping.keyframes import Edge, Keyframe
from gigabrain_zenoh.mapping.loop_closure import PlaceSearch, Trajectory
from gigabrain_zenoh.mapping.pose_graph import Drift, DriftRates
from tests.unit.geometry.test_slam import BLOCK, lap
from tests.unit.mapping.rooms import Lidar, Walls, box, line

HIGH_DRIFT = DriftRates(away=0.2, turn=0.02)


def find_loops(
    walls: Walls,
    poses: Floats,
    estimated: Floats,
    lidar: Lidar,
    first: int,
    rates: DriftRates = HIGH_DRIFT,
) -> list[Edge]:
    """Return loops from keyframe `first` on; `poses` are true, `estimated` are those of the map."""
    drift = Drift(rates)
    search, keyframes, loops = PlaceSearch(drift), list[Keyframe](), list[Edge]()
    travel = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    for k, pose in enumerate(poses):
        scan, before = lidar.scan(walls, pose), max(k - 1, 0)
        link = Edge(before, k, between(estimated[before], estimated[k]), np.eye(3) * 1e-3, False)
        drift.add_link(link)
        keyframes.append(Keyframe(scan.points, scan.free, link, float(travel[k]), 0))
        if k >= first:
            loops += search.find(Trajectory(keyframes, estimated[: k + 1], travel[: k + 1]))
    return loops


@pytest.mark.long
def test_a_place_is_recognised_four_metres_from_the_estimated_pose() -> None:
    once = lap()
    poses = np.concatenate((once, lap()[17:125]))
    drifted = np.arange(len(poses)) >= len(once)
    estimated = np.where(drifted[:, None], compose(np.array((3.5, -2.0, 0.1)), poses), poses)
    loops = find_loops(BLOCK, poses, estimated, Lidar(180, reach=6.0), len(once))
    assert len({loop.second for loop in loops}) >= 3
    for loop in loops:
        true = between(poses[loop.first], poses[loop.second])
        assert loop.relative == pytest.approx(true, abs=0.1)


@pytest.mark.long
def test_a_corridor_of_identical_doors_is_recognised_nowhere() -> None:
    doors: list[tuple[float, ...]] = []
    for k in range(40):
        doors += [*box(2.0 * k, 1.0, 0.9, 0.35), *box(2.0 * k + 0.6, -1.35, 0.9, 0.35)]
    walls = np.array([*doors, (-5, 1.35, 90, 1.35), (-5, -1.35, 90, -1.35)])
    out = line(np.array((15.0, 0.0, 0.0)), np.array((60.0, 0.0, 0.0)), 0.5)
    again = line(np.array((20.0, 0.0, 0.0)), np.array((50.0, 0.0, 0.0)), 0.5)
    poses = np.concatenate((out, again))
    shift = (np.arange(len(poses)) >= len(out))[:, None] * (2.0, 0.0, 0.0)
    assert find_loops(walls, poses, poses + shift, Lidar(180, reach=6.0), len(out)) == []


@pytest.mark.long
def test_a_place_beyond_the_possible_drift_is_not_recognised() -> None:
    once = lap()
    poses = np.concatenate((once, lap()[17:125]))
    second = (np.arange(len(poses)) >= len(once))[:, None]
    estimated = np.where(second, compose(np.array((3.5, -2.0, 0.1)), poses), poses)
    low_drift = DriftRates(away=0.06, turn=0.01)  # 0.4 m over the lap
    assert find_loops(BLOCK, poses, estimated, Lidar(180, reach=6.0), len(once), low_drift) == []
