"""The URDF of an arm and its frames, against MuJoCo: where links are, what they weigh."""

import math
from xml.etree import ElementTree as xml

import mujoco
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import Arm, Body, Camera, JointDescription
from gigabrain_zenoh.gateway.conversions import description
from gigabrain_zenoh.gateway.conversions.arm_frames import ArmFrames
from gigabrain_zenoh.gateway.conversions.frames import static_frames
from gigabrain_zenoh.gateway.conversions.urdf_elements import angles
from gigabrain_zenoh.geometry.link_model import LinkModel
from gigabrain_zenoh.testing import samples
from tests.unit.gateway.arms import ARMS, body_of

CRANE = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="base_link">
    <geom type="ellipsoid" size=".1 .2 .05" group="3"/>
    <body name="boom" pos="0 0 .5" quat="1 0 1 0">
      <joint name="turn" axis="0 0 1" pos=".1 .2 .3" ref=".4"/>
      <joint name="reach" type="slide" axis="1 0 0" ref=".05"/>
      <geom type="capsule" size=".02 .1" rgba="1 0 0 1" contype="0" conaffinity="0"/>
      <body pos="1 0 0" quat="1 1 1 1"><joint name="loose"/><geom size=".05"/>
        <site name="hook" pos="0 .1 0"/><site name="lamp"/></body>
      <body name="second" pos=".2 0 0">
        <joint name="follows" type="slide" axis="0 1 0" ref=".01"/><geom size=".03"/></body>
    </body>
  </body></worldbody>
  <equality><joint joint1="follows" joint2="reach" polycoef=".02 -.5"/></equality></mujoco>"""


def crane() -> tuple[Body, str]:
    joints = (
        JointDescription(name="turn", lower=-1.0, upper=2.0, max_speed=1.5, max_effort=30.0),
        JointDescription(name="reach", lower=0.0, upper=0.4, max_speed=0.2, part="gripper"),
    )
    arm = Arm(tool="hook", home=(0.0, 0.0))
    about = replace(samples.WAFFLE, joints=joints, arm=arm, drive_type="arm")
    return Body(description=about, link="sim"), CRANE


def made(body: Body, mjcf: str) -> tuple[ArmFrames, xml.Element]:
    arm = description.arm_frames(LinkModel(mjcf), body)
    return arm, xml.fromstring(description.urdf(body, arm))


def vector(element: xml.Element, name: str) -> np.ndarray:
    return np.array([float(word) for word in element.get(name, "0 0 0").split()])


def about_axis(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def pose(rotation: np.ndarray, place: np.ndarray) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation, place
    return found


def origin(element: xml.Element) -> np.ndarray:
    """Return an origin as the specification of URDF has it: roll, pitch, yaw about fixed axes."""
    at = element.find("origin")
    assert at is not None
    roll, pitch, yaw = vector(at, "rpy")
    x, y, z = np.eye(3)
    turn = about_axis(z, yaw) @ about_axis(y, pitch) @ about_axis(x, roll)
    return pose(turn, vector(at, "xyz"))


def forward(robot: xml.Element, positions: dict[str, float]) -> dict[str, np.ndarray]:
    """Return each link in `base_link`, by the text alone."""
    found = {"base_footprint": np.eye(4)}
    waiting = list(robot.findall("joint"))
    while waiting:
        joint = waiting.pop(0)
        parent, child = (joint.find(end).get("link") for end in ("parent", "child"))  # type: ignore[union-attr]
        if parent not in found:
            waiting.append(joint)
            continue
        at, name, mimic = found[parent] @ origin(joint), joint.get("name", ""), joint.find("mimic")
        position = positions.get(name, 0.0)
        if mimic is not None:
            leader = positions[mimic.get("joint", "")]
            position = float(mimic.get("multiplier", 1)) * leader + float(mimic.get("offset", 0))
        axis = joint.find("axis")
        if joint.get("type") == "prismatic":
            at = at @ pose(np.eye(3), position * vector(axis, "xyz"))  # type: ignore[arg-type]
        elif joint.get("type") == "revolute":
            at = at @ pose(about_axis(vector(axis, "xyz"), position), np.zeros(3))  # type: ignore[arg-type]
        found[child or ""] = at
    return found


def by_tf(body: Body, arm: ArmFrames, positions: dict[str, float]) -> dict[str, np.ndarray]:
    """Return each frame in `base_footprint`, by what /tf and /tf_static hold."""
    joints = tuple(samples.Joint(name=name, position=at) for name, at in positions.items())
    state = replace(samples.state(1), joints=joints)
    found = {"base_footprint": np.eye(4)}
    waiting = [*static_frames(body), *arm.static(), *arm.moving(state)]
    while waiting:
        one = waiting.pop(0)
        if one.parent not in found:
            waiting.append(one)
            continue
        turn = np.empty(9)
        x, y, z, w = one.rotation
        mujoco.mju_quat2Mat(turn, np.array((w, x, y, z)))
        at = pose(turn.reshape(3, 3), np.array((one.x, one.y, one.z)))
        found[one.child] = found[one.parent] @ at
    return found


def compare(body: Body, mjcf: str, count: int, names: dict[str, str] | None = None) -> None:
    """Compare all bodies and the tool at random postures; `names` are those of other frames."""
    arm, robot = made(body, mjcf)
    model = mujoco.MjModel.from_xml_string(mjcf)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    tool = body.description.arm.tool if body.description.arm else ""
    for _ in range(count):
        positions = {
            joint.name: float(rng.uniform(joint.lower, joint.upper))
            for joint in body.description.joints
        }
        data.qpos[:] = model.qpos0
        for name, position in positions.items():
            data.joint(name).qpos[0] = position
        for follower in LinkModel(mjcf).followers:
            lead = model.joint(follower.leader).qpos0[0]
            way = positions[follower.leader] - lead
            shift = sum(one * way**power for power, one in enumerate(follower.polynomial))
            data.joint(follower.name).qpos[0] = model.joint(follower.name).qpos0[0] + shift
        mujoco.mj_kinematics(model, data)
        for places in (forward(robot, positions), by_tf(body, arm, positions)):
            for number in range(1, model.nbody):
                name = model.body(number).name
                frame = places[(names or {}).get(name, name)]
                np.testing.assert_allclose(frame[:3, 3], data.xpos[number], atol=1e-7)
                np.testing.assert_allclose(frame[:3, :3].ravel(), data.xmat[number], atol=1e-7)
            np.testing.assert_allclose(places[tool][:3, 3], data.site(tool).xpos, atol=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("name", ARMS)
def test_the_links_of_an_arm_are_where_mujoco_has_them(name: str) -> None:
    compare(*body_of(name), count=100)


def test_the_frame_of_a_camera_moves_with_the_link_that_carries_it() -> None:
    body, mjcf = crane()
    mjcf = mjcf.replace("second", "lamp_link")  # as the frame of the camera is called
    lamp = Camera(name="lamp", link="lamp", x=0.3, yaw=math.pi / 2)
    front = Camera(name="front", x=0.1, z=0.2)
    body = replace(body, description=replace(body.description, cameras=(lamp, front)))
    compare(
        body, mjcf, 5, {"base_link": "arm_base_link", "": "body_3", "lamp_link": "arm_lamp_link"}
    )
    arm, robot = made(body, mjcf)
    quarter = about_axis(np.array((0, 0, 1.0)), math.pi / 2)
    lens = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # its z looks ahead, its y down
    seen = []
    for positions in ({"turn": 0.1, "reach": 0.0}, {"turn": 1.6, "reach": 0.3}):
        tf = by_tf(body, arm, positions)
        for name in ("lamp_optical_frame", "front_optical_frame"):
            np.testing.assert_allclose(forward(robot, positions)[name], tf[name], atol=1e-7)
        place = tf["lamp"] @ pose(quarter @ lens, np.array((0.3, 0.0, 0.0)))
        np.testing.assert_allclose(tf["lamp_optical_frame"], place, atol=1e-7)
        seen.append(tf["lamp_optical_frame"])
    assert not np.allclose(seen[0], seen[1], atol=0.1)


def test_joints_off_their_links_or_at_rest_elsewhere_and_followers_are_described() -> None:
    body, mjcf = crane()
    compare(body, mjcf, 20, {"base_link": "arm_base_link", "": "body_3"})
    arm, robot = made(body, mjcf)
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    assert "loose" not in joints  # nobody measures it
    assert {frame.name for frame in arm.frames} == {
        "arm_base_link", "boom_turn", "boom", "body_3", "hook", "second",
    }  # fmt: skip
    limit = joints["turn"].find("limit")
    assert limit is not None
    assert limit.attrib == {"lower": "-1", "upper": "2", "effort": "30", "velocity": "1.5"}
    follows = joints["follows"]
    limit, mimic = follows.find("limit"), follows.find("mimic")
    assert limit is not None
    assert mimic is not None
    assert mimic.get("joint") == "reach"
    # at 0.01 + 0.02 - 0.5 (reach - 0.05)
    assert (mimic.get("multiplier"), mimic.get("offset")) == ("-0.5", "0.055")
    assert limit.attrib == {
        "lower": "-0.145", "upper": "0.055", "effort": "0", "velocity": "0.1",
    }  # fmt: skip


def test_shapes_are_drawn_where_they_are_seen_and_collide_where_they_are_solid() -> None:
    _, robot = made(*crane())

    def shapes(link: str, part: str) -> list[str]:
        found = robot.findall(f"link[@name='{link}']/{part}/geometry/*")
        return [one.tag for one in found]

    assert shapes("arm_base_link", "visual") == []
    assert shapes("arm_base_link", "collision") == ["sphere"]
    assert shapes("boom", "visual") == ["cylinder", "sphere", "sphere"]
    assert shapes("boom", "collision") == []
    assert shapes("base_link", "visual") == []  # no hull as high as the arm reaches
    used = {one.get("name") for one in robot.findall("link/visual/material")}
    given = {one.get("name"): one[0].get("rgba") for one in robot.findall("material")}
    assert used == set(given)
    assert "1 0 0 1" in given.values()


@pytest.mark.parametrize("name", ARMS)
def test_a_urdf_is_a_tree_with_each_name_once(name: str) -> None:
    _, robot = made(*body_of(name))
    links = [link.get("name") for link in robot.findall("link")]
    children = [joint.find("child").get("link") for joint in robot.findall("joint")]  # type: ignore[union-attr]
    names = [joint.get("name") for joint in robot.findall("joint")]
    assert len(set(links)) == len(links)
    assert len(set(names)) == len(names)
    assert sorted([*children, "base_footprint"]) == sorted(links)  # type: ignore[type-var, list-item]


def test_angles_are_those_of_the_rotation_also_where_the_nose_points_up() -> None:
    rng = np.random.default_rng(0)
    half = math.sqrt(0.5)
    up = [
        (0.0, -half, 0.0, half), (0.0, half, 0.0, half), (0.5, 0.5, -0.5, 0.5),
        (0.5, -0.5, -0.5, -0.5),
    ]  # fmt: skip
    for rotation in (*up, *(rng.normal(size=(100, 4)))):
        x, y, z, w = rotation / np.linalg.norm(rotation)
        expected = np.empty(9)
        mujoco.mju_quat2Mat(expected, np.array((w, x, y, z)))
        roll, pitch, yaw = angles((x, y, z, w))
        axes = np.eye(3)
        turn = about_axis(axes[2], yaw) @ about_axis(axes[1], pitch) @ about_axis(axes[0], roll)
        np.testing.assert_allclose(turn.ravel(), expected, atol=1e-9)
