"""Occupancy grid: beams free their paths and fill their ends, and old obstacles disappear."""

import numpy as np
import pytest
from numpy.typing import NDArray

from gigabrain_zenoh.mapping import occupancy_grid as grids
from gigabrain_zenoh.mapping.keyframes import Scan, View
from gigabrain_zenoh.mapping.occupancy_grid import LogOddsGrid
from gigabrain_zenoh.mapping.slam_map import SlamMap
from tests.unit.mapping.houses import HOUSE, Rooms, at

NO_POINTS = np.empty((0, 2), np.float32)


def points(*pairs: tuple[float, float]) -> NDArray[np.float32]:
    return np.array(pairs, np.float32).reshape(-1, 2)


def percent(grid: LogOddsGrid, x: float, y: float) -> int:
    column, row = int((x - grid.origin_x) / 0.05), int((y - grid.origin_y) / 0.05)
    return int(grid.percent()[row, column])


def test_a_beam_frees_its_path_and_fills_its_end() -> None:
    grid = LogOddsGrid()
    grid.draw(at(0.025, 0.025), points((1.0, 0.0)), NO_POINTS)
    assert percent(grid, 1.025, 0.025) == 71
    assert [percent(grid, x, 0.025) for x in (0.025, 0.5, 0.976)] == [38, 38, 38]
    assert percent(grid, 1.1, 0.025) == percent(grid, 0.5, 0.1) == -1


def test_a_beam_that_hit_nothing_frees_its_path_and_fills_nothing() -> None:
    grid = LogOddsGrid()
    grid.draw(at(0.025, 0.025), NO_POINTS, points((0.0, 2.0)))
    assert percent(grid, 0.025, 1.976) == 38
    assert grid.percent().max() == 38


def test_in_one_scan_a_hit_overrides_passing_beams_and_counts_once() -> None:
    grid = LogOddsGrid()
    grid.draw(at(0.025, 0.025), points((1.0, 0.0), (1.0, 0.001), (2.0, 0.0)), NO_POINTS)
    assert percent(grid, 1.025, 0.025) == 71
    assert percent(grid, 1.5, 0.025) == 38


def test_a_turned_sensor_draws_where_it_looks() -> None:
    grid = LogOddsGrid()
    grid.draw(at(1.025, 2.025, 90), points((1.0, 0.0)), NO_POINTS)
    assert percent(grid, 1.025, 3.025) == 71


def test_a_grid_grows_to_all_sides_and_keeps_its_cells() -> None:
    grid = LogOddsGrid()
    grid.draw(at(0.025, 0.025), points((1.0, 0.0)), NO_POINTS)
    before = grid.log_odds.shape
    for end in ((-9.0, 0.0), (9.0, 0.0), (0.0, -9.0), (0.0, 9.0)):
        grid.draw(at(0.025, 0.025), points(end), NO_POINTS)
    assert percent(grid, -8.975, 0.025) == percent(grid, 0.025, 9.025) == 71
    assert percent(grid, 1.025, 0.025) == 60  # hit once, passed once
    assert all(now > then for now, then in zip(grid.log_odds.shape, before, strict=True))
    assert all(side % 64 == 0 for side in grid.log_odds.shape)


def test_cells_that_do_not_fit_into_a_message_are_left_out_and_reported() -> None:
    grid = LogOddsGrid()
    grid.draw(at(0, 0), points((1.0, 0.0)), NO_POINTS)
    assert not grid.full
    grid.draw(at(0, 0), points((200.0, 0.0)), NO_POINTS)
    assert grid.full
    assert grid.log_odds.shape == (64, 2800)
    assert percent(grid, 139.0, 0.0) == 38


def test_a_room_longer_than_the_limit_is_drawn_round_the_robot() -> None:
    grid = LogOddsGrid()
    for _ in range(2):
        grid.draw(at(0, 0), points((80.0, 0.0), (-90.0, 0.0), (0.0, 3.0)), NO_POINTS)
    assert grid.full
    assert grid.log_odds.shape == (64, 2800)
    assert grid.origin_x == pytest.approx(-70.0)
    assert percent(grid, 0.025, 3.025) > 70 > 30 > percent(grid, -69.9, -0.025)


def test_near_the_limit_the_grid_still_grows_despite_a_beam_that_is_too_long() -> None:
    grid = LogOddsGrid()
    grid.draw(at(0, 0), points((130.0, 0.0)), NO_POINTS)
    grid.draw(at(125, 0), points((-200.0, 0.0), (6.0, 0.0), (0.0, 5.0)), NO_POINTS)
    assert grid.log_odds.shape == (128, 2800)
    assert percent(grid, 131.025, 0.025) == percent(grid, 125.025, 5.025) == 71
    assert percent(grid, 129.0, 0.025) < 50


def test_cells_that_fit_exactly_are_drawn_and_not_reported() -> None:
    grid = LogOddsGrid()
    grid.draw(at(0.025, 0.025), points((139.95, 0.0)), NO_POINTS)
    assert not grid.full
    assert percent(grid, 139.975, 0.025) == 71


def test_a_passing_person_leaves_no_trace_and_walls_stay() -> None:
    rooms, grid = Rooms(HOUSE), LogOddsGrid()
    for step in range(60):  # a person, 0.4 m wide, crosses the room
        x = 1.0 + 0.04 * step
        person = [(x, 3.2, x, 3.6), (x - 0.2, 3.4, x + 0.2, 3.4)]
        scan = rooms.view(at(2.0, 2.5), person).scan
        grid.draw(at(2.0, 2.5), scan.points, scan.free)
    assert all(percent(grid, 1.0 + 0.1 * k, 3.4) < 40 for k in range(18))
    assert max(percent(grid, x, 2.5) for x in (-0.03, 0.02)) > 90


def test_an_obstacle_disappears_after_eight_scans_without_it() -> None:
    grid = LogOddsGrid()
    for _ in range(100):
        grid.draw(at(0.025, 0.025), points((1.0, 0.0)), NO_POINTS)
    assert percent(grid, 1.025, 0.025) == 97
    history = []
    for _ in range(8):
        grid.draw(at(0.025, 0.025), points((2.0, 0.0)), NO_POINTS)
        history.append(percent(grid, 1.025, 0.025))
    assert history[5] >= 60
    assert history[-1] < 40


def test_a_message_holds_the_origin_of_the_grid() -> None:
    grid = LogOddsGrid()
    grid.draw(at(-2.025, 1.025), points((1.0, 0.0)), NO_POINTS)
    message = grid.message()
    assert (message.resolution, message.width, message.height) == (0.05, 64, 64)
    assert message.origin_x == pytest.approx(-2.05)
    assert message.origin_y == pytest.approx(1.0)
    assert message.cells.count(b"\xff") == 64 * 64 - 21


def test_a_restored_grid_continues_like_the_original() -> None:
    first = LogOddsGrid()
    first.draw(at(0.025, 0.025), points((1.0, 0.0)), NO_POINTS)
    again = LogOddsGrid.of(first.log_odds, first.known(), (first.origin_x, first.origin_y))
    for grid in (first, again):
        grid.draw(at(0.025, 0.025), points((1.5, 0.0)), NO_POINTS)
    assert np.array_equal(first.percent(), again.percent())
    assert grids.MAX_CELLS**2 <= 8 * 1024 * 1024


def test_a_part_equals_the_same_part_of_the_whole_grid() -> None:
    grid = LogOddsGrid()
    grid.draw(at(0.025, 0.025), points((3.0, 0.0), (-3.0, 2.0)), NO_POINTS)
    part, (x, y) = grid.around(2.0, 0.5, 1.0)
    column, row = round((x - grid.origin_x) / 0.05), round((y - grid.origin_y) / 0.05)
    assert part.shape == (40, 40)
    assert np.array_equal(part, grid.percent()[row : row + 40, column : column + 40])
    assert grid.around(500.0, 0.0, 1.0)[0].size == 0


def test_a_map_with_hits_beyond_the_reach_is_drawn_and_continued() -> None:
    hits = np.vstack((Rooms(HOUSE).view(at(2.0, 2.5)).scan.points, points((250.0, 0.0))))
    grown, view = SlamMap(), View(Scan.of(hits), np.zeros(2))
    for _ in range(6):
        grown.step(view, np.zeros(3), np.diag((1e-4, 1e-4, 1e-5)))
    again = SlamMap.thaw(grown.to_save()[1])
    assert 0 < again.grid().width < 2800
    assert grown.problems() == ()
    grown.close()
    again.close()
