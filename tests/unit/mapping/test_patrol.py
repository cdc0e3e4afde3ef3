"""A map of a patrol stops growing, stays right, and follows changes."""

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.config.map_image import SavedMap
from gigabrain_zenoh.geometry.se2 import IDENTITY, between
from gigabrain_zenoh.mapping.keyframes import Edge, Keyframe, Scan, View
from gigabrain_zenoh.mapping.occupancy_grid import GridScans
from gigabrain_zenoh.mapping.slam import KnownGround
from gigabrain_zenoh.mapping.slam_map import SlamMap
from tests.unit.mapping.houses import HOUSE, PATIENCE_S, Rooms, Walker, at, box, error

START = (1.0, 2.5)
ROUND = ((3.0, 3.0), (5.5, 3.0), (6.5, 4.8), (6.5, 1.8), (5.0, 3.0), (3.0, 4.5), (1.2, 3.8), START)
FIRST_ROUNDS, LATER_ROUNDS = 3, 3
PILLAR, SHELF = box(2.0, 1.2, 2.4, 1.6), box(4.6, 4.2, 5.2, 4.8)  # old and new place


class Patrol:
    """A robot that drives rounds in the house."""

    def __init__(self) -> None:
        self.chart = SlamMap(PATIENCE_S)
        self.walker = Walker(Rooms(HOUSE), self.chart, at(*START))
        self.walker.look()
        self.errors: list[float] = []
        self.keyframes: list[int] = []  # after each round
        self.sweeps: list[int] = []

    def rounds(self, count: int) -> None:
        for _ in range(count):
            for place in ROUND:
                found = self.walker.go(place)
                self.errors.append(error(found, between(at(*START), self.walker.pose)))
            self.keyframes.append(self.chart.report()["keyframes"])
            self.sweeps.append(self.chart.report()["sweeps"])


@pytest.fixture(scope="module")
def patrol() -> Patrol:
    patrol = Patrol()
    patrol.rounds(FIRST_ROUNDS + LATER_ROUNDS)
    return patrol


@pytest.mark.long
def test_the_same_rounds_again_add_no_keyframes(patrol: Patrol) -> None:
    first = patrol.keyframes[0]
    assert patrol.keyframes[1] > 1.8 * first  # the second round is still mapped
    assert patrol.keyframes[-1] <= patrol.keyframes[FIRST_ROUNDS - 1] + 0.02 * first


def test_only_the_newest_sweeps_of_each_place_stay(patrol: Patrol) -> None:
    assert patrol.sweeps[-1] - patrol.sweeps[-2] < 0.2 * patrol.sweeps[0]


def test_on_known_ground_the_robots_pose_is_right(patrol: Patrol) -> None:
    assert max(patrol.errors[-LATER_ROUNDS * len(ROUND) :]) < 0.04


@pytest.mark.long
def test_a_map_of_known_ground_is_saved_and_continued(patrol: Patrol) -> None:
    _, arrays = patrol.chart.to_save()
    again = SlamMap.thaw(arrays, PATIENCE_S)
    assert again.report()["keyframes"] == patrol.keyframes[-1]
    assert again.report()["sweeps"] == patrol.sweeps[-1]
    frozen = patrol.chart.still().freeze()
    assert SlamMap.thaw(frozen, PATIENCE_S).grid() == patrol.chart.grid()
    walker = Walker(Rooms(HOUSE, seed=3), again, patrol.walker.pose)
    place = walker.look(30)
    assert place.localized
    for goal in ROUND:
        place = walker.go(goal)
        assert error(place, between(at(*START), walker.pose)) < 0.05
    assert again.report()["keyframes"] <= patrol.keyframes[-1] + 0.1 * patrol.keyframes[0]


@pytest.mark.slow
def test_moved_furniture_is_remapped_with_few_keyframes() -> None:
    patrol = Patrol()
    patrol.rounds(FIRST_ROUNDS)
    before = patrol.chart.report()["keyframes"]
    moved = [wall for wall in HOUSE if wall not in PILLAR]
    patrol.walker.rooms = Rooms([*moved, *SHELF], seed=4)
    patrol.rounds(LATER_ROUNDS + 1)
    assert max(patrol.errors) < 0.04
    assert before < patrol.keyframes[-1] < before + patrol.keyframes[0]
    assert patrol.keyframes[-1] - patrol.keyframes[-2] < 0.1 * patrol.keyframes[0]
    saved = patrol.chart.to_save()[0]
    assert occupied(saved, 4.9, 4.2)
    assert not occupied(saved, 2.2, 1.6)


def occupied(saved: SavedMap, x: float, y: float) -> bool:
    """Return whether the map has an obstacle within 0.1 m of (x, y) in the house."""
    place = between(at(*START), at(x, y))
    column, row = (round((v - o) / 0.05) for v, o in
                   zip(place[:2], (saved.origin_x, saved.origin_y), strict=True))  # fmt: skip
    return bool((saved.cells[row - 2 : row + 3, column - 2 : column + 3] > 60).any())


def keyframe(travel: float) -> Keyframe:
    none = np.empty((0, 2), np.float32)
    return Keyframe(none, none, Edge(0, 0, IDENTITY, np.eye(3), False), travel, 0)


def around(travels: list[float], poses: Floats, now: float) -> list[int]:
    ground = KnownGround()
    for travel in travels:
        ground.add(keyframe(travel))
    return ground.keyframes_near(IDENTITY, now, poses, {0})


def test_ground_is_known_after_two_finished_passes() -> None:
    poses = np.array(((0.5, 0.0, 0.0), (0.0, 0.1, 0.0), (0.2, 0.0, 0.0), IDENTITY))
    assert around([0.0, 0.2, 30.0, 60.0], poses, 50.0) == [0, 2]  # the newest of two in one square
    assert around([0.0, 0.2, 11.0, 11.2], poses, 50.0) == []
    assert around([0.0, 0.2, 30.0, 60.0], poses, 41.0) == []
    poses[2:, 0] += 1.0
    assert around([0.0, 0.2, 30.0, 60.0], poses, 50.0) == []


def test_the_newest_three_sweeps_of_a_place_stay() -> None:
    sweeps = GridScans()
    for k in range(6):
        view = View(Scan.of(np.full((30, 2), float(k))), np.zeros(2))
        sweeps.add(view, 0, IDENTITY, np.array((0.05 + 0.15 * (k % 3), 0.1, 0.1)))
    sweeps.add(View(Scan.of(np.full((30, 2), 9.0)), np.zeros(2)), 0, IDENTITY, at(0.0, 0.0, -90))
    assert [one.hits[0, 0] for one in sweeps.all()] == [3.0, 4.0, 5.0, 9.0]
    assert sweeps.seen == 7
