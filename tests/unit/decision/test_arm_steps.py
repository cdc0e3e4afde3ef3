"""Steps of missions for an arm, and refusals before anything moves."""

import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import Camera
from gigabrain_zenoh.decision.tasks import arm_steps
from gigabrain_zenoh.decision.tasks.arm_steps import (
    ArmAction,
    Gripper,
    HandOver,
    Pick,
    PlaceThing,
    Press,
    Reach,
    TakePosture,
)
from gigabrain_zenoh.decision.tasks.mission_files import loads
from gigabrain_zenoh.errors import ConfigError, GigabrainError, Refused

ARM = load_robot("so101").description()
BASE = load_robot("turtlebot3_burger").description()


def test_steps_of_a_mission_are_actions_of_the_arm() -> None:
    mission = loads(
        "things: {can: {cylinder: [0.03, 0.1], at: [0.2, 0, 0.05]}}\n"
        "do: [{reach: [0.2, 0, 0.1]}, {reach: {at: [0.2, 0, 0.1], pitch: 1}}, {posture: home},"
        " {posture: {shoulder_pan: 0.5}}, {gripper: open}, {gripper: 0.3}, {pick: can},"
        " {place: [0.1, 0.1, 0.05]}, {wait: 1}, {press: [0.2, 0, 0.05]}, {press: can},"
        " {press: {at: can, pitch: 0, depth: 0.01, force: 2, seconds: 0}}, {hand_over: {}},"
        " {hand_over: [0.2, 0, 0.2]}, {hand_over: {seconds: 5}}]",
        "mission",
    )
    assert mission.arm_actions == [
        Reach(at=(0.2, 0, 0.1)), Reach(at=(0.2, 0, 0.1), pitch=1), TakePosture("home"),
        TakePosture({"shoulder_pan": 0.5}), Gripper("open"), Gripper(0.3), Pick("can"),
        PlaceThing((0.1, 0.1, 0.05)), Press(at=(0.2, 0, 0.05)), Press(at="can"),
        Press(at="can", pitch=0, depth=0.01, force=2, seconds=0), HandOver(),
        HandOver(at=(0.2, 0, 0.2)), HandOver(seconds=5),
    ]  # fmt: skip
    assert not mission.drives
    arm_steps.check(ARM, mission.arm_actions)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("do: [{pick: can}]", "do[0].pick: no thing 'can'; known: none"),
        ("things: {can: {at: [0, 0, 0]}}\ndo: [{pick: can}]", "expected a box, a cylinder or a sp"),
        ("things: {can: {sphere: 0.1, box: [1, 1, 1], at: [0, 0, 0]}}\ndo: [{pick: can}]",
         "expected a box, a cylinder or a sphere"),
        ("things: {can: {label: can, at: [0, 0, 0]}}\ndo: [{pick: can}]",
         "expected a label that is seen, or a place, not both"),
        ("things: {can: {}}\ndo: [{pick: can}]", "or a label that is seen"),
        ("things: {can: {sphere: -1, at: [0, 0, 0]}}\ndo: [{pick: can}]", "expected a number"),
        ("do: [{reach: [0.2, 0]}]", "do[0].reach"),
        ("do: [{reach: [.nan, 0, 0]}]", ".nan is not allowed; expected a finite number"),
        ("do: [{posture: away}]", "do[0].posture"),
        ("do: [{posture: {}}]", "do[0].posture"),
        ("do: [{gripper: wide}]", "do[0].gripper"),
        ("do: [{place: [0.2, 0, 1.0e+30]}]", "do[0].place"),
        ("do: [{press: can}]", "do[0].press: no thing 'can'; known: none"),
        ("do: [{press: {at: can}}]", "do[0].press: no thing 'can'; known: none"),
        ("do: [{press: [0.2, 0]}]", "do[0].press: expected a list of length >= 3"),
        ("do: [{press: [0.2, 0, .nan]}]", ".nan is not allowed"),
        ("do: [{press: {at: [0.2, 0, 0], depth: 0.5}}]", "do[0].press.depth: expected a number"),
        ("do: [{press: {at: [0.2, 0, 0], force: 0}}]", "do[0].press.force: expected a number"),
        ("do: [{press: {depth: 0.01}}]", "do[0].press: missing field 'at'"),
        ("do: [{hand_over: {secs: 1}}]", "unknown field 'secs'; did you mean 'seconds'?"),
        ("do: [{hand_over: {seconds: 0}}]", "do[0].hand_over.seconds: expected a number > 0.0"),
    ],
)  # fmt: skip
def test_wrong_steps_are_refused_with_their_line(text: str, why: str) -> None:
    with pytest.raises(ConfigError) as refused:
        loads(text, "mission")
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("action", "why"),
    [
        (TakePosture({"elbow": 0.5}), "no joint 'elbow'; did you mean 'elbow_flex'?"),
        (TakePosture({"elbow_flex": 3.0}), "elbow_flex: expected -1.69 to 1.69, got 3"),
        (Gripper(2.0), "gripper: expected -0.174533 to 1.74533, got 2"),
    ],
)
def test_positions_beyond_the_joint_limits_are_refused(action: ArmAction, why: str) -> None:
    with pytest.raises(GigabrainError) as refused:
        arm_steps.check(ARM, [action])
    assert why in str(refused.value)


def test_a_body_without_an_arm_refuses_all_actions() -> None:
    with pytest.raises(GigabrainError, match="turtlebot3_burger has no arm"):
        arm_steps.check(BASE, [Reach(at=(0.2, 0.0, 0.1))])


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arm_steps, "find_spec", lambda name: None if name == "ruckig" else True)
    with pytest.raises(GigabrainError, match=r"needs ruckig; pip install 'gigabrain-zenoh\[arm\]'"):
        arm_steps.check(ARM, [Reach(at=(0.2, 0.0, 0.1))])


def test_a_thing_without_a_place_needs_a_depth_camera() -> None:
    mission = loads("things: {can: {label: can}}\ndo: [{pick: can}]", "mission")
    steps = mission.arm_actions, mission.things.values()
    with pytest.raises(Refused, match="no depth camera; start it with --cameras"):
        arm_steps.check(replace(ARM, cameras=()), *steps)
    arm_steps.check(replace(ARM, cameras=(Camera(name="top", depth=True),)), *steps)


def test_postures_and_places_that_a_body_does_not_have_are_refused() -> None:
    carrying, floorless = load_robot("lekiwi").description(), replace(ARM.arm, floor=None)  # type: ignore[type-var]
    arm_steps.check(carrying, [TakePosture("carry"), PlaceThing((0.3, 0.0))])
    with pytest.raises(Refused, match="so101 has no carry posture"):
        arm_steps.check(ARM, [TakePosture("carry")])
    with pytest.raises(Refused, match="so101 reaches no floor; give a height to place at"):
        arm_steps.check(replace(ARM, arm=floorless), [PlaceThing((0.3, 0.0))])
