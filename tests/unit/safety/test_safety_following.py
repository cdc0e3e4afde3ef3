"""Odometry that does not follow the command: runaway, too slow, stuck or frozen."""

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


def under_way(commanded: Velocity = AHEAD) -> Patrol:
    """Return a body that follows its command at full speed."""
    patrol = Patrol()
    for tick in range(60):
        share = min(1.0, (tick + 1) / 20)
        moves = Velocity(linear_x=commanded.linear_x * share, angular_z=commanded.angular_z * share)
        assert patrol.go(commanded=commanded, moves=moves) == []
    return patrol


@pytest.mark.parametrize("commanded", [AHEAD, TURN, Velocity(linear_x=-0.2, angular_z=0.5)])
def test_a_body_that_follows_has_no_cause(commanded: Velocity) -> None:
    patrol = under_way(commanded)
    assert patrol.go(100, commanded=commanded) == []


@pytest.mark.parametrize("share", [0.8, 1.25])
def test_a_deviation_that_control_can_correct_is_no_cause(share: float) -> None:
    moves = Velocity(linear_x=0.2 * share)
    assert under_way().go(200, commanded=AHEAD, moves=moves) == []


@pytest.mark.parametrize(
    "moves", [Velocity(linear_x=0.06), Velocity(linear_x=-0.06), Velocity(angular_z=0.4)]
)
def test_a_body_that_moves_at_command_zero_runs_away(moves: Velocity) -> None:
    patrol = under_way(REST)
    assert patrol.go(14, moves=moves) == []
    assert patrol.go(moves=moves) == ["runaway"]
    assert patrol.verdict.causes[0].latching


def test_a_body_that_goes_on_when_commanded_to_stop_runs_away() -> None:
    patrol = under_way()
    ticks = patrol.ticks_until("runaway", 60, commanded=REST, moves=AHEAD)
    assert ticks <= 40  # ramp 0.2 s, window 0.3 s, follow_sustain 0.3 s


def test_a_body_that_loses_power_while_driving_does_not_run_away() -> None:
    """Its driver repeats the last values."""
    patrol = under_way()
    assert patrol.go(50, commanded=REST, frozen=True, connected=False, gate=STOPPING) == []
    assert patrol.go(300, commanded=REST, frozen=True, connected=False, gate=IDLE) == []
    assert patrol.go(100, commanded=REST, gate=IDLE) == []


def test_without_a_link_a_body_is_neither_stuck_nor_frozen() -> None:
    patrol = under_way()
    assert patrol.go(300, commanded=AHEAD, frozen=True, connected=False) == []


def test_a_runaway_is_found_although_the_link_comes_and_goes() -> None:
    patrol, received = under_way(REST), 0
    while "runaway" not in patrol.codes:
        connected = patrol.tick % 10 < 5
        received += connected
        patrol.go(moves=AHEAD, connected=connected)
        assert received <= 15
    assert received == 15


def test_a_stuck_wheel_is_found_by_the_turn_of_the_body() -> None:
    moves = Velocity(linear_x=0.1, angular_z=0.7)
    assert under_way().ticks_until("runaway", 20, commanded=AHEAD, moves=moves) == 15


def test_coasting_to_rest_is_no_cause() -> None:
    patrol = under_way()
    for tick in range(20):
        assert (
            patrol.go(commanded=REST, moves=Velocity(linear_x=max(0.0, 0.2 - 0.012 * tick))) == []
        )


def test_a_body_much_slower_than_commanded_is_reported() -> None:
    patrol = under_way()
    assert (
        patrol.ticks_until("not_following", 40, commanded=AHEAD, moves=Velocity(linear_x=0.08))
        == 15
    )
    assert not patrol.verdict.causes[0].latching


def test_a_body_that_does_not_move_at_a_low_command_is_stuck_after_2_s() -> None:
    slowly = Velocity(linear_x=0.06)
    patrol = under_way(slowly)
    assert patrol.ticks_until("stuck", 120, commanded=slowly, moves=Velocity(linear_x=0.001)) == 100


def test_frozen_telemetry_is_found_within_half_a_second() -> None:
    patrol = under_way()
    assert patrol.ticks_until("telemetry_frozen", 30, commanded=AHEAD, frozen=True) == 20


def test_frozen_telemetry_is_frozen_until_a_value_changes() -> None:
    patrol = under_way()
    patrol.ticks_until("telemetry_frozen", 30, commanded=AHEAD, frozen=True)
    assert patrol.go(500, commanded=REST, frozen=True, gate=IDLE) == ["telemetry_frozen"]
    assert patrol.go(commanded=REST, moves=Velocity(linear_x=0.01), gate=IDLE) == []
    assert patrol.go(300, commanded=REST, frozen=True, gate=IDLE) == []


def shaken(tick: int) -> ImuData:
    """Return a sample of a working IMU, different in each tick."""
    return imu(push=0.01 * (tick % 7))


def test_frozen_odometry_is_found_although_the_imu_works() -> None:
    patrol = under_way()
    pose, found = patrol.pose, []
    for tick in range(30):
        patrol.pose = pose
        found.append("telemetry_frozen" in patrol.go(commanded=AHEAD, imu=shaken(tick)))
    assert found.index(True) == 20


def test_a_body_that_is_held_is_stuck_and_not_frozen() -> None:
    patrol = under_way()
    codes = set[str]()
    for tick in range(200):
        codes |= {*patrol.go(commanded=AHEAD, moves=REST, imu=shaken(tick))}
    assert "telemetry_frozen" not in codes
    assert "not_following" in codes


def test_short_moves_with_frozen_telemetry_add_up() -> None:
    patrol, moving = under_way(REST), 0
    while "telemetry_frozen" not in patrol.codes and moving < 100:
        commanded = AHEAD if patrol.tick % 40 < 8 else REST
        patrol.go(commanded=commanded, frozen=True)
        moving += moves(patrol.memory.tracking.commanded)
    assert moving == 20


moments = st.tuples(
    st.integers(min_value=1, max_value=40),  # ticks
    st.sampled_from([REST, AHEAD, TURN, Velocity(linear_x=-0.2)]),
    st.booleans(),  # the commander wants to drive
)


@pytest.mark.long
@given(st.lists(moments, max_size=10))
def test_a_body_with_frozen_telemetry_is_never_commanded_to_move_again(
    moments: list[tuple[int, Velocity, bool]],
) -> None:
    """The gate may be enabled again and again, with any commands."""
    patrol, found, moved = under_way(), 0, 0
    patrol.go(frozen=True, commanded=AHEAD)
    for ticks, commanded, wanted in moments:
        for _ in range(ticks):
            enabled = wanted and patrol.verdict.verdict != "stop"
            patrol.go(commanded=commanded, gate=DRIVING if enabled else IDLE, frozen=True)
            found += found > 0 or "telemetry_frozen" in patrol.codes
            moved += moves(patrol.memory.tracking.commanded)
            assert moved <= 35  # 0.4 s until the cause, and the ramp
            assert found <= 15 or not moves(patrol.memory.tracking.commanded)  # after the ramp


def moves(commanded: Velocity) -> bool:
    return abs(commanded.linear_x) > 0.05 or abs(commanded.angular_z) > 0.3


def test_a_body_at_rest_may_repeat_its_values() -> None:
    assert under_way(REST).go(300, frozen=True) == []


def test_a_person_may_push_an_idle_body() -> None:
    patrol = under_way(REST)
    patrol.go(100, gate=IDLE)
    assert patrol.go(100, gate=IDLE, moves=AHEAD) == []


def test_a_body_that_runs_away_as_the_gate_closes_is_still_found() -> None:
    patrol = under_way()
    ticks = patrol.ticks_until("runaway", 60, commanded=AHEAD, moves=AHEAD, gate=IDLE)
    assert ticks <= 40


def test_safety_that_starts_late_accepts_a_moving_body() -> None:
    class Late(Patrol):
        def _state(self, *args: object) -> RobotState:
            return replace(state(1), velocity=AHEAD)

    assert "runaway" not in Late().go(5, commanded=AHEAD, gate=DRIVING)
