"""Missions move an arm in MuJoCo: task queue, manipulator, control and gate, stepped in memory."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot, make_driver, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim import STEP_S
from gigabrain_drivers.sim.worlds import mission_file
from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.brain import Intent, JointTarget
from gigabrain_schemas.objects import SeenSolid
from gigabrain_schemas.safety import JointCap
from gigabrain_zenoh.cli import arm
from gigabrain_zenoh.decision.behaviours import ArmCommand, Idle
from gigabrain_zenoh.decision.grip import REST_TICKS
from gigabrain_zenoh.decision.tasks.arm_steps import HeldThing
from gigabrain_zenoh.manipulation.arm_planner import MOVING, STILL, ArmPlanner
from gigabrain_zenoh.safety.arm_shape import MujocoArm
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step
from tests.node.arm_rig import ELSEWHERE, THERE, THINGS, Rig

NO_TASK = Idle("idle", "no task")
GRIPPER = load_robot("so101").joints[-1]
SOON = 150  # ticks, enough to adjust a grip


@pytest.fixture
def rig(tmp_path: Path) -> Any:
    made = Rig(tmp_path)
    yield made
    made.manipulator.close()


@pytest.mark.parametrize("body", ["so101", "piper"])
def test_one_mission_moves_a_cube_there_and_back_by_any_arm(tmp_path: Path, body: str) -> None:
    rig = Rig(tmp_path, body=body)
    task = rig.carry_out(
        THINGS + "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]},"
        " {pick: cube}, {place: [0.2388, 0.0, 0.015]}, {posture: home}]"
    )
    assert (task.state, task.reason) == ("succeeded", "")
    assert rig.arm.thing()[:2] == pytest.approx(THERE, abs=0.01)
    assert rig.arm.broken == 0
    rig.manipulator.close()


@pytest.mark.parametrize("body", ["so101", "piper"])
def test_the_demo_of_any_arm_moves_blocks_and_heats_no_motor(tmp_path: Path, body: str) -> None:
    rig = Rig(tmp_path, body=body, world=Path("table"))
    demo = rig.arm.robot.demo
    assert demo.world == "table"
    rig.give(Path(mission_file(demo.mission, tmp_path)).read_text())
    data, red = rig.arm.simulation.data, rig.arm.simulation.model.body("world/red").id
    while rig.phases.count("retreat") < 1:
        rig.tick()
        assert rig.queue.status.current, rig.queue.status.done
    assert data.xpos[red][:2] == pytest.approx((0.20, -0.10), abs=0.01)
    assert max(motor.temperature for motor in rig.arm.arm.motors()) < 40.0
    rig.manipulator.close()


@pytest.mark.slow
@pytest.mark.parametrize("steps", ["{pick: cube}", "{pick: cube}, {gripper: close}"])
@pytest.mark.parametrize("body", ["so101", "piper"])
def test_holding_a_thing_for_long_does_not_heat_a_motor(
    tmp_path: Path, body: str, steps: str
) -> None:
    rig = Rig(tmp_path, body=body)
    task = rig.carry_out(f"{THINGS}do: [{steps}]")
    assert task.state == "succeeded"
    for _ in range(SOON):
        rig.tick()
    for _ in range(round(1800.0 / STEP_S)):
        rig.arm.arm.wear()
    warm = {motor.name: motor.temperature for motor in rig.arm.arm.motors()}
    assert max(warm.values()) < rig.arm.description.thresholds.motor_warn, warm
    rig.manipulator.close()


@pytest.mark.parametrize("way", [-0.01, 0.01])
def test_a_grip_follows_a_creeping_thing_while_the_arm_rests(rig: Rig, way: float) -> None:
    assert rig.carry_out(THINGS + "do: [{pick: cube}]").state == "succeeded"
    for _ in range(SOON):
        rig.tick()
    state = rig.arm.state()
    crept = state.joints[-1].position + way
    joints = (*state.joints[:-1], replace(state.joints[-1], position=crept))
    now = replace(state, joints=joints, tick=state.tick + REST_TICKS)
    intent, outcome = rig.manipulator.step(now, rig.arm.description, None, NO_TASK, "")
    (target,) = intent.joints
    assert target.name == "gripper"
    assert abs(target.position - crept) == pytest.approx(STILL[1] * (GRIPPER.upper - GRIPPER.lower))
    assert isinstance(outcome.holds, HeldThing)
    assert outcome.holds.grip == target.position


def test_a_gripper_moved_by_an_operator_stays_there(rig: Rig) -> None:
    assert rig.carry_out(THINGS + "do: [{pick: cube}]").state == "succeeded"
    for _ in range(SOON):
        rig.tick()
    opened = JointTarget(name="gripper", position=rig.arm.measured("gripper") + 0.01)
    for _ in range(SOON):
        rig.arm.step(Intent(joints=(opened,), behaviour="test", reason="open"))
    intent, _ = rig.manipulator.step(rig.arm.state(), rig.arm.description, None, NO_TASK, "")
    assert intent.joints == ()


def test_a_grip_is_firmer_while_the_arm_moves(rig: Rig) -> None:
    assert rig.carry_out(THINGS + "do: [{pick: cube}]").state == "succeeded"
    for _ in range(SOON):
        rig.tick()
    rig.give("do: [{place: [0.1388, 0.15, 0.015]}]")
    lags = dict[str, float]()  # by phase, at its end
    while rig.queue.status.current:
        rig.tick()
        state = rig.arm.state()
        lag = abs(state.joints_sent[-1] - state.joints[-1].position)
        lags[rig.phases[-1]] = lag / (GRIPPER.upper - GRIPPER.lower)
    assert MOVING[0] < lags["traverse"] < MOVING[-1]
    assert MOVING[0] < lags["lower"] < MOVING[-1]


@pytest.mark.slow
def test_safety_near_the_table_does_not_change_the_pipers_paths(tmp_path: Path) -> None:
    rig = Rig(tmp_path, body="piper", world=Path("table"))
    rig.give(Path(mission_file("blocks", tmp_path)).read_text())
    shape = MujocoArm(robot_path("piper").with_name("model.xml").read_text(), rig.arm.description)
    memory, forced = SafetyMemory(), [0.0]
    while rig.phases.count("retreat") < 2:  # red and green
        inputs = SafetyInputs(state=rig.arm.state(), arm=shape)
        memory, verdict = step(rig.arm.description, memory, inputs)
        rig.arm.caps = verdict.joints
        rig.tick()
        if rig.phases[-1] == "descend":  # a finger that touches a block is forced open
            (sent,) = rig.arm.posture(["gripper"])
            forced.append(abs(rig.arm.measured("gripper") - sent))
    assert max(forced) < 0.0005
    rig.manipulator.close()


def test_the_tool_reaches_a_point_from_the_asked_direction(rig: Rig) -> None:
    task = rig.carry_out("do: [{reach: {at: [0.22, 0.05, 0.06], pitch: 1.2}}]")
    assert (task.state, task.reason) == ("succeeded", "")
    arm = rig.planner.arm
    tool = arm.forward(np.array([rig.arm.measured(name) for name in arm.names]))
    assert tool.position == pytest.approx([0.22, 0.05, 0.06], abs=0.01)
    assert tool.axes[2, 0] == pytest.approx(-np.sin(1.2), abs=0.05)


@pytest.mark.parametrize(
    ("step", "why"),
    [
        ("reach: [0.9, 0.0, 0.1]", "not reachable: too far by"),
        ("reach: [0.2, 0.0, -0.05]", "collides: "),
        ("place: [0.2, 0.0, 0.015]", "the gripper holds nothing"),
        ("pick: far", "too far by"),
    ],
)
def test_an_impossible_command_fails_with_its_reason_and_without_motion(
    rig: Rig, step: str, why: str
) -> None:
    far = "things: {far: {sphere: 0.015, at: [0.8, 0.0, 0.015]}}\n"
    before = rig.arm.posture(rig.arm.arm.names)
    task = rig.carry_out(f"{far}do: [{{{step}}}]")
    assert task.state == "failed"
    assert why in task.reason
    assert rig.arm.posture(rig.arm.arm.names) == pytest.approx(before, abs=1e-3)


def test_a_missing_thing_is_tried_three_times_and_the_arm_backs_off(tmp_path: Path) -> None:
    rig = Rig(tmp_path, cube=(-0.3, 0.3))
    task = rig.carry_out(THINGS + "do: [{pick: cube}]")
    assert (task.state, task.reason) == ("failed", "picking up cube: it was not caught, 3 times")
    assert rig.phases.count("close") == 3
    rig.manipulator.close()


@pytest.mark.parametrize("phase", ["descend", "close", "lift", "traverse", "open", "retreat"])
def test_after_an_interruption_it_continues_from_its_posture(rig: Rig, phase: str) -> None:
    rig.give(THINGS + "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]}]")
    while rig.outcome is None or rig.outcome.reason != phase:
        rig.tick()
    rig.tick()
    rig.held = "the gate is latched: e-stop"
    for _ in range(100):
        rig.tick()
        assert rig.outcome.held
    rig.held = ""
    task = rig.carry_on()
    assert (task.state, task.reason) == ("succeeded", "")
    assert rig.arm.thing()[:2] == pytest.approx(ELSEWHERE, abs=0.012)


@pytest.mark.parametrize("phase", ["descend", "squeeze", "lift", "traverse", "lower", "retreat"])
def test_after_a_restart_of_decision_it_continues_with_the_held_thing(rig: Rig, phase: str) -> None:
    rig.give(THINGS + "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]}]")
    while rig.outcome is None or rig.outcome.reason != phase:
        rig.tick()
    rig.tick()
    rig.restart()
    task = rig.carry_on()
    if phase == "retreat":  # the gripper has already let go
        assert task.state == "failed"
        assert task.reason.endswith("the gripper holds nothing")
    else:
        assert (task.state, task.reason) == ("succeeded", "")
    assert rig.arm.thing()[:2] == pytest.approx(ELSEWHERE, abs=0.012)


@pytest.mark.parametrize("phase", ["descend", "traverse"])
def test_another_speed_limit_of_the_body_keeps_the_held_thing(rig: Rig, phase: str) -> None:
    rig.give(THINGS + "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]}]")
    while rig.outcome is None or rig.outcome.reason != phase:
        rig.tick()
    rig.arm.description = replace(rig.arm.description, max_linear_speed=0.1)
    task = rig.carry_on()
    assert (task.state, task.reason) == ("succeeded", "")
    assert rig.arm.thing()[:2] == pytest.approx(ELSEWHERE, abs=0.012)


def test_after_a_restart_things_are_at_their_new_places(rig: Rig) -> None:
    rig.give(
        THINGS + "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]}, {posture: home}, {pick: cube}]"
    )
    while rig.outcome is None or rig.outcome.reason != "move":
        rig.tick()
    rig.restart()
    task = rig.carry_on()
    assert (task.state, task.reason) == ("succeeded", "it holds cube")


@pytest.mark.parametrize("opened", [False, True])
def test_a_thing_lost_during_a_restart_is_not_held(rig: Rig, opened: bool) -> None:
    rig.give(THINGS + "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]}]")
    while rig.outcome is None or rig.outcome.reason != "traverse":
        rig.tick()
    if opened:
        wide = Intent(
            joints=(JointTarget(name="gripper", position=1.2),), behaviour="test", reason="open"
        )
        for _ in range(50):
            rig.arm.step(wide)
    else:
        rig.take_away()
    rig.restart()
    task = rig.carry_on()
    assert task.state == "failed"
    assert task.reason.endswith("the gripper holds nothing")


@pytest.mark.parametrize("lost", [False, True])
def test_a_grip_by_gripper_close_is_restored_if_it_still_holds(rig: Rig, lost: bool) -> None:
    assert rig.carry_out(THINGS + "do: [{pick: cube}, {gripper: close}]").state == "succeeded"
    for _ in range(SOON):
        rig.tick()
    if lost:
        rig.take_away()
    rig.restart()
    rig.tick()
    state = rig.arm.state()
    crept = state.joints[-1].position + 0.01
    joints = (*state.joints[:-1], replace(state.joints[-1], position=crept))
    now = replace(state, joints=joints, tick=state.tick + REST_TICKS)
    intent, outcome = rig.manipulator.step(now, rig.arm.description, None, NO_TASK, "")
    assert (outcome.holds is None) is lost
    assert (intent.joints == ()) is lost


def test_a_gripper_that_closes_on_nothing_holds_nothing(rig: Rig) -> None:
    assert rig.carry_out("do: [{gripper: open}, {gripper: close}]").state == "succeeded"
    assert rig.queue.saved.held is None


def test_a_model_that_cannot_be_used_fails_the_command_in_one_line(tmp_path: Path) -> None:
    rig = Rig(tmp_path, mjcf="<mujoco/>")
    task = rig.carry_out("do: [{posture: home}]")
    assert task.state == "failed"
    assert "joint in the arm's model" in task.reason
    rig.manipulator.close()


def test_a_slow_gripper_does_not_count_as_holding(tmp_path: Path) -> None:
    rig = Rig(tmp_path, cube=(-0.3, 0.3))
    rig.give(THINGS + "do: [{pick: cube}]")
    while rig.outcome is None or rig.outcome.reason != "close":
        rig.tick()
    late = rig.arm.state
    for _ in range(60):  # the state shows a gripper that still closes
        rig.tick()
        moving = replace(late().joints[-1], velocity=-1.0)
        rig.arm.state = lambda m=moving: replace(late(), joints=(*late().joints[:-1], m))  # type: ignore[method-assign, misc]
        assert rig.outcome.reason == "close"
    rig.arm.state = late  # type: ignore[method-assign]
    task = rig.carry_on()
    assert (task.state, task.reason) == ("failed", "picking up cube: it was not caught, 3 times")
    rig.manipulator.close()


def test_a_thing_that_slips_out_of_the_gripper_is_reported(rig: Rig) -> None:
    rig.give(THINGS + "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]}]")
    while rig.outcome is None or rig.outcome.reason != "traverse":
        rig.tick()
    rig.take_away()
    task = rig.carry_on()
    assert task.state == "failed"
    assert "cube has slipped out of the gripper" in task.reason


def test_a_second_thing_does_not_count_as_the_held_one(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    missions: list[str] = []
    given = SimpleNamespace(carry_out=lambda text, **_: missions.append(text))
    monkeypatch.setattr(arm, "send", lambda _at, give, _wait: give(given))
    for x, y in (THERE, ELSEWHERE):
        arm.pick(x, y, 0.015, box=(0.03, 0.03, 0.03))
    assert rig.carry_out(missions[0]).state == "succeeded"
    task = rig.carry_out(missions[1])
    assert task.state == "failed"
    assert task.reason.endswith("the gripper holds the thing at (0.239, 0.000, 0.015) already")


def test_a_posture_that_cannot_open_the_gripper_reports_that(rig: Rig) -> None:
    assert rig.carry_out(THINGS + "do: [{pick: cube}]").state == "succeeded"
    assert rig.carry_out("do: [{posture: home}]").reason == "it holds cube"
    task = rig.carry_out("do: [{posture: {shoulder_pan: 0.2, gripper: 1.0}}]")
    assert (task.state, task.reason) == (
        "succeeded",
        "it holds cube, so the gripper stays; `place` and `gripper` let go of it",
    )
    assert rig.manipulator._grip.hold
    assert rig.carry_out("do: [{posture: {shoulder_pan: 0.0}}]").reason == "it holds cube"
    assert rig.carry_out("do: [{gripper: 1.0}]").reason == ""
    assert rig.carry_out("do: [{posture: {shoulder_pan: 0.2, gripper: 0.5}}]").reason == ""
    assert rig.arm.measured("gripper") == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("wide", [0.01, 0.05, 1.0])
def test_a_thing_released_by_an_operator_is_not_put_down(rig: Rig, wide: float) -> None:
    assert rig.carry_out(THINGS + "do: [{pick: cube}]").state == "succeeded"
    for _ in range(SOON):
        rig.tick()
    opened = JointTarget(name="gripper", position=rig.arm.measured("gripper") + wide)
    for _ in range(SOON):
        rig.arm.step(Intent(joints=(opened,), behaviour="test", reason="open"))
    task = rig.carry_out("do: [{place: [0.1388, 0.15, 0.015]}]")
    assert (task.state, task.reason.partition(": ")[2]) == (
        "failed",
        "the gripper holds nothing",
    )
    assert rig.carry_out("do: [{posture: home}]").state == "succeeded"


@pytest.mark.parametrize("step", ["place: [0.1388, 0.15, 0.015]", "posture: home"])
def test_a_thing_lost_before_the_next_motion_is_reported(rig: Rig, step: str) -> None:
    assert rig.carry_out(THINGS + "do: [{pick: cube}]").state == "succeeded"
    for _ in range(SOON):
        rig.tick()
    rig.give(f"do: [{{{step}}}]")
    while rig.outcome is None or rig.outcome.reason != "squeeze":
        rig.tick()
    rig.take_away()
    task = rig.carry_on()
    assert task.state == "failed"
    assert task.reason.endswith("cube has slipped out of the gripper")


@pytest.mark.slow
def test_a_gripper_held_back_by_safety_does_not_count_as_holding(
    rig: Rig,
) -> None:
    rig.arm.caps = (JointCap(name="gripper", fall=0.02),)
    task = rig.carry_out(THINGS + "do: [{pick: cube}]")
    assert (task.state, task.reason) == ("failed", "picking up cube: it was not caught, 3 times")
    assert rig.phases.count("close") == 3


def test_a_thing_lost_while_the_grip_eases_is_picked_again(rig: Rig) -> None:
    rig.give(THINGS + "do: [{pick: cube}]")
    while rig.outcome is None or rig.outcome.reason != "squeeze":
        rig.tick()
    rig.take_away()
    while rig.outcome.reason != "retreat":
        rig.tick()
    rig.take_away(THERE)
    task = rig.carry_on()
    assert (task.state, task.reason) == ("succeeded", "it holds cube")
    assert rig.phases.count("close") == 2


def test_a_grip_that_squeezes_too_hard_still_is_eased_again(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    squeeze, lags = ArmPlanner.squeeze, list[float]()

    def squeezes(self: ArmPlanner, measured: float, wanted: float, *, moving: bool) -> float:
        place = squeeze(self, measured, wanted, moving=moving)
        if moving:
            lags.append(abs(measured - wanted))
        return wanted + 0.001 if moving and len(lags) == 1 else place  # the first one is too hard

    monkeypatch.setattr(ArmPlanner, "squeeze", squeezes)
    task = rig.carry_out(THINGS + "do: [{pick: cube}]")
    assert (task.state, task.reason) == ("succeeded", "it holds cube")
    assert lags[1] == pytest.approx(lags[0], abs=0.01)
    assert lags[-1] < MOVING[-1] * (GRIPPER.upper - GRIPPER.lower)


def test_a_joint_that_does_not_follow_ends_the_command_after_a_few_tries(rig: Rig) -> None:
    rig.arm.arm.limit({"shoulder_pan": 0.0})  # its servo has no torque
    task = rig.carry_out("do: [{posture: {shoulder_pan: 1.0}}]")
    assert task.state == "failed"
    assert "shoulder_pan is 0." in task.reason
    assert "more than its path_tolerance of 0.3" in task.reason


def test_a_trajectory_waits_for_a_joint_that_safety_slows_down(rig: Rig) -> None:
    rig.carry_out("do: [{posture: {shoulder_pan: 0.0, wrist_roll: 0.0}}]")
    rig.arm.caps = (JointCap(name="shoulder_pan", rise=0.2, fall=0.2),)
    rig.give("do: [{posture: {shoulder_pan: 1.0, wrist_roll: 1.0}}]")
    rig.phases, apart = [], 0.0
    while rig.outcome is None or rig.outcome.reason != "move":
        rig.tick()
    while rig.queue.status.current:
        rig.tick()
        apart = max(apart, abs(rig.arm.measured("shoulder_pan") - rig.arm.measured("wrist_roll")))
    assert rig.queue.status.done[0].state == "succeeded"
    assert rig.phases.count("move") == 1  # it did not plan again
    assert apart < 0.3


def test_a_command_held_back_by_safety_for_long_fails_after_a_few_tries(rig: Rig) -> None:
    rig.arm.caps = (JointCap(name="shoulder_pan", rise=0.0, fall=0.0),)
    task = rig.carry_out("do: [{posture: {shoulder_pan: 1.0}}]")
    assert task.state == "failed"
    assert "shoulder_pan is held back for 2 s" in task.reason
    assert rig.phases.count("move") == 6


def test_a_thing_put_down_is_an_obstacle_while_the_arm_hides_it(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    cube = SeenSolid(id=7, shape="box", size=(0.03, 0.03, 0.03), position=(*THERE, 0.015))
    rig.seen = (cube,)
    plan, known = rig.manipulator._work, list[dict[str, Any]]()

    def work(*given: Any) -> Any:
        known.append(dict(given[-1]))
        return plan(*given)

    monkeypatch.setattr(rig.manipulator, "_work", work)
    rig.give(
        "things: {cube: {box: [0.03, 0.03, 0.03]}}\n"
        "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]}, {posture: home}]"
    )
    while rig.queue.status.current:
        rig.tick()
        rig.seen = () if rig.phases[-1] == "lift" else rig.seen  # hidden from the camera
    assert rig.queue.status.done[0].state == "succeeded"
    pick, _, home = known
    assert list(pick) == ["cube"]
    assert list(home) == ["cube put down"]
    assert home["cube put down"].at == pytest.approx((*ELSEWHERE, 0.015), abs=0.01)


def test_an_arm_that_overlaps_the_thing_it_put_down_continues(rig: Rig) -> None:
    rig.seen = (SeenSolid(id=7, shape="box", size=(0.03, 0.03, 0.03), position=(*THERE, 0.015)),)
    rig.give(
        "things: {cube: {box: [0.03, 0.03, 0.03]}}\n"
        "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]}, {posture: home}]"
    )
    while rig.queue.status.current:
        rig.tick()
        rig.seen = () if rig.phases[-1] == "lift" else rig.seen
        if put := rig.manipulator._put:
            larger = replace(put.solid, box=(0.3, 0.3, 0.3))
            rig.manipulator._put = dataclasses.replace(put, solid=larger)
    assert rig.queue.status.done[0].state == "succeeded"


FAR = "{box: [0.03, 0.03, 0.03]%s}"


@pytest.mark.parametrize(("place", "goes"), [(", at: [0.9, 0, 0.015]", False), ("", True)])
def test_a_body_that_drives_approaches_seen_things_but_not_given_ones(
    tmp_path: Path, place: str, goes: bool
) -> None:
    robot, driver = make_driver("lekiwi", Run(folder=Path()))
    model = driver.arm_model()
    assert model
    rig = Rig(tmp_path, (0.9, 0.0), model.mjcf, "lekiwi")
    cube = SeenSolid(id=7, shape="box", size=(0.03, 0.03, 0.03), position=(0.9, 0.0, 0.015))
    rig.seen = () if place else (cube,)
    rig.give(f"things: {{cube: {FAR % place}}}\ndo: [{{pick: cube}}]")
    outcomes = []
    for _ in range(200):
        command, idle = rig.queue.step(TICK_S, None)
        assert isinstance(command, ArmCommand)
        _, outcome = rig.manipulator.step(
            rig.arm.state(), robot.description(), command, idle, "", rig.seen
        )
        outcomes.append(outcome)
        if outcome.state == "failed":
            break
    assert outcomes[-1].state == "failed"
    assert bool(outcomes[-1].approach) is goes
