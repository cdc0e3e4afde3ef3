"""Drawing of an arm for viewers: its shapes, and frames that agree with the kinematics."""

import logging
from functools import partial

import numpy as np
import pytest

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import ArmModel, Joint, RobotState
from gigabrain_schemas.topics import ARM_MODEL, STATE
from gigabrain_zenoh.geometry.link_model import Place
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.recording.drawing import Drawer
from tests.places import ROOT
from tests.system.foxglove_viewer import fields

BODIES = ROOT / "drivers/gigabrain_drivers/bodies"
CUBES, SPHERES, CYLINDERS = 8, 9, 10  # fields of a foxglove.SceneEntity


def model_of(body: str) -> ArmModel:
    return ArmModel(mjcf=(BODIES / body / "model.xml").read_text("utf-8"))


def drawn(drawer: Drawer, topic: str, state: RobotState) -> list[bytes]:
    return [one.data for one in drawer.draw(STATE, state) if one.topic == topic]


def state_of(positions: dict[str, float]) -> RobotState:
    joints = tuple(Joint(name=name, position=place) for name, place in positions.items())
    here = Pose(x=1.0, y=2.0, yaw=0.5)
    return RobotState(robot_type="arm", pose=here, velocity=Velocity(), joints=joints)


def numbers(data: bytes, names: tuple[int, ...]) -> list[float]:
    found = dict(fields(data))
    return [found.get(name, 0.0) for name in names]


def place_of(position: bytes, rotation: bytes) -> Place:
    x, y, z = numbers(position, (1, 2, 3))
    i, j, k, w = numbers(rotation, (1, 2, 3, 4))
    return Place((x, y, z), (w, i, j, k))


def frames(data: bytes) -> dict[str, tuple[str, Place]]:
    """Return parent and place of each frame of a foxglove.FrameTransforms."""
    found = {}
    for _, transform in fields(data):
        one = dict(fields(transform))
        found[one[3].decode()] = one[2].decode(), place_of(one[4], one[5])
    return found


def in_base(tree: dict[str, tuple[str, Place]], frame: str) -> Place:
    place = Place()
    while frame != "base_link":
        frame, step = tree[frame]
        place = step @ place
    return place


def axes(place: Place) -> Floats:
    ends = [Place((x, y, z)) for x, y, z in np.eye(3)]
    return np.array([np.subtract((place @ end).position, place.position) for end in ends]).T


@pytest.mark.parametrize("body", ["so101", "piper"])
def test_the_frames_lead_to_the_tool_as_the_kinematics_have_it(body: str) -> None:
    about, model, drawer = load_robot(body).description(), model_of(body), Drawer()
    list(drawer.draw(ARM_MODEL, model))
    kinematics = ArmKinematics(model.mjcf, about.joints)
    lower, upper = ([getattr(joint, end) for joint in about.joints] for end in ("lower", "upper"))
    for posture in np.random.default_rng(1).uniform(lower, upper, (5, len(about.joints))):
        positions = dict(zip([one.name for one in about.joints], posture.tolist(), strict=True))
        (data,) = drawn(drawer, "/viz/arm_tf", state_of(positions))
        tool = in_base(frames(data), "arm/tool")
        expected = kinematics.forward(posture[: len(kinematics.joints)])
        np.testing.assert_allclose(tool.position, expected.position, atol=1e-9)
        np.testing.assert_allclose(axes(tool), expected.axes, atol=1e-9)


def test_each_link_has_its_shapes_in_a_frame_that_is_sent() -> None:
    drawer = Drawer()
    (scene,) = drawer.draw(ARM_MODEL, model_of("piper"))
    assert (scene.topic, scene.schema().name) == ("/viz/arm", "foxglove.SceneUpdate")
    (data,) = drawn(drawer, "/viz/arm_tf", state_of({"joint1": 0.0}))
    shapes: dict[str, list[int]] = {}
    for _, entity in fields(scene.data):
        frame = dict(fields(entity))[2].decode()
        shapes[frame] = sorted(number for number, _ in fields(entity) if number in range(7, 15))
    assert set(shapes) == set(frames(data)) - {"arm/tool"}
    assert shapes["arm/base"] == [CYLINDERS, CYLINDERS]
    assert shapes["arm/link3"] == [SPHERES, SPHERES, CYLINDERS, CYLINDERS]  # one is a capsule
    assert shapes["arm/finger_left"] == [CUBES, CUBES]


def test_a_box_has_its_full_size_place_and_colour() -> None:
    (scene,) = Drawer().draw(ARM_MODEL, model_of("so101"))
    entities = [dict(fields(entity)) for _, entity in fields(scene.data)]
    (jaw,) = (entity for entity in entities if entity[3] == b"arm/jaw")
    box = dict(fields(jaw[CUBES]))  # the last of its kind: pad_moving
    pose = dict(fields(box[1]))
    assert place_of(pose[1], pose[2]).position == pytest.approx((0.0737, -0.0188, -0.0076))
    assert numbers(box[2], (1, 2, 3)) == pytest.approx([0.018, 0.016, 0.008])
    assert numbers(box[3], (1, 2, 3, 4)) == pytest.approx([0.2, 0.2, 0.22, 1.0])


def test_a_second_model_replaces_the_first_and_a_wrong_one_is_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    drawer = Drawer()
    seen = partial(drawn, drawer, "/viz/arm_tf", state_of({"gripper": 0.1}))
    assert seen() == []
    list(drawer.draw(ARM_MODEL, model_of("so101")))
    assert "arm/jaw" in frames(seen()[0])
    (scene,) = drawer.draw(ARM_MODEL, model_of("piper"))
    gone = [data for number, data in fields(scene.data) if number == 1]
    assert any(b"arm/jaw" in data for data in gone)
    assert "arm/jaw" not in frames(seen()[0])
    with caplog.at_level(logging.WARNING):
        assert list(drawer.draw(ARM_MODEL, ArmModel(mjcf="<robot/>"))) == []
    assert "expected the element mujoco" in caplog.text
    assert seen() == []
