"""Arm missions that are paused or interrupted by another task in the middle of a step."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import Intent, JointTarget
from gigabrain_schemas.safety import JointCap
from gigabrain_zenoh.decision.manipulator import HOLD_UPS
from gigabrain_zenoh.decision.tasks.mission_files import loads
from tests.node.arm_rig import CUBE_PLACE, NEW_PLACE, THINGS, Rig

PLACE = THINGS + "do: [{pick: cube}, {place: [0.1388, 0.15, 0.015]}]"
PRESS = THINGS + "do: [{press: cube}]"


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.manipulator.close()


def run_until_phase(rig: Rig, phase: str) -> None:
    while rig.phases[-1:] != [phase]:
        rig.tick()
        assert rig.queue.status.current, rig.queue.status.done


def pause(rig: Rig) -> None:
    rig.queue.pause("", "ann")
    for _ in range(25):
        rig.tick()
    rig.queue.resume("")


def run_preempting_mission(rig: Rig, text: str) -> None:
    rig.queue.add_mission(loads(text, "mission"), "mission", "preempt", "bob")
    while not rig.queue.status.done:
        rig.tick()
    assert rig.queue.status.done[0].state == "succeeded"


@pytest.mark.parametrize("other_mission", ["", "do: [{posture: home}]"])
def test_a_put_down_thing_stays_there_when_the_step_continues(rig: Rig, other_mission: str) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "retreat")
    rig.tick()
    things = rig.queue.saved.jobs[0].things
    assert things
    assert things["cube"].at == pytest.approx((*NEW_PLACE, 0.015), abs=0.01)
    run_preempting_mission(rig, other_mission) if other_mission else pause(rig)
    task = rig.run_until_done()
    assert (task.id, task.state, task.reason) == ("mission-1", "succeeded", "")
    assert rig.arm.thing()[:2] == pytest.approx(NEW_PLACE, abs=0.012)


@pytest.mark.parametrize("other_mission", ["", "do: [{posture: home}]"])
def test_a_press_is_not_repeated_when_the_step_continues(rig: Rig, other_mission: str) -> None:
    rig.add_mission(PRESS)
    run_until_phase(rig, "retreat")
    run_preempting_mission(rig, other_mission) if other_mission else pause(rig)
    task = rig.run_until_done()
    assert (task.id, task.state) == ("mission-1", "succeeded")
    assert task.reason.startswith("pressed with ")
    assert rig.phases.count("press") == 1


def test_a_pause_in_the_last_tick_of_a_step_keeps_its_result(rig: Rig) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "retreat")
    while rig.outcome is None or rig.outcome.state == "running":
        rig.tick()
    pause(rig)
    assert rig.run_until_done().state == "succeeded"


@pytest.mark.parametrize("cancelled", [False, True])
@pytest.mark.parametrize("phase", ["descend", "close", "press"])
def test_the_next_task_backs_off_from_the_thing_at_the_gripper(
    rig: Rig, phase: str, cancelled: bool
) -> None:
    rig.add_mission(PRESS if phase == "press" else PLACE)
    run_until_phase(rig, phase)
    for _ in range(20):
        rig.tick()
    if cancelled:
        rig.queue.cancel("", "ann")
        rig.tick()
    rig.phases = []
    task = rig.run_mission("do: [{posture: {shoulder_pan: 1.0}}]")
    assert (task.state, task.reason) == ("succeeded", "")
    assert rig.phases.index("retreat") < rig.phases.index("move")
    assert rig.arm.thing()[:2] == pytest.approx(CUBE_PLACE, abs=0.01)


def test_the_next_task_backs_off_from_the_put_down_thing(rig: Rig) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "retreat")
    rig.tick()
    rig.phases = []
    rig.run_mission("do: [{posture: {shoulder_pan: -0.5}}]")
    assert rig.arm.thing()[:2] == pytest.approx(NEW_PLACE, abs=0.012)
    assert rig.phases.index("retreat") < rig.phases.index("move")


@pytest.mark.parametrize("cancelled", [False, True])
def test_the_next_task_backs_off_from_the_thing_being_released(rig: Rig, cancelled: bool) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "lift")
    pause(rig)  # where the held thing was to go
    run_until_phase(rig, "traverse")
    run_until_phase(rig, "open")
    for _ in range(15):
        rig.tick()
    if cancelled:
        rig.queue.cancel("", "ann")
        rig.tick()
    rig.phases = []
    assert rig.run_mission("do: [{posture: {shoulder_pan: -0.5}}]").state == "succeeded"
    assert rig.arm.thing()[:2] == pytest.approx(NEW_PLACE, abs=0.012)
    assert rig.phases.index("retreat") < rig.phases.index("move")


@pytest.mark.parametrize("ticks", [1, 15, 30])
@pytest.mark.parametrize("other_mission", ["", "do: [{posture: home}]"])
def test_a_thing_is_put_down_even_if_its_release_is_interrupted(
    rig: Rig, other_mission: str, ticks: int
) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "traverse")
    run_until_phase(rig, "open")
    for _ in range(ticks):
        rig.tick()
    run_preempting_mission(rig, other_mission) if other_mission else pause(rig)
    task = rig.run_until_done()
    assert (task.state, task.reason) == ("succeeded", "")
    assert rig.arm.thing()[:2] == pytest.approx(NEW_PLACE, abs=0.012)


def test_after_a_failure_near_a_thing_the_next_command_backs_off(rig: Rig) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "descend")
    rig.manipulator._hold_ups = HOLD_UPS
    rig.arm.caps = tuple(JointCap(name=name, rise=0.0, fall=0.0) for name in rig.planner.arm.names)
    assert rig.run_until_done().state == "failed"
    rig.arm.caps, rig.phases = (), []
    assert rig.run_mission("do: [{posture: {shoulder_pan: 1.0}}]").state == "succeeded"
    assert rig.phases.index("retreat") < rig.phases.index("move")


def test_an_interrupted_retreat_continues(rig: Rig) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "lift")
    rig.move_cube()
    run_until_phase(rig, "retreat")
    rig.tick()
    pause(rig)
    rig.phases = []
    run_until_phase(rig, "retreat")
    assert "move" not in rig.phases


def test_an_arm_does_not_back_off_after_its_base_moved(rig: Rig) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "descend")
    rig.queue.cancel("", "ann")
    rig.tick()
    before, rig.phases = rig.arm.state, []
    rig.arm.state = lambda: replace(before(), pose=Pose(x=0.1, y=0.0, yaw=0.0))  # type: ignore[method-assign]
    assert rig.run_mission("do: [{posture: {shoulder_pan: 1.0}}]").state == "succeeded"
    assert "retreat" not in rig.phases


@pytest.mark.parametrize("paused", [False, True])
def test_an_arm_does_not_back_off_after_an_operator_moved_it_away(rig: Rig, paused: bool) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "descend")
    rig.queue.pause("", "ann") if paused else rig.queue.cancel("", "ann")
    rig.tick()
    away = tuple(JointTarget(name=name, position=0.3) for name in rig.planner.arm.names)
    for _ in range(200):
        rig.arm.step(Intent(joints=away, behaviour="test", reason="jog"))
    rig.phases = []
    if paused:
        rig.queue.resume("")
        assert rig.run_until_done().state == "succeeded"
        assert rig.phases.index("descend") < rig.phases.index("retreat")
    else:
        assert rig.run_mission("do: [{posture: {shoulder_pan: 1.0}}]").state == "succeeded"
        assert "retreat" not in rig.phases


def test_a_thing_moved_by_an_operator_is_not_recorded_at_its_planned_place(rig: Rig) -> None:
    rig.add_mission(PLACE)
    run_until_phase(rig, "traverse")
    run_until_phase(rig, "open")
    rig.tick()
    rig.queue.pause("", "ann")
    rig.tick()
    let_go, recorded = rig.manipulator._let_go, []
    rig.manipulator._let_go = lambda state: recorded.append(let_go(state))  # type: ignore[method-assign]
    away = dict.fromkeys(rig.planner.arm.names, 0.3)
    gripped = {one.name: one.position for one in rig.arm.state().joints}["gripper"]
    for gripper in (gripped, 1.0):
        goals = (away | {"gripper": gripper}).items()
        joints = tuple(JointTarget(name=name, position=position) for name, position in goals)
        for _ in range(200):
            rig.arm.step(Intent(joints=joints, behaviour="test", reason="jog"))
    rig.queue.resume("")
    assert rig.run_until_done().state == "failed"
    assert recorded == []
