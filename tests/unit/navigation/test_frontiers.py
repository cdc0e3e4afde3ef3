"""Choice of the next frontier to explore, and the end of exploration."""

import numpy as np
import pytest

from gigabrain_zenoh.navigation.costmap import Costmap, Inflation, costmap
from gigabrain_zenoh.navigation.global_planner import Frontier, frontiers
from gigabrain_zenoh.navigation.grid_search import GridSearch
from tests.unit.navigation.grids import grid_of

HERE = (1.05, 1.05)


def seen(cells: np.ndarray) -> Costmap:
    return costmap(grid_of(cells), Inflation(fits=0.15, turns=0.25))


def room(width: int = 40, height: int = 30) -> np.ndarray:
    """Return a closed room without unknown cells."""
    cells = np.zeros((height, width), np.int8)
    cells[0] = cells[-1] = cells[:, 0] = cells[:, -1] = 100
    return cells


def best_frontier(
    costs: Costmap, robot: tuple[float, float], blacklist: list[tuple[float, float]] | None = None
) -> Frontier | None:
    """Return the frontier with the lowest score, as exploration chooses it."""
    found = frontiers(costs, robot, blacklist or (), GridSearch())
    return min(found, key=lambda frontier: frontier.score, default=None)


def test_a_closed_known_room_has_no_frontier() -> None:
    assert best_frontier(seen(room()), HERE) is None


def test_the_edge_of_known_space_is_the_frontier() -> None:
    cells = room()
    cells[1:-1, 30:-1] = -1
    found = best_frontier(seen(cells), HERE)
    assert found is not None
    assert (found.x, found.y) == pytest.approx((2.95, 1.45), abs=0.06)  # middle of the edge
    assert found.size == pytest.approx(2.6)  # of 2.8 m, less the cells too close to the walls
    assert found.cost == pytest.approx(1.5 + 0.4 * (np.sqrt(2)), abs=0.6)


def test_the_nearer_of_two_equal_frontiers_is_chosen() -> None:
    cells = room(80)
    cells[1:-1, 1:4] = cells[1:-1, -10:-1] = -1
    near = best_frontier(seen(cells), (1.05, 1.45))
    far = best_frontier(seen(cells), (6.55, 1.45))
    assert near is not None
    assert far is not None
    assert (near.x, far.x) == pytest.approx((0.45, 6.95))


def test_a_larger_frontier_is_worth_a_longer_path() -> None:
    cells = room(60)
    cells[1:-1, -6:-1] = -1  # 2.4 m of edge, 3 m away
    cells[10:16, 1:4] = -1  # 0.9 m of edge, 2 m away
    found = best_frontier(seen(cells), (2.35, 1.35))
    assert found is not None
    assert found.x == pytest.approx(5.35)


def test_frontiers_narrower_than_the_body_do_not_count() -> None:
    cells = room()
    cells[10:12, 20] = -1  # 2 x 2 cells of edge about it, 0.3 m is the body
    cells[10, 20] = 0
    cells[20, 30] = -1
    wide = frontiers(seen(cells), HERE, (), GridSearch())
    assert [one.size for one in wide if one.size < 0.3] == []
    cells[11, 20] = cells[20, 30] = 0
    cells[-1, 20:22] = -1  # a slit in the wall
    assert best_frontier(seen(cells), HERE) is None


def test_unreachable_frontiers_do_not_count() -> None:
    cells = room(80)
    cells[:, 40] = 100
    cells[1:-1, 60:-1] = -1
    assert best_frontier(seen(cells), HERE) is None
    cells[10:20, 40] = 0
    assert best_frontier(seen(cells), HERE) is not None


def test_frontiers_behind_unknown_space_do_not_count() -> None:
    cells = room(80)
    cells[1:-1, 40:50] = -1
    found = frontiers(seen(cells), HERE, (), GridSearch())
    assert [one.x for one in found] == pytest.approx([3.95])


def test_blacklisted_frontiers_are_not_returned_again() -> None:
    """Blacklisting one place after another ends the exploration."""
    cells = room()
    cells[1:-1, 30:-1] = -1
    made, given_up = seen(cells), []
    for _ in range(5):
        found = best_frontier(made, HERE, given_up)
        if found is None:
            break
        assert all(np.hypot(found.x - x, found.y - y) > 0.5 for x, y in given_up)
        given_up.append((found.x, found.y))
    assert found is None
    assert 2 <= len(given_up) <= 4


def test_a_blacklisted_place_outside_the_map_has_no_effect() -> None:
    cells = room()
    cells[1:-1, 30:-1] = -1
    made, search = seen(cells), GridSearch()
    anywhere = [(-9.0, -9.0), (99.0, 99.0), (-9.0, 1.0), (1.0, 99.0)]
    assert frontiers(made, HERE, anywhere, search) == frontiers(made, HERE, (), search)


def test_free_space_at_the_rim_of_the_map_is_a_frontier() -> None:
    cells = room()
    cells[:, -1] = 0
    found = best_frontier(seen(cells), HERE)
    assert found is not None
    assert found.x == pytest.approx(3.95)


def test_a_robot_outside_the_map_sees_no_frontier() -> None:
    assert frontiers(seen(room()), (-5.0, 0.0), (), GridSearch()) == []


def test_a_robot_in_unknown_cells_finds_frontiers() -> None:
    """At first, cells within the lidar's minimum range are unknown."""
    cells = room()
    cells[8:13, 8:13] = -1
    cells[1:-1, 30:-1] = -1
    found = best_frontier(seen(cells), HERE, [HERE])
    assert found is not None
    assert found.x == pytest.approx(2.95)
