"""An arm presses buttons in MuJoCo, and hands over a held thing."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gigabrain_zenoh.errors import Refused
from tests.node.arm_rig import THINGS, Rig

# a panel with a button; its spring needs 1 to 2 N over its travel of 6 mm
PANEL = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="2 2 .1"/>
  <body name="panel" pos="{at}" euler="0 {turn} 0">
    <geom type="box" size=".03 .03 .015" pos="0 0 -.031"/>
    <body name="button"><joint name="button" type="slide" axis="0 0 1" range="-.006 0"
      limited="true" stiffness="170" springref=".006" damping="2"/>
      <geom type="cylinder" size=".014 .004" pos="0 0 -.004" mass=".02"/></body></body>
  <body name="thing" pos="0 -1 .1"/></worldbody></mujoco>"""
FACING_UP = {"at": "0.25 0 0.05", "turn": "0"}  # on the table
FACING_ARM = {"at": "0.30 0 0.15", "turn": "-90"}  # on a wall


def rig_with_panel(folder: Path, body: str, **where: str) -> Rig:
    (folder / "panel.xml").write_text(PANEL.format(**where))
    world = folder / "panel.yaml"
    world.write_text("model: panel.xml\nstart: [0.0, 0.0, 0.0]\n")
    return Rig(folder, body=body, world=world)


def run_and_measure_button(rig: Rig, text: str) -> tuple[str, str, float]:
    """Return the final state and reason of a mission, and the maximum travel of the button [m]."""
    rig.add_mission(text)
    data = rig.arm.simulation.data
    deepest = 0.0
    while rig.queue.status.current:
        rig.tick()
        deepest = min(deepest, float(data.joint("world/button").qpos[0]))
    done = rig.queue.status.done[0]
    assert abs(data.joint("world/button").qpos[0]) < 0.001  # released
    return done.state, done.reason, -deepest


@pytest.mark.parametrize(
    ("body", "where", "step"),
    [
        ("so101", FACING_UP, "press: [0.25, 0, 0.05]"),
        ("so101", FACING_ARM, "press: {at: [0.30, 0, 0.15], pitch: 0}"),
        ("so101", FACING_UP, "press: bell"),
        ("piper", FACING_UP, "press: [0.25, 0, 0.05]"),
    ],
)
def test_a_button_is_pressed_and_released(
    tmp_path: Path, body: str, where: dict[str, str], step: str
) -> None:
    rig = rig_with_panel(tmp_path, body, **where)
    bell = "things: {bell: {box: [0.06, 0.06, 0.05], at: [0.25, 0, 0.025]}}\n"
    state, reason, depth = run_and_measure_button(
        rig, f"{bell if 'bell' in step else ''}do: [{{{step}}}]"
    )
    rig.manipulator.close()
    assert state == "succeeded", reason
    assert reason.startswith("pressed with")
    assert depth > 0.0055
    assert rig.arm.broken == 0


def test_a_press_without_contact_fails_and_backs_off(tmp_path: Path) -> None:
    rig = rig_with_panel(tmp_path, "so101", **FACING_UP)
    state, reason, depth = run_and_measure_button(
        rig, "do: [{press: {at: [0.2, 0.1, 0.12], depth: 0.02}}]"
    )
    rig.manipulator.close()
    assert (state, depth) == ("failed", 0.0)
    assert reason.endswith(": nothing was touched up to 2 cm behind that place")
    tool = rig.planner.arm.forward(
        np.array([rig.arm.measured(name) for name in rig.planner.arm.names])
    )
    assert math.dist(tool.position, (0.2, 0.1, 0.12)) == pytest.approx(0.04, abs=0.01)


def test_a_button_out_of_reach_is_not_pressed(tmp_path: Path) -> None:
    rig = rig_with_panel(tmp_path, "so101", **FACING_UP)
    before = rig.arm.posture(rig.arm.arm.names)
    state, reason, _ = run_and_measure_button(rig, "do: [{press: [0.8, 0, 0.1]}]")
    rig.manipulator.close()
    assert state == "failed"
    assert "too far by" in reason
    assert rig.arm.posture(rig.arm.arm.names) == pytest.approx(before, abs=1e-3)


def test_an_interrupted_press_starts_again(tmp_path: Path) -> None:
    rig = rig_with_panel(tmp_path, "so101", **FACING_UP)
    rig.add_mission("do: [{press: [0.25, 0, 0.05]}]")
    while rig.outcome is None or rig.outcome.reason != "press":
        rig.tick()
    for _ in range(50):
        rig.tick()
    rig.held = "the gate is latched: e-stop"
    for _ in range(20):
        rig.tick()
    rig.held = ""
    task = rig.run_until_done()
    rig.manipulator.close()
    assert task.state == "succeeded", task.reason


@pytest.fixture
def offering(tmp_path: Path) -> Any:
    """Return an arm that offers a cube."""
    rig = Rig(tmp_path)
    rig.add_mission(THINGS + "do: [{pick: cube}, {hand_over: {seconds: 8}}]")
    while rig.phases[-1:] != [
        "waiting for a person to pull at cube; `gigabrain task resume` opens the gripper"
    ]:
        rig.tick()
        assert rig.queue.status.current, rig.queue.status.done
    yield rig
    rig.manipulator.close()


def has_let_go(rig: Rig) -> bool:
    """Return whether the gripper is empty, and the arm is at home."""
    assert rig.arm.description.arm
    home = rig.arm.description.arm.home[:5]
    measured = [rig.arm.measured(name) for name in rig.planner.arm.names]
    return rig.manipulator._grip.hold is None and measured == pytest.approx(home, abs=0.05)


def test_the_gripper_lets_go_when_somebody_pulls_at_the_thing(offering: Rig) -> None:
    place = offering.arm.thing()
    assert place[0] > 0.15
    assert place[2] > 0.12
    for _ in range(100):
        offering.tick()
    assert offering.outcome
    assert offering.outcome.activity == "offering"  # the cube's weight is no pull
    body = offering.arm.simulation.model.body("world/thing").id
    offering.arm.simulation.data.xfrc_applied[body, :3] = 3.0, 0.0, 1.5
    task = offering.run_until_done()
    assert task.state == "succeeded", task.reason
    assert has_let_go(offering)


def test_a_thing_taken_from_the_gripper_counts_as_handed_over(offering: Rig) -> None:
    for _ in range(30):
        offering.tick()
    offering.move_cube()
    assert offering.run_until_done().state == "succeeded"
    assert has_let_go(offering)


def test_the_gripper_lets_go_on_request(offering: Rig) -> None:
    assert offering.queue.resume("") == "mission-1 opens the gripper"
    assert offering.run_until_done().state == "succeeded"
    assert has_let_go(offering)
    with pytest.raises(Refused):
        offering.queue.resume("")


def test_a_thing_that_nobody_takes_is_kept_and_the_step_fails(offering: Rig) -> None:
    task = offering.run_until_done()
    assert task.state == "failed"
    assert task.reason == "no person took cube within 8 s; the gripper still holds it"
    assert offering.arm.thing()[2] > 0.12
