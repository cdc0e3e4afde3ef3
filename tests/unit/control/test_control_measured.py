"""Control by what the body really did: gaps, other wheels, and nothing that winds up."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.control.node import ControlInputs, ControlMemory, step
from gigabrain_zenoh.testing.samples import DRIVING, WAFFLE, state
from tests.unit.control.straight import SHUT, Drive, want


@pytest.mark.parametrize(("passed", "step_up"), [(1, 0.02), (2, 0.04), (5, 0.1), (50, 0.1)])
def test_after_a_gap_the_ramp_goes_on_but_does_not_jump(passed: int, step_up: float) -> None:
    drive = Drive()
    drive.speeds(2, want(0.2))
    before = drive.memory.setpoint.linear_x
    after = drive.go(want(0.2), ticks_passed=passed).linear_x
    assert after - before == pytest.approx(step_up)


@pytest.mark.parametrize("gain", [0.9, 1.1])
@pytest.mark.parametrize("asked", [0.2, -0.2, 0.1])
def test_a_body_with_other_wheels_still_drives_the_speed_that_was_asked(
    gain: float, asked: float
) -> None:
    drive = Drive(gain=gain, lag_s=0.06)
    reached = []
    for _ in range(400):
        drive.go(want(asked))
        reached.append(drive.v / asked)
    assert max(reached) < (1.05 if gain < 1 else 1.10)  # a fast body begins too fast
    assert min(reached[150:]) > 0.98
    assert max(reached[150:]) < 1.02
    assert reached[-1] == pytest.approx(1.0, abs=0.001)


def test_a_body_with_other_wheels_turns_as_fast_as_was_asked_too() -> None:
    drive = Drive(gain=0.9, lag_s=0.06)
    reached = []
    for _ in range(400):
        drive.go(want(w=-0.5))
        reached.append(drive.w / -0.5)
    assert max(reached) < 1.05
    assert reached[150] == pytest.approx(1.0, abs=0.02)


def test_nothing_winds_up_while_a_cap_holds_the_body_back() -> None:
    drive = Drive(gain=0.9, lag_s=0.06)
    drive.speeds(300, want(0.2))
    learnt = drive.memory.gain_x
    assert learnt == pytest.approx(1 / 0.9, abs=0.01)
    for _ in range(500):  # the gate clamps to the cap
        command = drive.go(want(0.2), caps=SpeedCaps(forward=0.1))
        drive._command = replace(command, linear_x=min(command.linear_x, 0.1))
    assert drive.v == pytest.approx(0.09, abs=0.001)
    assert drive.memory.gain_x == pytest.approx(learnt, abs=0.01)
    released = []
    for _ in range(100):
        drive.go(want(0.2))
        released.append(drive.v)
    assert max(released) < 0.2 * 1.02


def test_nothing_winds_up_at_the_bodys_own_limit() -> None:
    drive = Drive(gain=0.9, lag_s=0.06)
    assert drive.speeds(1000, want(0.26))[-1] == pytest.approx(0.26)
    assert drive.memory.gain_x < 1.01
    slower = drive.speeds(500, want(0.2))
    assert max(slower[20:]) < 0.2 / 0.9 * 1.02
    for _ in range(500):
        drive.go(want(w=1.82))
    assert drive.memory.gain_z < 1.01


def test_a_blocked_wheel_is_corrected_by_a_quarter_at_the_most() -> None:
    drive = Drive(gain=0.0)
    assert drive.speeds(500, want(0.16))[-1] == pytest.approx(0.2)


def test_nothing_is_learnt_at_a_crawl_or_while_the_speed_still_changes() -> None:
    drive = Drive(gain=0.9)
    drive.speeds(200, want(0.04, 0.08))
    for speed in [0.1, 0.2] * 20:
        drive.speeds(9, want(speed))
    assert (drive.memory.gain_x, drive.memory.gain_z) == (1.0, 1.0)


speeds = st.floats(-2.0, 2.0)
cap = st.none() | st.floats(0.0, 0.5)
wishes = st.none() | st.builds(want, speeds, speeds)
twists = st.none() | st.builds(Velocity, linear_x=speeds, angular_z=speeds)
caps = st.builds(SpeedCaps, forward=cap, backward=cap, rotation=cap)
gates = st.sampled_from([DRIVING, DRIVING, DRIVING, replace(DRIVING, enables=2), *SHUT.values()])
moments = st.lists(st.tuples(wishes, twists, caps, gates, st.integers(1, 4)), max_size=40)
Moment = tuple[Intent | None, Velocity | None, SpeedCaps, GateStatus, int]


@given(moments, st.floats(0.5, 1.5))
def test_no_wish_makes_a_command_that_jumps_or_goes_beyond_the_limits(
    story: list[Moment], gain: float
) -> None:
    drive, before, open_before = Drive(gain=gain), ControlMemory(), False
    for intent, teleop, cap_now, gate, passed in story:
        command = drive.go(intent, teleop=teleop, caps=cap_now, gate=gate, ticks_passed=passed)
        now, opened = drive.memory, gate.mode == "enabled" and gate.commander == "control"
        if opened:
            dv = now.setpoint.linear_x - before.setpoint.linear_x
            dw = now.setpoint.angular_z - before.setpoint.angular_z
            assert abs(dv) <= 1.0 * 0.02 * passed + 1e-9
            assert abs(dw) <= 3.0 * 0.02 * passed + 1e-9
        if not (opened and open_before):  # closed, or just opened
            assert (command.linear_x, command.angular_z) == (0.0, 0.0)
        assert abs(command.linear_x) <= 0.26
        assert abs(command.angular_z) <= 1.82
        assert 0.75 <= now.gain_x <= 1.25
        before, open_before = now, opened


@given(moments, wishes, twists, caps, gates)
def test_asked_again_within_a_tick_it_answers_the_same(
    story: list[Moment],
    intent: Intent | None,
    teleop: Velocity | None,
    cap_now: SpeedCaps,
    gate: GateStatus,
) -> None:
    drive = Drive(gain=0.9)
    for wish, twist, cap_then, gate_then, passed in story:
        drive.go(wish, teleop=twist, caps=cap_then, gate=gate_then, ticks_passed=passed)
    now = state(drive.tick + 1, v=drive.v, w=drive.w, gate=gate)
    inputs = ControlInputs(state=now, intent=intent, teleop=teleop, caps=cap_now)
    once = step(WAFFLE, drive.memory, inputs)
    assert step(WAFFLE, once[0], inputs) == once
    without = replace(inputs, intent=None, teleop=None)  # asked first when less had come
    assert step(WAFFLE, step(WAFFLE, drive.memory, without)[0], inputs) == once
