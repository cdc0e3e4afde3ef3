"""Control's step: smooth commands within the limits, at the speed that was asked for."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription, GateStatus
from gigabrain_schemas.brain import CmdVel, Intent, JointTarget
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.control import Inputs, Memory, step
from tests.brain_rig import DRIVING, WAFFLE, state

SHUT = {
    "latched": GateStatus(mode="latched", enables=1),
    "idle": GateStatus(mode="idle", enables=1),
    "stopping": GateStatus(mode="stopping", commander="control", enables=1),
    "a script's": GateStatus(mode="enabled", commander="script", enables=1),
}


def want(v: float = 0.0, w: float = 0.0, *, basis: int = 1) -> Intent:
    twist = Velocity(linear_x=v, angular_z=w)
    return Intent(twist=twist, behaviour="avoid", reason="because", basis=basis)


class Drive:
    """Control, and a body that goes `gain` times as fast as it is told: late, and by and by."""

    def __init__(
        self, body: BodyDescription = WAFFLE, *, gain: float = 1.0, lag_s: float = 0.0
    ) -> None:
        self.body, self.memory, self.tick = body, Memory(), 0
        self._gain, self._follows = gain, 1 - math.exp(-0.02 / lag_s) if lag_s else 1.0
        self.v = self.w = 0.0
        self._told = CmdVel(linear_x=0.0)

    def go(
        self,
        intent: Intent | None = None,
        *,
        teleop: Velocity | None = None,
        caps: SpeedCaps | None = None,
        gate: GateStatus = DRIVING,
        boot: int = 7,
        ticks_passed: int = 1,
    ) -> CmdVel:
        """One tick."""
        self.tick += ticks_passed
        self.v += (self._gain * self._told.linear_x - self.v) * self._follows
        self.w += (self._gain * self._told.angular_z - self.w) * self._follows
        measured = state(self.tick, v=self.v, w=self.w, gate=gate, boot=boot)
        inputs = Inputs(state=measured, intent=intent, teleop=teleop, caps=caps or SpeedCaps())
        self.memory, self._told = step(self.body, self.memory, inputs)
        return self._told

    def speeds(
        self, ticks: int, intent: Intent | None = None, *, caps: SpeedCaps | None = None
    ) -> list[float]:
        """The linear speeds commanded in so many ticks."""
        return [self.go(intent, caps=caps).linear_x for _ in range(ticks)]


def test_it_ramps_from_zero_to_what_decision_wants() -> None:
    speeds = Drive().speeds(13, want(0.2))
    expected = [0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.14, 0.16, 0.18, 0.2, 0.2, 0.2]
    assert speeds == pytest.approx(expected)


def test_turning_is_ramped_as_well() -> None:
    drive = Drive()
    turns = [drive.go(want(w=-0.5)).angular_z for _ in range(11)]
    assert turns == pytest.approx(
        [0, -0.06, -0.12, -0.18, -0.24, -0.3, -0.36, -0.42, -0.48, -0.5, -0.5]
    )


def test_it_signs_its_commands_and_knows_what_they_rest_on() -> None:
    drive = Drive()
    assert drive.go(want(0.2, basis=1)).source == "control"
    assert drive.memory.basis == 1
    drive.tick = 9
    drive.go(want(0.2, basis=10))
    drive.go(None)
    assert drive.memory.basis == 10


@pytest.mark.parametrize(("v", "limit"), [(9.0, 0.26), (-9.0, -0.26)])
def test_it_never_asks_for_more_than_the_body_can_do(v: float, limit: float) -> None:
    drive = Drive()
    for _ in range(50):
        command = drive.go(want(v, math.copysign(9.0, v)))
    assert command.linear_x == pytest.approx(limit)
    assert command.angular_z == pytest.approx(math.copysign(1.82, v))


@pytest.mark.parametrize("intent", [None, Intent(behaviour="b", reason="r")])
def test_without_a_wish_it_ramps_to_zero(intent: Intent | None) -> None:
    drive = Drive()
    drive.speeds(20, want(0.1))
    assert drive.speeds(6, intent) == pytest.approx([0.08, 0.06, 0.04, 0.02, 0.0, 0.0])


def test_an_intent_for_joints_alone_does_not_move_the_base() -> None:
    reach = Intent(joints=(JointTarget(name="arm", position=1.0),), behaviour="b", reason="r")
    assert set(Drive().speeds(5, reach)) == {0.0}


def test_an_intent_that_rests_on_what_has_not_happened_yet_is_not_obeyed() -> None:
    drive = Drive()
    assert set(drive.speeds(5, want(0.2, basis=1000))) == {0.0}
    assert drive.memory.basis == 0


@pytest.mark.parametrize("who", SHUT)
def test_while_the_gate_is_shut_it_sends_zeros_and_forgets(who: str) -> None:
    drive = Drive(gain=0.9)
    drive.speeds(100, want(0.2))
    assert drive.memory.gain_x > 1.05
    for _ in range(3):
        command = drive.go(want(0.2), gate=SHUT[who])
        assert (command.linear_x, command.angular_z) == (0.0, 0.0)
    assert (drive.memory.gain_x, drive.memory.gain_z) == (1.0, 1.0)
    assert drive.speeds(3, want(0.2)) == pytest.approx([0.0, 0.02, 0.04])


def test_a_new_start_of_the_driver_is_a_new_beginning() -> None:
    drive = Drive(gain=0.9)
    drive.speeds(100, want(0.2, basis=80))
    drive.go(want(0.2), teleop=Velocity(linear_x=0.2))
    drive.tick = 2
    assert drive.go(boot=8).linear_x == 0.0
    anew = Memory(boot=8, tick=3, opened=3, enables=1, history=drive.memory.history)
    assert drive.memory == anew
    assert drive.memory.history.ticks == (3,)


def test_an_operator_comes_before_decision() -> None:
    drive = Drive()
    drive.speeds(20, want(0.1))
    backwards = [drive.go(want(0.1), teleop=Velocity(linear_x=-0.04)).linear_x for _ in range(8)]
    assert backwards == pytest.approx([0.08, 0.06, 0.04, 0.02, 0.0, -0.02, -0.04, -0.04])
    assert drive.memory.basis == drive.tick  # it rests on the operator's eyes


def test_when_an_operator_lets_go_it_holds_still_until_somebody_enables_it_again() -> None:
    drive = Drive()
    drive.go(want(0.2))
    drive.go(want(0.2), teleop=Velocity(linear_x=0.02))
    assert drive.speeds(50, want(0.2)) == pytest.approx([0.0] * 50, abs=1e-12)
    handed_back = replace(DRIVING, enables=2)
    speeds = [drive.go(want(0.2), gate=handed_back).linear_x for _ in range(3)]
    assert speeds == pytest.approx([0.02, 0.04, 0.06])


def test_an_operator_is_not_heard_while_the_gate_is_shut() -> None:
    drive = Drive()
    command = drive.go(want(0.2), teleop=Velocity(linear_x=0.2), gate=SHUT["idle"])
    assert command.linear_x == 0.0
    assert drive.speeds(2, want(0.2)) == pytest.approx([0.0, 0.02])  # nor does it hold afterwards


def test_caps_of_safety_bound_each_direction() -> None:
    caps = SpeedCaps(forward=0.1, backward=0.05, rotation=0.3)
    drive = Drive()
    assert drive.speeds(50, want(0.2, 1.0), caps=caps)[-1] == pytest.approx(0.1)
    assert drive.go(want(0.2, 1.0), caps=caps).angular_z == pytest.approx(0.3)
    assert drive.speeds(50, want(-0.2), caps=caps)[-1] == pytest.approx(-0.05)
    assert drive.go(want(-0.2, -1.0), caps=caps).linear_x == pytest.approx(-0.05)


def test_a_cap_that_falls_is_met_by_a_ramp() -> None:
    drive = Drive()
    drive.speeds(50, want(0.2))
    falling = drive.speeds(5, want(0.2), caps=SpeedCaps(forward=0.13))
    assert falling == pytest.approx([0.18, 0.16, 0.14, 0.13, 0.13])


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
    for _ in range(500):  # the gate takes what the cap leaves
        told = drive.go(want(0.2), caps=SpeedCaps(forward=0.1))
        drive._told = replace(told, linear_x=min(told.linear_x, 0.1))
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


@settings(deadline=None)
@given(moments, st.floats(0.5, 1.5))
def test_no_wish_makes_a_command_that_jumps_or_goes_beyond_the_limits(
    story: list[Moment], gain: float
) -> None:
    drive, before, open_before = Drive(gain=gain), Memory(), False
    for intent, teleop, cap_now, gate, passed in story:
        command = drive.go(intent, teleop=teleop, caps=cap_now, gate=gate, ticks_passed=passed)
        now, opened = drive.memory, gate.mode == "enabled" and gate.commander == "control"
        if opened:
            dv = now.setpoint.linear_x - before.setpoint.linear_x
            dw = now.setpoint.angular_z - before.setpoint.angular_z
            assert abs(dv) <= 1.0 * 0.02 * passed + 1e-9
            assert abs(dw) <= 3.0 * 0.02 * passed + 1e-9
        if not (opened and open_before):  # shut, or just opened
            assert (command.linear_x, command.angular_z) == (0.0, 0.0)
        assert abs(command.linear_x) <= 0.26
        assert abs(command.angular_z) <= 1.82
        assert 0.75 <= now.gain_x <= 1.25
        before, open_before = now, opened


@settings(deadline=None)
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
    inputs = Inputs(state=now, intent=intent, teleop=teleop, caps=cap_now)
    once = step(WAFFLE, drive.memory, inputs)
    assert step(WAFFLE, once[0], inputs) == once
    without = replace(inputs, intent=None, teleop=None)  # asked first when less had come
    assert step(WAFFLE, step(WAFFLE, drive.memory, without)[0], inputs) == once
