"""The links of an arm, read without MuJoCo, have the same poses as in MuJoCo."""

import mujoco
import numpy as np
import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.link_model import LinkModel, Place
from tests.places import ROOT

BODIES = ROOT / "drivers/gigabrain_drivers/bodies"
EVERY_NOTATION = """
<mujoco>
  <compiler angle="degree" eulerseq="zYx"/>
  <asset><material name="red" rgba="1 0 0 1"/></asset>
  <default>
    <geom type="box" size=".1 .2 .3" rgba=".1 .2 .3 1"/>
    <default class="round">
      <geom type="capsule" size=".02 .1"/>
      <joint type="slide" axis="0 3 4"/>
      <default class="dark"><geom rgba="0 0 0 1"/></default>
    </default>
  </default>
  <worldbody>
    <geom name="table" type="ellipsoid" pos="0 0 -1" zaxis="1 2 3"/>
    <body name="base" pos="1 2 3" axisangle="0 1 1 40">
      <body name="a" euler="10 20 30" childclass="round">
        <joint name="hinge" type="hinge" axis="1 2 2" pos=".1 .2 .3" ref="20"/>
        <joint name="slide" ref=".1"/>
        <geom name="from_to" fromto="0 0 0 .3 .4 .5"/>
        <geom name="dark" class="dark" xyaxes="1 1 0 -1 1 .5"/>
        <frame pos="0 .5 0" quat="1 1 0 0">
          <geom name="framed" type="cylinder" euler="90 0 0"/>
          <body name="b" pos="0 0 .2" zaxis="0 0 -1">
            <joint name="follower"/>
            <geom name="ball" type="sphere"/>
            <geom name="hidden" group="3"/>
            <geom name="clear" rgba="1 1 1 0"/>
            <geom name="long" type="box" size=".03" fromto="0 0 0 0 0 -1"/>
            <site name="tool" pos=".1 0 0" quat="0 1 0 0"/>
          </body>
        </frame>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="follower" joint2="slide" polycoef=".01 2 3 0 0"/></equality>
</mujoco>
"""


def matrix(place: Place) -> np.ndarray:
    found = np.empty(9)
    mujoco.mju_quat2Mat(found, np.array(place.rotation))
    return found


def check(mjcf: str, positions: dict[str, float], followers: dict[str, float]) -> int:
    """Compare all links and shapes with MuJoCo's; return how many shapes there are."""
    model = mujoco.MjModel.from_xml_string(mjcf)
    data = mujoco.MjData(model)
    for name, position in {**positions, **followers}.items():
        data.qpos[model.joint(name).qposadr[0]] = position
    mujoco.mj_kinematics(model, data)
    read = LinkModel(mjcf)
    places = read.places_in_base(positions)
    for link, place in zip(read.links[1:], places[1:], strict=True):
        sites = [model.site(i).name for i in range(model.nsite)]
        found = data.site(link.name) if link.name in sites else data.body(link.name)
        np.testing.assert_allclose(place.position, found.xpos, atol=1e-9)
        np.testing.assert_allclose(matrix(place), found.xmat, atol=1e-9)
    shown = [i for i in range(model.ngeom) if model.geom_group[i] < 3 and model.geom_rgba[i, 3]]
    owners = [read.links[shape.link].name or "world" for shape in read.shapes]
    assert sorted(owners) == sorted(model.body(model.geom_bodyid[i]).name for i in shown)
    for shape in read.shapes:
        place = places[shape.link] @ shape.place
        (twin,) = (i for i in shown if np.allclose(data.geom_xpos[i], place.position, atol=1e-9))
        np.testing.assert_allclose(matrix(place), data.geom_xmat[twin], atol=1e-9)
        kind = mujoco.mjtGeom(model.geom_type[twin]).name.removeprefix("mjGEOM_").lower()
        count = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)
        assert shape.kind == kind
        np.testing.assert_allclose(shape.size[:count], model.geom_size[twin][:count], atol=1e-9)
        material = model.geom_matid[twin]
        colour = model.geom_rgba[twin]
        if material >= 0 and np.allclose(colour, (0.5, 0.5, 0.5, 1.0)):
            colour = model.mat_rgba[material]
        np.testing.assert_allclose(shape.colour, colour, atol=1e-6)
    check_masses(model, read)
    return len(read.shapes)


def check_masses(model: mujoco.MjModel, read: LinkModel) -> None:
    bodies = [model.body(number).name for number in range(1, model.nbody)]
    for number, link in enumerate(read.links):
        if link.name not in bodies:
            continue
        body = model.body(link.name)
        found = read.inertial(number)
        if found is None:
            assert body.mass == 0
            continue
        assert found.mass == pytest.approx(body.mass[0])
        np.testing.assert_allclose(found.centre, body.ipos, atol=1e-9)
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, body.iquat)
        tensor = axes.reshape(3, 3) @ np.diag(body.inertia) @ axes.reshape(3, 3).T
        np.testing.assert_allclose(found.tensor, tensor, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_every_notation_gives_the_same_poses_as_mujoco(seed: int) -> None:
    hinge, slide = np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
    moved = slide - 0.1
    follows = 0.01 + 2 * moved + 3 * moved**2
    positions = {"hinge": hinge, "slide": slide}
    assert check(EVERY_NOTATION, positions, {"follower": follows}) == 6


def test_masses_of_inertial_elements_and_ellipsoids_match_mujoco() -> None:
    mjcf = """<mujoco><worldbody>
      <body name="given"><geom size="1"/>
        <inertial pos="1 2 3" mass="2" fullinertia="3 4 5 .1 .2 .3"/></body>
      <body name="egg"><geom type="ellipsoid" size=".1 .2 .3" euler="10 20 30" density="20"/></body>
      <body name="light"><geom size="1" mass="0"/><joint/></body></worldbody></mujoco>"""
    read = LinkModel(mjcf)
    check_masses(mujoco.MjModel.from_xml_string(mjcf.replace("<joint/>", "")), read)
    assert [read.inertial(number) is None for number in range(4)] == [True, False, False, True]


@pytest.mark.parametrize("body", ["so101", "piper"])
def test_the_shipped_arms_have_the_same_poses_as_in_mujoco(body: str) -> None:
    mjcf = (BODIES / body / "model.xml").read_text("utf-8")
    model = mujoco.MjModel.from_xml_string(mjcf)
    for posture in np.random.default_rng(0).uniform(*model.jnt_range.T, (5, model.njnt)):
        positions = {model.joint(i).name: place for i, place in enumerate(posture)}
        tied = {"finger_left": positions["gripper"]} if body == "piper" else {}
        for name in tied:
            del positions[name]
        assert check(mjcf, positions, tied) == model.ngeom


def test_a_free_root_has_the_pose_of_the_robot_frame() -> None:
    read = LinkModel(
        "<mujoco><worldbody><body name='base' pos='0 0 1'><freejoint/>"
        "<body name='arm' pos='0 0 .2'><joint name='pan'/></body></body></worldbody></mujoco>"
    )
    assert [place.position for place in read.places_in_base({"pan": 0.3})] == [
        (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.2),
    ]  # fmt: skip


BODY = "<mujoco><worldbody><body>{}</body></worldbody></mujoco>"


@pytest.mark.parametrize(
    ("mjcf", "problem"),
    [
        ("", "no element found"),
        ("<robot/>", "expected the element mujoco, not 'robot'"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><mujoco/>', "declares entities"),
        (BODY.format('<geom size="nan"/>'), "expected numbers, not 'nan'"),
        (BODY.format('<geom size="1e9"/>'), "expected numbers, not '1e9'"),
        (BODY.format('<geom pos="1 2" size="1"/>'), "expected 3 numbers, not '1 2'"),
        (BODY.format('<geom size="wide"/>'), "could not convert"),
        (BODY.format('<geom class="none" size="1"/>'), "unknown class 'none'"),
        (BODY.format('<geom group="x" size="1"/>'), "invalid literal"),
        (BODY.format('<body quat="0 0 0 0"/>'), "a quaternion is zero"),
        (BODY.format("<body/>" * 200), "more than 200 links"),
        (BODY.format('<geom size="1"/>' * 1001), "1000 shapes"),
        (BODY.format("<body>" * 9000 + "</body>" * 9000), "more than 200 links"),
        ("<mujoco>" + "<default>" * 9000 + "</default>" * 9000 + "</mujoco>", "recursion"),
        ("<mujoco/>" + " " * 262_144, "at most 262144 characters"),
    ],
    ids=range(15),
)
def test_an_invalid_model_is_refused_in_one_line(mjcf: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=f"the arm's model cannot be drawn: .*{problem}") as found:
        LinkModel(mjcf)
    assert "\n" not in str(found.value)
