"""Joints that viewers of the page move, and the arm that the page draws without a simulation."""

import struct
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import ArmModel, Body, Joint, RobotState
from gigabrain_schemas.brain import JointSpeeds, Twist
from gigabrain_schemas.examples import example
from gigabrain_schemas.sim import SimScene
from gigabrain_schemas.topics import ARM_MODEL, BODY, JOINT_TELEOP, SIM_SCENE, STATE, TELEOP
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.waiting import settle
from gigabrain_zenoh.ui.page import frames
from gigabrain_zenoh.ui.page.frames import Jog, PageView, decoded
from gigabrain_zenoh.ui.steering import TeleopArbiter
from tests.places import ROOT

MODEL = (ROOT / "drivers/gigabrain_drivers/bodies/so101/model.xml").read_text("utf-8")
ARM = load_robot("so101").description()
DRIVES = replace(
    ARM, robot_type="mobile", drive_type="omni", max_linear_speed=0.3, max_lateral_speed=0.3,
    max_angular_speed=1.0,
)  # fmt: skip
PAN = "shoulder_pan"


class Page:
    """The page's view of a robot. It records the commands that result from a viewer's."""

    def __init__(self, body: object = DRIVES) -> None:
        self.net, self.sent = Net(), list[tuple[str, bytes]]()
        self.jogged, self.steered = list[JointSpeeds](), list[Twist]()
        self.view = PageView(self.net.one, lambda slot, frame: self.sent.append((slot, frame)))
        self.net.two.subscribe(JOINT_TELEOP, lambda _key, one: self.jogged.append(one))
        self.net.two.subscribe(TELEOP, lambda _key, one: self.steered.append(one))
        assert body in (ARM, DRIVES)
        self.net.two.publish(BODY, Body(description=body, link="real"))  # type: ignore[arg-type]
        self.arbiter = TeleopArbiter(self.view)

    @property
    def speeds(self) -> list[dict[str, float]]:
        return [dict(zip(one.name, one.velocity, strict=True)) for one in self.jogged]

    def jog(self, speeds: dict[str, float], times_s: Sequence[float], viewer: int = 1) -> bool:
        accepted = [self.arbiter.jog(viewer, speeds, at_s) for at_s in times_s]
        return all(accepted)

    def state(self, *joints: Joint) -> None:
        here = Pose(x=0.0, y=0.0, yaw=0.0)
        state = RobotState(robot_type="so101", pose=here, velocity=Velocity(), joints=joints)
        self.net.two.publish(STATE, state)


async def test_joint_speeds_are_limited_and_start_after_100_ms() -> None:
    page = Page()
    await settle()
    assert page.jog({PAN: -9.0, "none": 1.0}, (1.0, 1.04, 1.08))
    await settle()
    assert page.speeds == []  # a network may have buffered these commands
    assert page.jog({PAN: -9.0, "none": 1.0}, (1.12,))
    assert page.jog({PAN: 0.0}, (1.16,))
    assert page.arbiter.driving(1.16) == 0
    await settle()
    assert page.speeds == [{PAN: -3.0}, {PAN: 0.0}]
    assert page.steered == []


async def test_speeds_of_unknown_joints_are_ignored() -> None:
    page = Page()
    await settle()
    assert page.jog({"none": 1.0}, (1.0, 1.1, 1.2))
    assert page.arbiter.driving(1.2) == 0
    await settle()
    assert page.jogged == []


async def test_base_and_joints_move_at_once_and_stop_separately() -> None:
    page, ahead = Page(), Velocity(linear_x=0.2)
    await settle()
    for at_s in (1.0, 1.1, 1.2):
        page.arbiter.drive(1, ahead, at_s)
        page.jog({PAN: 1.0}, (at_s,))
    assert not page.jog({PAN: 1.0}, (1.2,), viewer=2)
    assert page.jog({PAN: 0.0}, (1.2,), viewer=2)  # it is ignored
    page.arbiter.drive(1, ZERO, 1.24)
    assert page.arbiter.driving(1.24) == 1
    page.jog({PAN: 1.0}, (1.24,))  # the stream continues without a pause
    page.jog({PAN: 0.0}, (1.28,))
    assert page.arbiter.driving(1.28) == 0
    await settle()
    assert [twist.linear_x for twist in page.steered] == [0.2, 0.2, 0.0]
    assert page.speeds == [{PAN: 1.0}, {PAN: 1.0}, {PAN: 1.0}, {PAN: 0.0}]


@pytest.mark.parametrize("end", ["leave", "clear"])
async def test_a_leaving_viewer_or_an_e_stop_ends_both_streams(end: str) -> None:
    page, ahead = Page(), Velocity(linear_x=0.2)
    await settle()
    for at_s in (1.0, 1.1):
        page.arbiter.drive(1, ahead, at_s)
        page.jog({PAN: 1.0}, (at_s,))
    page.arbiter.leave(2)
    assert page.arbiter.driving(1.1) == 1
    if end == "leave":
        page.arbiter.leave(1)
    else:
        page.arbiter.clear()
    await settle()
    assert page.steered[-1].linear_x == 0.0
    assert page.speeds[-1] == {PAN: 0.0}
    assert page.arbiter.driving(1.1) == 0


@pytest.mark.parametrize(
    "content",
    [b"", b"[]", b'{"speeds":{"a":NaN}}', b'{"speeds":{"a":1e999}}', b'{"speeds":{"a":20000}}',
     b'{"speeds":{"a":"fast"}}', b'{"speeds":{"":1}, "more":1}',
     msgspec.json.encode({"speeds": {f"joint{n}": 1.0 for n in range(33)}})],
)  # fmt: skip
def test_invalid_joint_speeds_are_refused(content: bytes) -> None:
    with pytest.raises(ValueError, match=r"JSON|[Ee]xpected|unknown|range|truncated"):
        decoded(content, Jog)
    assert decoded(b'{"speeds":{"pan":-1}}', Jog).speeds == {"pan": -1.0}


def poses_of(frame: bytes) -> np.ndarray:
    return np.frombuffer(frame[8:], "<f4").reshape(-1, 7)


async def test_an_arm_without_a_simulation_is_drawn_by_its_kinematics() -> None:
    page = Page(ARM)
    page.net.two.publish(ARM_MODEL, ArmModel(mjcf=MODEL))
    posture = np.array([0.5, -0.4, 0.8, 0.3, -1.0])
    names = [joint.name for joint in ARM.joints]
    at = dict(zip(names, posture.tolist(), strict=False))
    page.state(*(Joint(name=name, position=position) for name, position in at.items()))
    await settle()
    ((_, scene),) = ((slot, frame) for slot, frame in page.sent if slot == "scene")
    assert ("scene", scene) in page.view.kept_frames()
    shown = msgspec.json.decode(scene[1:], type=SimScene)
    assert len(shown.kinds) == 19
    assert set(shown.kinds) == {1}  # boxes
    owners = np.frombuffer(shown.owners, "<u2")
    assert shown.bodies[owners[-1]] == "robot/jaw"
    ((_, frame),) = ((slot, frame) for slot, frame in page.view.new_frames() if slot == "poses")
    assert struct.unpack_from("<BI", frame[:1] + frame[4:8]) == (frames.POSES, shown.version)
    poses = poses_of(frame)
    assert len(poses) == len(shown.bodies) - 1
    tool = poses[shown.bodies.index("robot/tool") - 1]
    expected = ArmKinematics(MODEL, ARM.joints).forward(posture)
    np.testing.assert_allclose(tool[:3], expected.position, atol=1e-6)


async def test_the_arm_of_a_simulation_is_shown_by_the_simulation() -> None:
    page = Page(ARM)
    page.net.two.publish(ARM_MODEL, ArmModel(mjcf=MODEL))
    await settle()
    page.net.two.publish(SIM_SCENE, example(SimScene))
    page.net.two.publish(ARM_MODEL, ArmModel(mjcf=MODEL))
    page.state(Joint(name=PAN, position=0.1))
    await settle()
    kept = msgspec.json.decode(dict(page.view.kept_frames())["scene"][1:], type=SimScene)
    assert kept.bodies == example(SimScene).bodies
    assert [slot for slot, _ in page.view.new_frames()] == []


async def test_a_broken_arm_model_is_logged_and_draws_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    page = Page(ARM)
    page.net.two.publish(ARM_MODEL, ArmModel(mjcf="<mujoco>"))
    page.state(Joint(name=PAN, position=0.1))
    await settle()
    assert "the arm's model cannot be drawn: no element found" in caplog.text
    assert "scene" not in dict(page.sent)
    assert list(page.view.new_frames()) == []
