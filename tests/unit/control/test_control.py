"""Control's step: smooth commands within the limits, at the speed that was asked for."""

import math

import pytest
from hypothesis import strategies as st
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.brain import Intent, JointTarget
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.control.node import ControlMemory
from gigabrain_zenoh.testing.samples import DRIVING, WAFFLE
from tests.unit.control.straight import SHUT, Drive, want


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


def test_a_car_is_commanded_to_turn_only_as_it_drives() -> None:
    car = replace(WAFFLE, drive_type="ackermann", min_turning_radius=0.5)
    drive = Drive(car)
    for twist in (want(w=1.0), want(0.2, 1.0)):
        for _ in range(50):
            command = drive.go(twist)
    assert command.linear_x == pytest.approx(0.2)
    assert command.angular_z == pytest.approx(0.4)
    on_the_spot = Drive(car)
    assert {on_the_spot.go(teleop=Velocity(angular_z=1.0)).angular_z for _ in range(20)} == {0.0}


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
    anew = ControlMemory(boot=8, tick=3, enabled_tick=3, enables=1, history=drive.memory.history)
    assert drive.memory == anew
    assert drive.memory.history.ticks == (3,)


def test_an_operator_comes_before_decision() -> None:
    drive = Drive()
    drive.speeds(20, want(0.1))
    backwards = [drive.go(want(0.1), teleop=Velocity(linear_x=-0.04)).linear_x for _ in range(8)]
    assert backwards == pytest.approx([0.08, 0.06, 0.04, 0.02, 0.0, -0.02, -0.04, -0.04])
    assert drive.memory.basis == drive.tick  # based on what the operator sees


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
    assert drive.speeds(2, want(0.2)) == pytest.approx([0.0, 0.02])  # the operator does not drive


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


speeds = st.floats(-2.0, 2.0)
cap = st.none() | st.floats(0.0, 0.5)
caps = st.builds(SpeedCaps, forward=cap, backward=cap, rotation=cap)
