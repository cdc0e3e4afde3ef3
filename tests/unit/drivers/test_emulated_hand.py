"""The hand of a person at an emulated arm."""

import math

import pytest

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.emulators.hand import Hand, posture_in
from gigabrain_zenoh.errors import ConfigError, UnknownName

ARM = load_robot("so101").joints
PIPER = load_robot("piper").joints
REST = {joint.name: 0.1 for joint in ARM}


def test_a_hand_moves_a_joint_at_its_own_speed_and_holds_the_others() -> None:
    hand = Hand(ARM)
    hand.move({"elbow_flex": 0.5})
    places = [hand.step(REST, limp=True)["elbow_flex"] for _ in range(50)]
    assert places[:2] == pytest.approx([0.11, 0.12])
    assert places[-1] == 0.5
    assert {**hand.step(REST, limp=True), "elbow_flex": 0.1} == REST


def test_it_waits_until_the_motors_are_off_and_begins_where_the_joints_are() -> None:
    hand = Hand(ARM)
    hand.move({"elbow_flex": 0.5})
    assert not hand.step(REST, limp=False)
    assert hand.step(REST | {"elbow_flex": 0.3}, limp=True)["elbow_flex"] == pytest.approx(0.31)
    assert not hand.step(REST, limp=False)
    assert hand.step(REST, limp=True)["elbow_flex"] == pytest.approx(0.11)


def test_it_is_taken_away() -> None:
    hand = Hand(ARM)
    hand.move({"elbow_flex": 0.5})
    assert hand.step(REST, limp=True)
    hand.move({})
    assert not hand.step(REST, limp=True)


def test_degrees_and_millimetres_become_positions() -> None:
    found = posture_in(["elbow_flex=30", "gripper=-5"], ARM)
    assert found == pytest.approx({"elbow_flex": math.radians(30), "gripper": math.radians(-5)})
    sliding = PIPER[-1]
    assert posture_in([f"{sliding.name}=20"], PIPER) == {sliding.name: 0.02}
    assert posture_in(["off"], ARM) == {}


@pytest.mark.parametrize(
    ("word", "error"),
    [
        ("elbow_flex=100", "elbow_flex: expected -97 to 97 deg, such as elbow_flex=10"),
        ("elbow_flex=nan", "elbow_flex: expected -97 to 97 deg, such as elbow_flex=10"),
        ("elbow_flex", "elbow_flex: expected -97 to 97 deg, such as elbow_flex=10"),
    ],
)
def test_wrong_positions_are_refused(word: str, error: str) -> None:
    with pytest.raises(ConfigError) as found:
        posture_in([word], ARM)
    assert str(found.value) == error


def test_an_unknown_joint_is_refused() -> None:
    with pytest.raises(UnknownName, match="no joint 'elbow'"):
        posture_in(["elbow=3"], ARM)
    with pytest.raises(UnknownName, match="known: off"):
        posture_in(["elbow=3"], ())
