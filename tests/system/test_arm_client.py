"""A script that moves the joints of an arm, through the gate of a whole robot."""

import math
from collections.abc import AsyncIterator

import numpy as np
import pytest

from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_zenoh.client.connection import connect
from gigabrain_zenoh.errors import ConfigError, Refused, UnknownName, Unsupported
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.qa.probe import Probe, probing
from gigabrain_zenoh.testing.processes import CommandProcess, Home, robot_of
from gigabrain_zenoh.testing.waiting import until

MODEL = ArmKinematics(
    robot_path("so101").with_name("model.xml").read_text(), load_robot("so101").joints
)
HOME = load_robot("so101").arm.home  # type: ignore[union-attr]
TOLERANCE_RAD = 0.06  # goal tolerance plus an encoder step


@pytest.fixture(scope="module")
def demo(shared_home: Home) -> CommandProcess:
    return shared_home.start("demo", "--body", "so101", "--world", "arena", "--headless")


@pytest.fixture
async def arm(
    shared_home: Home, demo: CommandProcess, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[Probe]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(shared_home.folder / "run"))
    async with probing(await robot_of(shared_home, demo)) as onlooker:
        await until(lambda: onlooker.state.gate.mode == "enabled", "enabled")
        yield onlooker


def posture(arm: Probe) -> tuple[float, ...]:
    return tuple(joint.position for joint in arm.state.joints)


async def test_an_enabled_arm_holds_still(arm: Probe) -> None:
    await arm.ticks(50)
    assert arm.state.gate.commander == "control"
    assert posture(arm) == pytest.approx(HOME, abs=0.03)
    assert arm.state.joints_sent == pytest.approx(HOME, abs=0.03)


async def test_a_script_moves_joints_which_stay_there_afterwards(arm: Probe) -> None:
    async with connect(take=True, source="reach") as script:
        found = await script.set_joint_positions({"shoulder_pan": 0.6, "elbow_flex": 1.0})
        assert found["shoulder_pan"] == pytest.approx(0.6, abs=TOLERANCE_RAD)
        assert found["elbow_flex"] == pytest.approx(1.0, abs=TOLERANCE_RAD)
        assert found["shoulder_lift"] == pytest.approx(HOME[1], abs=TOLERANCE_RAD)
        assert await script.set_joint_position("gripper", 0.5) == pytest.approx(
            0.5, abs=TOLERANCE_RAD
        )
        await arm.ticks(25)
        assert arm.state.joints_sent[0] == pytest.approx(0.6, abs=0.01)
        assert {joint.name for joint in await script.get_joint_states()} == set(found)
        found = await script.set_joint_trajectory(
            [(0.5, {"shoulder_pan": 0.3}), (1.5, {"shoulder_pan": -0.5})]
        )
        assert found["shoulder_pan"] == pytest.approx(-0.5, abs=TOLERANCE_RAD)
    await until(lambda: arm.state.gate.commander == "control", "the brain goes on")
    await arm.ticks(25)
    assert arm.state.joints_sent[0] == pytest.approx(-0.5, abs=0.02)


async def test_impossible_joint_commands_are_refused_and_move_nothing(arm: Probe) -> None:
    before = posture(arm)
    async with connect(take=True, source="wrong") as script:
        with pytest.raises(UnknownName, match="no joint 'elbow'; did you mean 'elbow_flex'"):
            await script.set_joint_position("elbow", 0.1)
        with pytest.raises(ConfigError, match=r"elbow_flex: expected -1\.69 to 1\.69, got 3"):
            await script.set_joint_position("elbow_flex", 3.0)
        with pytest.raises(ConfigError, match=r"elbow_flex: expected -1\.69 to 1\.69, got nan"):
            await script.set_joint_positions({"gripper": 0.1, "elbow_flex": math.nan})
        with pytest.raises(ConfigError, match="expected the position of a joint"):
            await script.set_joint_positions({})
        with pytest.raises(ConfigError, match="more than 3"):
            await script.set_joint_trajectory([(0.1, {"shoulder_pan": 1.5})])
        with pytest.raises(ConfigError, match="other joints than the first"):
            await script.set_joint_trajectory([(1.0, {"gripper": 0.1}), (2.0, {"wrist_flex": 0.1})])
        with pytest.raises(ConfigError, match="at least one point"):
            await script.set_joint_trajectory([])
        with pytest.raises(ConfigError, match="speed: expected more than 0"):
            await script.set_joint_position("gripper", 0.1, speed=0.0)
        with pytest.raises(Unsupported, match="so101 has no base to drive"):
            await script.set_base_velocity(0.1)
        await arm.ticks(3)
        assert arm.state.gate.commander == "control"
        assert posture(arm) == pytest.approx(before, abs=0.01)


async def test_an_estop_holds_the_arm_at_its_position(arm: Probe) -> None:
    async with connect(take=True, source="stopped") as script:
        await script.set_joint_position("shoulder_pan", -1.0, speed=1.0)
        await script.set_joint_position("shoulder_pan", 1.0, speed=0.5, wait=False)
        await until(lambda: arm.state.joints[0].position > -0.7, "on its way")
        await script.estop("test")
        await until(lambda: arm.state.gate.mode == "latched", "latched")
        await arm.ticks(10)
        there = posture(arm)
        await arm.ticks(25)
        assert posture(arm) == pytest.approx(there, abs=0.005)
        assert there[0] < 0.0
        with pytest.raises(Refused, match="the gate has stopped the robot"):
            await script.set_joint_position("shoulder_pan", 0.0)
        await script.release()
        await script.enable(take=True)
        assert posture(arm) == pytest.approx(there, abs=0.01)
        assert await script.set_joint_position("shoulder_pan", 0.0) == pytest.approx(
            0, abs=TOLERANCE_RAD
        )


async def test_an_arm_can_be_made_limp_on_request_and_held_again(arm: Probe) -> None:
    async with connect(take=True, source="letting-go") as script:
        stretched = {"shoulder_lift": 0.0, "elbow_flex": 0.0, "wrist_flex": 0.0}
        await script.set_joint_positions(stretched)
        with pytest.raises(Refused, match="letting-go holds the arm; press the e-stop first"):
            await script.limp()
        await script.estop("test")
        await arm.ticks(25)
        before = posture(arm)
        assert (await script.limp()).text == "all joints are limp"
        await until(lambda: arm.state.limp, "limp")
        await until(lambda: abs(posture(arm)[2] - before[2]) > 0.2, "falling")
        assert (await script.hold()).text == "the joints hold their positions"
        await until(lambda: not arm.state.limp, "held")
        await arm.ticks(25)
        there = posture(arm)
        await arm.ticks(25)
        assert posture(arm) == pytest.approx(there, abs=0.01)
        await script.release()
        await script.enable(take=True)


@pytest.mark.slow
async def test_an_operator_jogs_through_control(arm: Probe) -> None:
    async with connect(source="operator") as script:
        await until(lambda: arm.state.gate.commander == "control", "the brain goes on")
        await arm.ticks(25)
        before = posture(arm)
        for _ in range(20):
            script.jog({"shoulder_pan": 0.4})
            await arm.ticks(3)
        await until(lambda: posture(arm)[0] - before[0] > 0.1, "jogging")
        await arm.ticks(50)
        there = posture(arm)
        await arm.ticks(25)
        assert posture(arm) == pytest.approx(there, abs=0.01)
        assert there[1] == pytest.approx(before[1], abs=0.06)
        assert arm.state.gate.commander == "control"


@pytest.mark.slow
async def test_commands_show_and_move_the_arm(shared_home: Home, arm: Probe) -> None:
    shown = await shared_home.run("arm", "state")
    assert (await shown.ended(), len(shown.out.splitlines())) == (0, 8), shown.err
    jogged = await shared_home.run("arm", "jog", "wrist_roll", "10", "--take")
    assert (await jogged.ended(), jogged.out[:17]) == (0, "wrist_roll is at "), jogged.err
    at_home = await shared_home.run("arm", "home", "--take")
    assert await at_home.ended() == 0, at_home.err
    assert posture(arm) == pytest.approx(HOME, abs=TOLERANCE_RAD)


@pytest.mark.slow
async def test_the_tools_report_no_missing_scans_worlds_or_wheels(
    shared_home: Home, arm: Probe
) -> None:
    await until(lambda: arm.state.gate.commander == "control", "the brain goes on")
    why = await shared_home.run("why")
    links = dict(line.split()[:2] for line in why.out.splitlines() if line.startswith("  "))
    assert {link for link, found in links.items() if found == "BROKEN"} == set(), why.out
    assert (links["world"], links["intent"], links["control"]) == ("ok", "waits", "ok")
    doctor = await shared_home.run("doctor")
    for key in ("scan", "world", "cmd_vel"):
        assert f"robot/{key}" not in doctor.out


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("jog", "wrist", "10"), "no joint 'wrist'"),
        (("jog", "wrist_roll", "1000"), "wrist_roll: expected a goal from -157.2 to 162.8 °, got"),
        (("jog", "wrist_roll", "nan"), "expected a number, got nan"),
        (("limp",), "--yes"),
    ],
)
async def test_a_wrong_command_is_one_clear_line(
    shared_home: Home, arm: Probe, words: tuple[str, ...], text: str
) -> None:
    before = posture(arm)
    wrong = await shared_home.run("arm", *words)
    assert (await wrong.ended(), wrong.out, len(wrong.err.splitlines())) == (2, "", 1)
    assert text in wrong.err
    assert posture(arm) == pytest.approx(before, abs=0.01)


@pytest.mark.slow
async def test_decision_reaches_a_point_and_refuses_an_impossible_one(arm: Probe) -> None:
    async with connect(source="tasks") as robot:
        task = await robot.tasks.carry_out("do: [{reach: [0.22, 0.05, 0.12]}]")
        done = await robot.tasks.result(task)
        assert (done.state, done.reason) == ("succeeded", "")
        assert MODEL.forward(np.array(posture(arm)[:5])).position == pytest.approx(
            (0.22, 0.05, 0.12), abs=0.02
        )
        far = await robot.tasks.carry_out("do: [{reach: [0.9, 0.0, 0.1]}]")
        ended = await robot.tasks.result(far)
        assert ended.state == "failed"
        assert "not reachable: too far by" in ended.reason
        with pytest.raises(Refused, match="no joint 'elbow'"):
            await robot.tasks.carry_out("do: [{posture: {elbow: 0.1}}]")
        with pytest.raises(Refused, match="has no base to drive"):
            await robot.tasks.go_to(1.0, 0.0)
        home = await robot.tasks.carry_out("do: [{posture: home}]")
        assert (await robot.tasks.result(home)).state == "succeeded"
    assert posture(arm) == pytest.approx(HOME, abs=TOLERANCE_RAD)
