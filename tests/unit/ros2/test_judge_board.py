"""Board and lidar of the simulated TurtleBot3 in `tests/ros2/programs`."""

import math

import numpy as np
import pytest

from tests.ros2.programs.turtlebot3 import Board, cast, clearance

ROOM = np.array([[-2, -1, 2, -1], [2, -1, 2, 1], [2, 1, -2, 1], [-2, 1, -2, -1]], dtype=float)
NO_WALLS = np.empty((0, 4))


def driven(board: Board, seconds: float, start_s: float = 0.0, heartbeats: bool = True) -> Board:
    for tick in range(round(seconds / 0.01)):
        now_s = start_s + tick * 0.01
        if heartbeats:
            board.beat(now_s)
        board.step(now_s, 0.01)
    return board


def test_rays_hit_the_nearest_wall() -> None:
    angles = np.radians([0, 90, 180, 270, 45])
    ranges = cast(ROOM, 0.5, 0.0, angles, 8.0)
    assert ranges == pytest.approx([1.5, 1.0, 2.5, 1.0, math.sqrt(2)])
    assert np.isinf(cast(ROOM, 0.5, 0.0, angles, 0.9)).all()
    assert np.isinf(cast(NO_WALLS, 0.0, 0.0, angles, 8.0)).all()


def test_clearance_is_to_the_nearest_point_of_a_wall() -> None:
    assert clearance(ROOM, 1.5, 0.2) == pytest.approx(0.5)
    assert clearance(np.array([[3.0, 4.0, 6.0, 8.0]]), 0.0, 0.0) == pytest.approx(5.0)
    assert clearance(NO_WALLS, 0.0, 0.0) == math.inf


def test_a_command_is_kept_until_500_ms_after_the_last_heartbeat() -> None:
    board = Board(NO_WALLS, (0.0, 0.0, 0.0))
    board.command((20, 0))
    driven(board, 3.0)  # it gains 10 cm/s in each 50 ms
    assert board.x_m == pytest.approx(0.2 * 3.0 - 0.01, abs=2e-3)
    before = board.x_m
    driven(board, 2.0, start_s=3.0, heartbeats=False)
    assert board.x_m - before == pytest.approx(0.2 * 0.5 + 0.01, abs=4e-3)
    assert board.speed_mps == 0.0
    driven(board, 1.0, start_s=5.0)  # heartbeats return, but the command is forgotten
    assert board.speed_mps == 0.0


def test_commands_are_limited_as_in_the_firmware() -> None:
    board = Board(NO_WALLS, (0.0, 0.0, 0.0))
    board.command((100, -900))
    driven(board, 1.0)
    assert (board.speed_mps, board.turn_radps) == (0.22, -2.84)


def test_wheels_slip_at_a_wall_and_a_contact_counts_once() -> None:
    board = Board(np.array([[0.5, -1.0, 0.5, 1.0]]), (0.0, 0.0, 0.0))
    board.command((20, 0))
    driven(board, 10.0)
    assert board.x_m == pytest.approx(0.395, abs=3e-3)
    assert board.contacts == 1
    assert board.wheels_rad[0] == pytest.approx((2.0 - 0.01) / 0.033, rel=0.01)
    board.command((-20, 0))
    driven(board, 1.0, start_s=10.0)
    assert board.x_m < 0.25
    assert board.contacts == 1


def test_a_full_turn_ends_where_it_began() -> None:
    board = Board(NO_WALLS, (0.0, 0.0, 0.0))
    board.command((20, 100))
    driven(board, math.tau + 0.2)
    assert math.hypot(board.x_m, board.y_m) < 0.05
