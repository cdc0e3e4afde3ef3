"""Odometry that does not follow the command: runaway, too slow, stuck, frozen."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_schemas.sensors import ImuData
from gigabrain_zenoh.testing.samples import DRIVING, state
from tests.unit.safety.patrol import Patrol, imu

REST, AHEAD, TURN = Velocity(), Velocity(linear_x=0.2), Velocity(angular_z=1.0)
IDLE, STOPPING = GateStatus(mode="idle"), GateStatus(mode="stopping", commander="control")


def under_way(told: Velocity = AHEAD) -> Patrol:
    """A body that follows its command; it was given time to get up to speed."""
    patrol = Patrol()
    for tick in range(60):
        share = min(1.0, (tick + 1) / 20)
        moves = Velocity(linear_x=told.linear_x * share, angular_z=told.angular_z * share)
        assert patrol.go(told=told, moves=moves) == []
    return patrol


@pytest.mark.parametrize("told", [AHEAD, TURN, Velocity(linear_x=-0.2, angular_z=0.5)])
def test_a_body_that_follows_is_left_alone(told: Velocity) -> None:
    patrol = under_way(told)
    assert patrol.go(100, told=told) == []


@pytest.mark.parametrize("share", [0.8, 1.25])
def test_a_body_that_control_can_correct_is_left_alone(share: float) -> None:
    moves = Velocity(linear_x=0.2 * share)
    assert under_way().go(200, told=AHEAD, moves=moves) == []


@pytest.mark.parametrize(
    "moves", [Velocity(linear_x=0.06), Velocity(linear_x=-0.06), Velocity(angular_z=0.4)]
)
def test_what_moves_or_turns_at_command_zero_runs_away(moves: Velocity) -> None:
    patrol = under_way(REST)
    assert patrol.go(14, moves=moves) == []
    assert patrol.go(moves=moves) == ["runaway"]
    assert patrol.verdict.causes[0].latching


def test_a_body_that_goes_on_when_commanded_to_stop_runs_away() -> None:
    patrol = under_way()
    ticks = patrol.ticks_until("runaway", 60, told=REST, moves=AHEAD)
    assert ticks <= 40  # the ramp of 0.2 s, the 0.3 s that explain it, and 0.3 s of patience


def test_a_body_whose_power_went_while_it_drove_does_not_run_away() -> None:
    """Its driver repeats what it heard last."""
    patrol = under_way()
    assert patrol.go(50, told=REST, frozen=True, connected=False, gate=STOPPING) == []
    assert patrol.go(300, told=REST, frozen=True, connected=False, gate=IDLE) == []
    assert patrol.go(100, told=REST, gate=IDLE) == []


def test_what_is_not_heard_says_neither_that_a_body_is_stuck_nor_that_it_is_frozen() -> None:
    patrol = under_way()
    assert patrol.go(300, told=AHEAD, frozen=True, connected=False) == []


def test_a_body_that_runs_away_on_a_line_that_comes_and_goes_is_still_found() -> None:
    patrol, received = under_way(REST), 0
    while "runaway" not in patrol.codes:
        connected = patrol.tick % 10 < 5
        received += connected
        patrol.go(moves=AHEAD, connected=connected)
        assert received <= 15
    assert received == 15


def test_one_wheel_that_is_stuck_turns_the_body_and_is_found() -> None:
    moves = Velocity(linear_x=0.1, angular_z=0.7)
    assert under_way().ticks_until("runaway", 20, told=AHEAD, moves=moves) == 15


def test_a_body_that_coasts_to_rest_as_it_can_is_left_alone() -> None:
    patrol = under_way()
    for tick in range(20):
        assert patrol.go(told=REST, moves=Velocity(linear_x=max(0.0, 0.2 - 0.012 * tick))) == []


def test_a_body_that_is_much_slower_than_commanded_is_found() -> None:
    patrol = under_way()
    assert patrol.ticks_until("not_following", 40, told=AHEAD, moves=Velocity(linear_x=0.08)) == 15
    assert not patrol.verdict.causes[0].latching


def test_a_body_that_creeps_does_not_move_for_two_seconds_and_is_stuck() -> None:
    slowly = Velocity(linear_x=0.06)
    patrol = under_way(slowly)
    assert patrol.ticks_until("stuck", 120, told=slowly, moves=Velocity(linear_x=0.001)) == 100


def test_frozen_telemetry_is_found_within_half_a_second() -> None:
    patrol = under_way()
    assert patrol.ticks_until("telemetry_frozen", 30, told=AHEAD, frozen=True) == 20


def test_frozen_telemetry_is_frozen_until_a_value_changes() -> None:
    patrol = under_way()
    patrol.ticks_until("telemetry_frozen", 30, told=AHEAD, frozen=True)
    assert patrol.go(500, told=REST, frozen=True, gate=IDLE) == ["telemetry_frozen"]
    assert patrol.go(told=REST, moves=Velocity(linear_x=0.01), gate=IDLE) == []
    assert patrol.go(300, told=REST, frozen=True, gate=IDLE) == []


def shaken(tick: int) -> ImuData:
    """The sample of an inertial unit that works."""
    return imu(push=0.01 * (tick % 7))


def test_frozen_odometry_is_found_beside_an_inertial_unit_that_works() -> None:
    patrol = under_way()
    where, found = patrol.pose, []
    for tick in range(30):
        patrol.pose = where
        found.append("telemetry_frozen" in patrol.go(told=AHEAD, imu=shaken(tick)))
    assert found.index(True) == 20


def test_a_body_that_is_held_is_stuck_and_not_frozen() -> None:
    patrol = under_way()
    codes = set[str]()
    for tick in range(200):
        codes |= {*patrol.go(told=AHEAD, moves=REST, imu=shaken(tick))}
    assert "telemetry_frozen" not in codes
    assert "not_following" in codes


def test_short_moves_with_frozen_telemetry_add_up() -> None:
    patrol, moving = under_way(REST), 0
    while "telemetry_frozen" not in patrol.codes and moving < 100:
        told = AHEAD if patrol.tick % 40 < 8 else REST
        patrol.go(told=told, frozen=True)
        moving += moves(patrol.memory.tracking.commanded)
    assert moving == 20


moments = st.tuples(
    st.integers(min_value=1, max_value=40),  # ticks
    st.sampled_from([REST, AHEAD, TURN, Velocity(linear_x=-0.2)]),
    st.booleans(),  # whether the gate lets it through
)


@pytest.mark.long
@given(st.lists(moments, max_size=10))
def test_a_body_whose_telemetry_is_known_to_be_frozen_is_never_told_to_move_again(
    moments: list[tuple[int, Velocity, bool]],
) -> None:
    """Someone, or automatic resume, may enable it again and again, and command what they like."""
    patrol, found, moved = under_way(), 0, 0
    patrol.go(frozen=True, told=AHEAD)
    for ticks, told, wanted in moments:
        for _ in range(ticks):
            enabled = wanted and patrol.verdict.verdict != "stop"
            patrol.go(told=told, gate=DRIVING if enabled else IDLE, frozen=True)
            found += found > 0 or "telemetry_frozen" in patrol.codes
            moved += moves(patrol.memory.tracking.commanded)
            assert moved <= 35  # 0.4 s until it is found, and the ramp
            assert found <= 15 or not moves(patrol.memory.tracking.commanded)  # the ramp is over


def moves(told: Velocity) -> bool:
    return abs(told.linear_x) > 0.05 or abs(told.angular_z) > 0.3


def test_a_body_at_rest_may_repeat_itself() -> None:
    assert under_way(REST).go(300, frozen=True) == []


def test_a_person_may_push_a_body_that_is_off_duty() -> None:
    patrol = under_way(REST)
    patrol.go(100, gate=IDLE)
    assert patrol.go(100, gate=IDLE, moves=AHEAD) == []


def test_a_body_that_runs_away_as_the_gate_closes_is_still_found() -> None:
    patrol = under_way()
    ticks = patrol.ticks_until("runaway", 60, told=AHEAD, moves=AHEAD, gate=IDLE)
    assert ticks <= 40


def test_safety_that_starts_late_takes_a_moving_body_as_it_is() -> None:
    class Late(Patrol):
        def _state(self, *args: object) -> RobotState:
            return replace(state(1), velocity=AHEAD)

    assert "runaway" not in Late().go(5, told=AHEAD, gate=DRIVING)
