"""Joints go where decision or an operator wants, smoothly, and are held in every other case."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import JointGains
from gigabrain_schemas.brain import JointSpeeds
from gigabrain_zenoh.geometry.joints import ANY_SPEED, SpeedBand
from gigabrain_zenoh.testing.samples import DRIVING
from tests.unit.control.arm import CLOSED, LIFT, PAN, ArmBench, arm_body, path, targets

CALM = 10  # ticks after which the gate obeys


def jog(pan: float) -> JointSpeeds:
    return JointSpeeds(name=("pan",), velocity=(pan,))


def enabled(*, sag: float = 0.0) -> ArmBench:
    arm = ArmBench(sag=sag)
    arm.go(ticks=CALM)
    return arm


@pytest.mark.parametrize("gate", CLOSED.values(), ids=CLOSED)
def test_it_commands_the_posture_of_now_while_the_gate_is_not_open_for_it(gate: object) -> None:
    arm = ArmBench(sag=0.02)
    arm.gate = gate  # type: ignore[assignment]
    command = arm.go(targets(pan=1.0), ticks=20)
    assert command
    assert (command.position, command.velocity) == ((0.0, 0.0), (0.0, 0.0))
    assert command.source == "control"


def test_it_moves_nothing_after_an_enable_though_joints_sag() -> None:
    arm = ArmBench(sag=0.05)
    arm.go(ticks=100)
    assert set(arm.places) == {(0.0, 0.0)}


def test_limp_joints_are_commanded_where_they_are() -> None:
    arm = ArmBench(sag=0.3)
    arm.limp, arm.gate = True, CLOSED["idle"]
    command = arm.go()
    assert command
    assert command.position == (-0.3, -0.3)


def test_without_all_joints_it_commands_none() -> None:
    arm = ArmBench()
    arm.missing = True
    assert arm.go(targets(pan=1.0)) is None


def test_targets_are_reached_within_speed_acceleration_and_jerk() -> None:
    arm = enabled()
    arm.go(targets(pan=1.0), ticks=100)
    pan = np.array([place[0] for place in arm.places])
    assert pan[-1] == pytest.approx(1.0, abs=0.01)
    assert {place[1] for place in arm.places} == {0.0}
    speed = np.diff(pan) / 0.02
    assert 1.5 < speed.max() < 2.05
    assert np.abs(np.diff(speed) / 0.02).max() < 22.0
    assert pan.max() < 1.02


def test_joints_with_targets_arrive_together() -> None:
    arm = enabled()
    arm.go(targets(pan=1.0, lift=-0.3), ticks=100)
    places = np.array(arm.places)
    pan, lift = (np.argmax(np.abs(places[:, i] - end) < 0.01) for i, end in ((0, 1.0), (1, -0.3)))
    assert pan == pytest.approx(lift, abs=3)


def test_a_target_beyond_the_range_ends_at_its_limit() -> None:
    arm = enabled()
    arm.go(targets(pan=7.0), ticks=150)
    assert arm.places[-1][0] == 1.5


def test_an_intent_that_ends_leaves_the_joints_braked_where_they_are() -> None:
    arm = enabled()
    arm.go(targets(pan=1.0), ticks=15)
    arm.go(None, ticks=30)
    there = arm.places[-1][0]
    assert 0.1 < there < 0.9
    arm.go(None, ticks=10)
    assert arm.places[-1][0] == pytest.approx(there, abs=0.01)


def test_after_a_silence_of_decision_joints_go_on_from_where_they_were_held() -> None:
    arm = enabled()
    arm.go(targets(pan=1.0), ticks=15)
    arm.go(None, ticks=10)
    held = arm.sent[0].position
    arm.go(targets(pan=1.0), ticks=1)
    assert arm.sent[0].position == pytest.approx(held, abs=0.01)
    arm.go(targets(pan=1.0), ticks=100)
    assert arm.sent[0].position == pytest.approx(1.0, abs=0.01)


def test_short_silences_of_decision_add_nothing_to_what_an_arm_presses_with() -> None:
    arm = enabled(sag=0.03)
    arm.go(targets(pan=0.5), ticks=200)
    arm.blocked = True
    arm.here[0] = 0.4  # an external force pushes it away
    for _ in range(10):
        arm.go(None, ticks=2)
        arm.go(targets(lift=0.5), ticks=10)
    assert max(place[0] for place in arm.places) < 0.5 + PAN.gains.max_correction + 0.001


def test_after_a_short_silence_an_arm_does_not_sag() -> None:
    arm = enabled(sag=0.03)
    arm.go(targets(pan=0.5), ticks=200)
    arm.go(None, ticks=2)
    arm.go(targets(lift=0.5), ticks=20)
    assert min(place[0] for place in arm.places[-22:]) == pytest.approx(0.53, abs=0.002)
    assert arm.here[0] == pytest.approx(0.5, abs=0.002)


def test_a_joint_that_the_gate_slows_down_moves_no_other() -> None:
    arm = enabled(sag=0.03)
    arm.go(targets(pan=0.5), ticks=200)
    there = arm.places[-1][0]
    for _ in range(60):
        before = arm.sent[1]
        arm.go(targets(lift=1.4))
        arm.sent[1] = replace(before, position=before.position + 0.002, velocity=0.1)
        arm.here[0] = 0.47  # an external force pushes it away
    assert {round(place[0], 2) for place in arm.places[-60:]} <= {
        round(there + off, 2) for off in (0.0, 0.01, 0.02)
    }


def test_a_trajectory_is_followed_to_the_tick() -> None:
    arm = enabled()
    wave = [(0.3 * math.sin(0.05 * k) ** 2, 0.001 * k) for k in range(60)]
    arm.body = arm_body(*(replace(joint, gains=JointGains(i=0.0)) for joint in (PAN, LIFT)))
    arm.go(path(wave, start=arm.tick + 1), ticks=59)
    assert arm.places[-58:] == [pytest.approx(row, abs=1e-6) for row in wave[2:]] + [
        pytest.approx(wave[-1], abs=1e-6)
    ] * (58 - len(wave[2:]))
    arm.go(path(wave, start=arm.tick - 58), ticks=10)
    assert arm.places[-1] == pytest.approx(wave[-1], abs=1e-6)


def test_a_trajectory_that_begins_elsewhere_is_joined_without_a_jump() -> None:
    arm = enabled()
    arm.go(path([(0.2, 0.0)] * 100, start=arm.tick), ticks=60)
    pan = np.array([place[0] for place in arm.places])
    assert pan[-1] == pytest.approx(0.2, abs=0.01)
    assert np.abs(np.diff(pan, 2)).max() / 0.02**2 < 22.0


def test_joints_that_a_trajectory_does_not_name_stay() -> None:
    arm = enabled()
    arm.go(path([(0.1,)] * 50, start=arm.tick, names=["lift"]), ticks=40)
    assert arm.places[-1][0] == pytest.approx(0.0, abs=0.01)
    assert arm.places[-1][1] == pytest.approx(0.1, abs=0.01)


def ramp_to(end: float, ticks: int) -> list[tuple[float, float]]:
    return [(end * k / ticks, 0.0) for k in range(ticks + 1)]


def test_a_blocked_arm_breaks_the_path_tolerance_and_is_held_where_it_is() -> None:
    arm = enabled()
    arm.blocked = True
    arm.go(path(ramp_to(1.0, 50), start=arm.tick), ticks=100)
    assert (arm.memory.problem, arm.memory.detail[:6]) == ("path_tolerance", "pan is")
    assert arm.places[-1][0] == pytest.approx(0.0, abs=0.02)
    assert max(place[0] for place in arm.places) < 0.5


def test_a_hold_ends_with_a_trajectory_that_was_made_after_it_began() -> None:
    arm = enabled()
    arm.blocked = True
    old = path(ramp_to(1.0, 50), start=arm.tick)
    arm.go(old, ticks=100)
    arm.blocked = False
    arm.go(path([(0.0, 0.0)] * 100, start=arm.memory.broken_tick), ticks=5)
    assert arm.memory.problem == "path_tolerance"
    arm.go(path([(0.0, 0.0)] * 100, start=arm.tick), ticks=1)
    assert arm.memory.problem == ""


def test_a_hold_ends_when_decision_wants_something_else() -> None:
    arm = enabled()
    arm.blocked = True
    arm.go(path(ramp_to(1.0, 50), start=arm.tick), ticks=100)
    arm.blocked = False
    arm.go(targets(pan=0.5), ticks=80)
    assert arm.memory.problem == ""
    assert arm.places[-1][0] == pytest.approx(0.5, abs=0.01)


def test_a_path_tolerance_of_zero_is_not_checked() -> None:
    free = replace(PAN, path_tolerance=0.0, goal_tolerance=0.0)
    arm = ArmBench(arm_body(free, LIFT))
    arm.go(ticks=CALM)
    arm.blocked = True
    arm.go(path(ramp_to(1.0, 50), start=arm.tick), ticks=150)
    assert arm.memory.problem == ""


def test_an_end_that_is_not_reached_in_time_breaks_the_goal_tolerance() -> None:
    strict = replace(PAN, goal_tolerance=0.01, gains=JointGains(i=0.0))
    arm = ArmBench(arm_body(strict, replace(LIFT, goal_tolerance=0.0)), sag=0.05)
    arm.go(ticks=CALM)
    intent = path(ramp_to(0.2, 20), start=arm.tick)
    arm.go(intent, ticks=60)
    assert arm.memory.problem == ""
    arm.go(intent, ticks=20)
    assert arm.memory.problem == "goal_tolerance"


def test_the_integral_lifts_a_joint_that_sags_no_further_than_its_largest_correction() -> None:
    arm = enabled(sag=0.03)
    arm.go(targets(pan=0.5), ticks=200)
    assert arm.here[0] == pytest.approx(0.5, abs=0.002)
    heavy = enabled(sag=0.2)
    heavy.go(targets(pan=0.5), ticks=300)
    assert heavy.places[-1][0] == pytest.approx(0.55, abs=0.001)


def test_a_gripper_is_not_pressed_ever_harder_on_what_it_holds() -> None:
    arm = ArmBench(arm_body(PAN, replace(LIFT, part="gripper")), sag=0.03)
    arm.go(ticks=CALM)
    arm.go(targets(pan=0.5, lift=0.5), ticks=200)
    assert arm.places[-1] == pytest.approx((0.53, 0.5), abs=0.002)


def test_feed_forward_leads_a_moving_joint() -> None:
    ahead = replace(PAN, gains=JointGains(i=0.0, feed_forward=0.1))
    arm = ArmBench(arm_body(ahead, LIFT))
    arm.go(ticks=CALM)
    arm.go(path(ramp_to(1.4, 140), start=arm.tick), ticks=70)
    setpoint = arm.memory.setpoint[0]
    assert arm.places[-1][0] == pytest.approx(setpoint.position + 0.1 * setpoint.velocity)
    assert setpoint.velocity == pytest.approx(0.5, abs=0.01)


def test_a_heavy_joint_is_sent_ahead_by_its_acceleration() -> None:
    heavy = replace(PAN, gains=JointGains(i=0.0, inertia=0.01))
    arm = ArmBench(arm_body(heavy, LIFT))
    arm.go(ticks=CALM)
    ahead = []
    for _ in range(40):
        arm.go(targets(pan=1.0))
        setpoint = arm.memory.setpoint[0]
        ahead.append(arm.places[-1][0] - setpoint.position)
        assert ahead[-1] == pytest.approx(0.01 * setpoint.acceleration)
    assert max(ahead) > 0.1  # it speeds up,
    assert min(ahead) < -0.1  # and brakes


def test_what_is_sent_on_the_way_to_a_target_is_within_the_gate_s_limits() -> None:
    late = replace(PAN, gains=JointGains(i=0.0, feed_forward=0.08))
    arm = ArmBench(arm_body(late, LIFT))
    arm.go(ticks=CALM)
    arm.go(targets(pan=1.2), ticks=100)
    places = np.array([place[0] for place in arm.places])
    assert np.abs(np.diff(places, 2)).max() < 1.1 * PAN.max_acceleration * 0.02**2
    assert places[-1] == pytest.approx(1.2)


def test_an_operator_jogs_and_keeps_the_arm_until_the_next_enable() -> None:
    arm = enabled()
    command = arm.go(targets(pan=-1.0), teleop=jog(0.5), ticks=50)
    assert command
    assert command.operator
    assert 0.3 < arm.places[-1][0] < 0.5
    command = arm.go(targets(pan=-1.0), ticks=50)
    assert command
    assert command.operator
    assert arm.places[-1][0] > 0.3
    arm.gate = replace(DRIVING, enables=DRIVING.enables + 1)
    arm.go(targets(pan=-1.0), ticks=150)
    assert arm.places[-1][0] == pytest.approx(-1.0, abs=0.02)


def test_a_jog_ends_at_the_end_of_the_range() -> None:
    arm = enabled()
    arm.go(teleop=jog(9.0), ticks=150)
    assert arm.places[-1][0] == 1.5
    assert max(np.diff([place[0] for place in arm.places])) < 2.05 * 0.02


def test_an_arm_that_the_gate_held_goes_on_from_where_it_was_sent() -> None:
    arm = enabled()
    arm.go(targets(pan=1.0), ticks=20)
    arm.sent[0], arm.here[0] = replace(arm.sent[0], position=-0.5, velocity=0.0), -0.5
    command = arm.go(targets(pan=1.0))
    assert command
    assert command.position[0] == pytest.approx(-0.5, abs=0.02)


def test_an_arm_that_the_gate_slows_down_moves_evenly_and_does_not_run_past_the_end() -> None:
    arm, speeds = ArmBench(arm_body(replace(PAN, path_tolerance=0.0), LIFT)), []
    arm.go(ticks=CALM)
    rows = ramp_to(1.2, 40)  # 1.5 rad/s
    arm.band = SpeedBand(-0.6, 0.6)
    for tick in range(120):
        if tick == 60:
            arm.band = ANY_SPEED
        arm.go(path(rows, start=CALM))
        speeds.append(arm.sent[0].velocity)
    assert min(speeds[12:60]) > 0.5
    assert max(place[0] for place in arm.places) < 1.25
    assert arm.sent[0].position == pytest.approx(1.2, abs=0.01)


def test_a_command_says_how_fast_what_is_sent_moves() -> None:
    ahead = replace(PAN, gains=JointGains(i=0.0, feed_forward=0.1))
    arm = ArmBench(arm_body(ahead, LIFT))
    arm.go(ticks=CALM)
    for _ in range(60):
        before = arm.places[-1][0]
        command = arm.go(targets(pan=0.5))
        assert command
        moved = (command.position[0] - before) / 0.02
        assert command.velocity[0] == pytest.approx(moved, abs=0.35)


def test_an_unknown_joint_in_an_intent_moves_nothing() -> None:
    arm = enabled()
    arm.go(targets(knee=1.0), ticks=20)
    assert arm.places[-1] == (0.0, 0.0)
