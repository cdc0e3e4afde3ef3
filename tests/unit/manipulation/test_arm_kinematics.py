"""Kinematics compared with MuJoCo's, and refused models."""

import mujoco
import numpy as np
import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.descent import tool_pose
from tests.unit.manipulation.arms import JOINTS, MODEL, arm, postures

TEXT = MODEL.read_text()


def test_the_arm_has_the_mass_of_the_real_one() -> None:
    model = mujoco.MjModel.from_xml_path(str(MODEL))
    assert model.body_mass.sum() == pytest.approx(0.632, abs=0.001)


def test_the_pose_of_the_tool_is_that_of_mujoco() -> None:
    model = mujoco.MjModel.from_xml_path(str(MODEL))
    data = mujoco.MjData(model)
    frame, joints = np.empty((3, 4)), np.empty((5, 2, 3))
    for posture in postures(50):
        data.qpos[:5] = posture
        mujoco.mj_forward(model, data)
        tool = data.site("tool")
        found = arm().forward(posture)
        tool_pose(arm().chain, posture, frame, joints)
        for place, axes in ((found.position, found.axes), (frame[:, 3], frame[:, :3])):
            assert np.allclose(place, tool.xpos, atol=1e-9)
            assert np.allclose(axes.ravel(), tool.xmat, atol=1e-9)


def test_the_jacobian_is_the_slope_of_the_pose() -> None:
    for posture in postures(10):
        frame, jacobian = arm().jacobian(posture)
        jacobian = jacobian.copy()
        for joint in range(5):
            nudged = posture.copy()
            nudged[joint] += 1e-6
            moved = arm().forward(nudged)
            speed = (moved.position - frame.position) / 1e-6
            assert np.allclose(speed, jacobian[:3, joint], atol=1e-5)
            turned = (moved.axes - frame.axes) @ frame.axes.T / 1e-6
            about = (turned[2, 1], turned[0, 2], turned[1, 0])
            assert np.allclose(about, jacobian[3:, joint], atol=1e-5)


def test_the_gripper_opens_when_its_joint_turns() -> None:
    opening = arm().opening()
    assert opening.widest > 0.08
    for width in (0.01, 0.02, 0.04):
        position = opening.position(width)
        assert opening.middle(position) == pytest.approx(width / 2, abs=0.001)
    assert opening.position(0.02) < opening.position(0.04)


def test_poses_are_in_the_frame_of_a_driving_base() -> None:
    driving = TEXT.replace('<body name="base">', '<body name="base" pos="1 2 3"><freejoint/>')
    frame = ArmKinematics(driving, JOINTS).forward(np.zeros(5))
    assert np.allclose(frame.position, arm().forward(np.zeros(5)).position)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (" " * 262_145, "262145 characters"),
        ('<mujoco><include file="a.xml"/></mujoco>', "'<include'"),
        ('<mujoco><asset><mesh name="a"/></asset></mujoco>', "'<mesh'"),
        ('<mujoco><asset><hfield name="a"/></asset></mujoco>', "'<hfield'"),
        ('<mujoco><asset><texture file="a.png"/></asset></mujoco>', "'file='"),
        ("", "cannot be used"),
        ("<mujoco>", "cannot be used"),
        ("<mujoco/>", "shoulder_pan"),
        (TEXT.replace('site name="tool"', 'site name="tip"'), "tool"),
        (TEXT.replace('"elbow_flex"', '"elbow"'), "elbow_flex"),
    ],
)
def test_an_unusable_model_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        ArmKinematics(text, JOINTS)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
