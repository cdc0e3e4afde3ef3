"""gtsam raises, once or always: poses stay right, and mapping continues."""

import math
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import between, compose
from gigabrain_zenoh.mapping import pose_graph
from gigabrain_zenoh.mapping.keyframes import Edge
from gigabrain_zenoh.mapping.pose_graph import Graph
from gigabrain_zenoh.mapping.slam_map import SlamMap
from tests.unit.mapping.houses import HOUSE, PATIENCE_S, Rooms, at, error, grown

COVARIANCE = np.diag((0.05, 0.05, 0.01)) ** 2
SIDE = 10  # keyframes along each side of a square of 1 m steps
LOOP, LATER = 40, 43  # keyframes that see the first ones again

Plan = Callable[[int, str], bool]  # return whether to raise, from the call's number and the solver


class FailingOptimiser:
    """An optimiser that raises like gtsam, by plan."""

    def __init__(self, real: gtsam.ISAM2, solver: str, plan: Plan, calls: list[int]) -> None:
        self._real, self._solver, self._plan, self._calls = real, solver, plan, calls

    def update(self, *args: Any, **how: Any) -> Any:
        self._calls[0] += 1
        if self._plan(self._calls[0], self._solver):
            raise RuntimeError("\nIndeterminate linear system detected near variable\n7.\n")
        return self._real.update(*args, **how)

    def calculateEstimate(self) -> Any:
        return self._real.calculateEstimate()


@pytest.fixture
def fail(monkeypatch: pytest.MonkeyPatch) -> Callable[[Plan], None]:
    real = pose_graph._optimiser

    def planned(plan: Plan) -> None:
        calls = [0]
        monkeypatch.setattr(
            pose_graph, "_optimiser", lambda s: FailingOptimiser(real(s), s, plan, calls)
        )

    return planned


def edge(first: int, second: int, relative: Floats) -> Edge:
    return Edge(first, second, relative, COVARIANCE, doubtful=False)


def square_links() -> list[Edge]:
    """Return links round a square and on; each turns 0.5 degrees too far."""
    step = np.array((1.0, 0.0, math.radians(0.5)))
    corner = np.array((1.0, 0.0, math.radians(90.5)))
    steps = [corner if k % SIDE == 0 else step for k in range(1, LATER + 1)]
    return [edge(0, 0, np.zeros(3)), *(edge(k, k + 1, s) for k, s in enumerate(steps))]


def true_pose(keyframe: int) -> Floats:
    """Return the exact pose (3,) of a keyframe of the square."""
    pose = np.zeros(3)
    for k in range(1, keyframe + 1):
        pose = compose(pose, np.array((1.0, 0.0, 0.0 if k % SIDE else math.pi / 2)))
    return pose


def loop(first: int, second: int) -> Edge:
    return edge(first, second, between(true_pose(first), true_pose(second)))


def build_graph() -> Graph:
    """Add all keyframes one by one, and close each loop at once."""
    graph = Graph()
    for link in square_links():
        graph.extend([link])
        if link.second in (LOOP, LATER):
            settled = graph.close([loop(link.second - LOOP, link.second)])
            while not settled:
                settled = graph.settle()
    return graph


def max_difference(found: Graph, other: Graph) -> float:
    return float(np.abs(found.poses - other.poses).max())


@pytest.mark.parametrize("call", [1, 21, 41, 42, 43, 44, 46, 50], ids=lambda call: f"call {call}")
def test_an_optimiser_that_raises_once_is_rebuilt_and_no_loop_is_lost(
    call: int, fail: Callable[[Plan], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_graph, "MAX_POSES_AT_ONCE", 10)  # loops settle in several pieces
    undisturbed = build_graph()
    fail(lambda number, _: number == call)
    found = build_graph()
    assert found.rebuilt == 1
    assert found.failure == ""
    assert len(found.loops) == 2
    assert max_difference(found, undisturbed) < 0.01


def test_qr_replaces_cholesky_where_that_fails(fail: Callable[[Plan], None]) -> None:
    undisturbed = build_graph()
    fail(lambda number, solver: solver == "CHOLESKY" and number >= 20)
    found = build_graph()
    assert (found.rebuilt, found.failure) == (1, "")
    assert max_difference(found, undisturbed) < 0.01


def test_a_loop_that_no_solver_accepts_is_left_out_and_the_next_one_closes() -> None:
    found = Graph()
    found.extend(square_links())
    before = found.poses.copy()
    assert found.close([edge(0, LOOP, np.array((math.nan, 0.0, 0.0)))])
    assert found.rebuilt == 1
    assert found.loops == []
    assert found.failure == ""
    assert np.abs(found.poses - before).max() < 1e-6
    settled = found.close([loop(0, LOOP)])
    while not settled:
        settled = found.settle()
    assert len(found.loops) == 1
    assert np.abs(found.poses[LOOP] - true_pose(LOOP))[:2].max() < 0.05


@pytest.mark.parametrize("since", [1, 21, 42, 44])
def test_if_every_solver_raises_keyframes_are_added_and_poses_stay(
    since: int, fail: Callable[[Plan], None]
) -> None:
    fail(lambda number, _: number >= since)
    found = build_graph()
    assert found.failure == "Indeterminate linear system detected near variable 7."
    assert found.rebuilt == 1
    assert len(found.poses) == LATER + 1
    assert np.isfinite(found.poses).all()
    led = square_links()[LATER].relative
    assert np.abs(between(found.poses[LATER - 1], found.poses[LATER]) - led).max() < 0.02


@pytest.mark.parametrize("since", [1, 2])
def test_poses_with_known_loops_stay_if_every_solver_raises(
    since: int, fail: Callable[[Plan], None]
) -> None:
    closed = build_graph()
    fail(lambda number, _: number >= since)
    found = Graph()
    found.extend(square_links(), closed.poses)
    assert found.close(closed.loops, known=True)
    assert found.failure
    assert len(found.loops) == 2
    assert max_difference(found, closed) == 0.0


# round the house, twice
TOUR = (
    (1.0, 2.5), (3.0, 3.0), (5.5, 3.0), (6.5, 4.8), (6.5, 1.8), (5.0, 3.0), (3.0, 4.5), (1.2, 3.8),
    (1.0, 2.5), (3.0, 3.0), (5.5, 3.0), (6.5, 4.8), (6.5, 1.8), (5.0, 3.0),
)  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("keyframe", [5, 45])
def test_a_map_still_grows_after_its_optimiser_raised_at_a_keyframe(
    keyframe: int, fail: Callable[[Plan], None]
) -> None:
    fail(lambda number, _: number == keyframe)
    chart, walker = grown(Rooms(HOUSE), *TOUR)
    place = walker.look()
    assert place.localized
    assert error(place, between(at(*TOUR[0]), walker.pose)) < 0.05
    assert chart.report()["loops"] > 0
    assert chart.report()["optimiser_rebuilt"] == 1
    assert chart.problems() == ()


@pytest.mark.long
def test_a_map_whose_optimiser_always_raises_grows_without_loops_and_reports_it(
    fail: Callable[[Plan], None],
) -> None:
    fail(lambda number, _: number >= 45)
    chart, walker = grown(Rooms(HOUSE), *TOUR)
    assert walker.look().localized
    assert [(one.code, one.text) for one in chart.problems()] == [
        (
            "loops_open",
            "loops are no longer closed, as the optimiser fails: "
            "Indeterminate linear system detected near variable 7.",
        )
    ]
    again = SlamMap.thaw(chart.to_save()[1], PATIENCE_S)
    assert len(again.grid().cells) == len(chart.grid().cells)
    assert again.problems() != ()
