"""The page's buttons move an arm's tool, within the ranges and speeds of its joints."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription, Joint, RobotState
from gigabrain_zenoh.geometry.link_model import LinkModel
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.ui.page.tool_jog import tool_speeds
from tests.places import ROOT

BODIES = ROOT / "drivers/gigabrain_drivers/bodies"
ALONG = [(0.06, 0.0, 0.0), (0.0, -0.06, 0.0), (0.0, 0.0, 0.06), (-0.03, 0.03, -0.03)]
READY = {
    "so101": {"shoulder_lift": 0.1, "elbow_flex": 0.3, "wrist_flex": 0.6},
    "piper": {"joint2": 1.2, "joint3": -1.2, "joint5": 0.4},
}


class SimulatedArm:
    """An arm whose joints move at the commanded speeds."""

    def __init__(self, body: str) -> None:
        mjcf = (BODIES / body / "model.xml").read_text("utf-8")
        self.body_description: BodyDescription = load_robot(body).description()
        self.model = LinkModel(mjcf)
        self.reference = ArmKinematics(mjcf, self.body_description.joints)
        self.at = {
            joint.name: READY[body].get(joint.name, 0.0) for joint in self.body_description.joints
        }

    def speeds(self, wanted: tuple[float, float, float]) -> dict[str, float]:
        joints = tuple(Joint(name=name, position=place) for name, place in self.at.items())
        state = RobotState(
            robot_type="arm", pose=Pose(x=0.0, y=0.0, yaw=0.0), velocity=Velocity(), joints=joints
        )
        return tool_speeds(self.model, self.body_description, state, wanted)

    def jog(self, wanted: tuple[float, float, float], seconds: float) -> None:
        for _ in range(round(seconds / 0.04)):
            for name, speed in self.speeds(wanted).items():
                self.at[name] += 0.04 * speed

    @property
    def tool(self) -> np.ndarray:
        return self.reference.forward(
            np.array([self.at[name] for name in self.reference.names])
        ).position


@pytest.mark.long
@pytest.mark.parametrize("body", ["so101", "piper"])
@pytest.mark.parametrize("wanted", ALONG)
def test_the_tool_moves_along_the_line(body: str, wanted: tuple[float, float, float]) -> None:
    arm = SimulatedArm(body)
    before, gripper = arm.tool, arm.at[arm.body_description.joints[-1].name]
    arm.jog(wanted, 0.8)
    assert arm.tool - before == pytest.approx(np.multiply(0.8, wanted), abs=0.002)
    assert arm.at[arm.body_description.joints[-1].name] == gripper


@pytest.mark.long
def test_joints_stay_within_their_limits_at_the_edge_of_the_reach() -> None:
    arm = SimulatedArm("so101")
    limits = {joint.name: joint for joint in arm.body_description.joints}
    for wanted in ((2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, -2.0), (0.0, 0.0, 2.0)):
        for _ in range(100):
            speeds = arm.speeds(wanted)
            assert all(abs(s) <= limits[name].max_speed + 1e-9 for name, s in speeds.items())
            for name, speed in speeds.items():
                arm.at[name] += 0.005 * speed
                assert limits[name].lower <= arm.at[name] <= limits[name].upper
    assert not any(arm.speeds((0.0, 0.0, 0.0)).values())


def test_a_joint_at_its_limit_stops_and_the_others_move() -> None:
    arm = SimulatedArm("so101")
    arm.at["shoulder_pan"] = 1.9
    toward = math.copysign(0.05, arm.tool[1])
    speeds = arm.speeds((0.0, toward, 0.0))
    back = arm.speeds((0.0, -toward, 0.0))
    assert speeds["shoulder_pan"] * back["shoulder_pan"] <= 0
    assert 0.0 in (speeds["shoulder_pan"], back["shoulder_pan"])
    assert any(speeds.values())
    assert any(back.values())


def test_without_the_tool_or_a_measured_joint_nothing_moves() -> None:
    arm = SimulatedArm("so101")
    del arm.at["elbow_flex"]
    assert arm.speeds((0.1, 0.0, 0.0)) == {}
    arm = SimulatedArm("so101")
    assert arm.body_description.arm
    arm.body_description = replace(
        arm.body_description, arm=replace(arm.body_description.arm, tool="none")
    )
    assert arm.speeds((0.1, 0.0, 0.0)) == {}
