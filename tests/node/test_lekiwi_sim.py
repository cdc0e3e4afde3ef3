"""LeKiwi in MuJoCo: a base on omni wheels, whose arm is the model of the so101."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.arm_model import arm_text
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import sim_body
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.scene_message import SceneWriter
from gigabrain_drivers.sim.scene_model import SceneModel
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner, Plan
from gigabrain_zenoh.manipulation.collision import Thing
from gigabrain_zenoh.manipulation.pick_place import NoWay
from gigabrain_zenoh.safety.arm_shape import MujocoArm

TOUCHING_ITS_PLATE = (0.0, 0.1, 1.1, 0.5, 0.0, 0.0)
SETTLE_STEPS, DRIVE_STEPS = 50, 200  # steps of 10 ms
MODEL = catalog.robot_path("lekiwi").with_name("model.xml")
SO101 = mujoco.MjModel.from_xml_path(str(catalog.robot_path("so101").with_name("model.xml")))
COMPARED_FIELDS: Mapping[str, tuple[str, ...]] = {
    "body": ("mass", "inertia", "ipos"),
    "geom": ("type", "size", "quat", "friction", "solref", "solimp", "condim", "contype"),
    "joint": ("range", "damping", "armature", "frictionloss", "axis"),
    "actuator": ("ctrlrange", "forcerange", "gainprm", "biasprm"),
    "site": ("pos", "quat"),
}


def make_lekiwi() -> Simulation:
    robot, _, options, folder = catalog.load_link("lekiwi", Run(folder=Path()))
    return Simulation(sim_body(robot, options, Run(folder=folder)), load_world("arena", 0), 0)  # type: ignore[arg-type]


def arm_model_text() -> str:
    _, driver = catalog.make_driver("lekiwi", Run(folder=Path()))
    model = driver.arm_model()
    assert model
    return model.mjcf


@pytest.mark.parametrize(
    ("twist", "ahead", "aside", "turned"),
    [((0.2, 0, 0), 0.4, 0, 0), ((0, 0.15, 0), 0, 0.3, 0), ((0, 0, -0.8), 0, 0, -1.6)],
)
def test_it_drives_in_all_directions_while_its_arm_holds_still(
    twist: tuple[float, float, float], ahead: float, aside: float, turned: float
) -> None:
    simulation = make_lekiwi()
    arm = simulation.arm
    assert arm
    home = catalog.load_robot("lekiwi").arm.home  # type: ignore[union-attr]
    begin = simulation.truth.pose()
    for _ in range(DRIVE_STEPS):
        simulation.drive(*twist)
        simulation.advance()
        assert arm.truth()[0] == pytest.approx(home, abs=0.01)
    for _ in range(SETTLE_STEPS):
        simulation.drive(0, 0, 0)
        simulation.advance()
    end = simulation.truth.pose()
    x, y = end.x - begin.x, end.y - begin.y
    cos, sin = math.cos(begin.yaw), math.sin(begin.yaw)
    assert (cos * x + sin * y, cos * y - sin * x) == pytest.approx((ahead, aside), abs=0.03)
    assert math.remainder(end.yaw - begin.yaw, math.tau) == pytest.approx(turned, abs=0.08)
    assert (simulation.truth.falls, simulation.truth.contacts) == (0, 0)


def test_its_arm_in_home_posture_stays_within_the_base() -> None:
    simulation = make_lekiwi()
    model, data = simulation.model, simulation.data
    geoms = [n for n in range(model.ngeom) if model.geom(n).name.startswith("robot/arm_")]
    corners = np.array(list(itertools.product((-1, 1), repeat=3)))
    boxes = [
        data.geom_xpos[n] + corners * model.geom_size[n] @ data.geom_xmat[n].reshape(3, 3).T
        for n in geoms
    ]
    away = np.linalg.norm(np.concatenate(boxes)[:, :2] - data.body("robot/base").xpos[:2], axis=1)
    assert len(geoms) == SO101.ngeom
    assert away.max() < 0.15


def test_a_twist_too_fast_for_the_wheels_is_scaled_down() -> None:
    sent = make_lekiwi().drive(0.2, 0.0, 1.0)
    assert sent.linear_x < 0.17
    assert sent.angular_z / sent.linear_x == pytest.approx(5.0)


def test_its_arm_equals_the_so101_in_the_physics_and_in_the_arm_model() -> None:
    whole = mujoco.MjSpec.from_file(str(MODEL)).compile()
    arm_model = mujoco.MjModel.from_xml_string(arm_model_text())
    for kind, fields in COMPARED_FIELDS.items():
        count = {"body": "nbody", "joint": "njnt", "actuator": "nu"}.get(kind, f"n{kind}")
        for number in range(getattr(SO101, count)):
            theirs = getattr(SO101, kind)(number)
            if theirs.name == "world":
                continue
            for model in (whole, arm_model):
                ours = getattr(model, kind)(f"arm_{theirs.name}")
                for field in fields:
                    np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field))
    assert arm_model.njnt == arm_model.nu == SO101.njnt


def test_the_arm_model_includes_its_base() -> None:
    robot = catalog.load_robot("lekiwi")
    shape = MujocoArm(arm_model_text(), robot.description())
    pairs = {shape.describe(pair) for pair in range(len(shape.levers))}
    assert ("self", "base", "arm_gripper") in pairs
    assert ("floor", "arm_gripper", "the floor") in pairs
    assert robot.arm
    postures = np.array([robot.arm.home, TOUCHING_ITS_PLATE])
    within = np.full((2, len(shape.levers)), robot.thresholds.arm_clearance)
    near = shape.near(postures, within)
    assert set(near.postures.tolist()) == {1}
    assert {shape.describe(pair)[:2] for pair in near.pairs.tolist()} == {("self", "base")}


def test_its_arm_has_the_kinematics_of_an_so101_on_its_top_plate() -> None:
    robot, so101 = catalog.load_robot("lekiwi"), catalog.load_robot("so101")
    ours = ArmKinematics(arm_model_text(), robot.joints, "arm_tool")
    path = catalog.robot_path("so101").with_name("model.xml")
    theirs = ArmKinematics(path.read_text(), so101.joints)
    posture = np.array((0.3, -0.2, 0.6, 0.9, 0.1))
    raised = ours.forward(posture).position - theirs.forward(posture).position
    assert raised == pytest.approx((-0.04, 0.0, 0.119))
    assert ours.opening().widest == pytest.approx(theirs.opening().widest)


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ('model="so101" body', 'model="so102" body', "no model 'so102' in its assets"),
        ('body="base" prefix', 'body="bace" prefix', "no body 'bace' to attach"),
        ("../so101", "../so102", "no such file"),
        ("</mujoco>", "", "no XML"),
        ('<body name="base">', '<body name="trunk">', "no body 'base' in the worldbody"),
    ],
)
def test_a_model_that_cannot_be_assembled_is_refused(
    tmp_path: Path, before: str, after: str, problem: str
) -> None:
    folder = tmp_path / "lekiwi"
    folder.mkdir()
    (tmp_path / "so101").symlink_to(MODEL.parent.with_name("so101"))
    path = folder / "model.xml"
    path.write_text(MODEL.read_text().replace(before, after))
    with pytest.raises(ConfigError, match=problem):
        arm_text(path, [])


def test_a_viewer_also_shows_its_unnamed_rollers() -> None:
    simulation = make_lekiwi()
    writer = SceneWriter(simulation.model, simulation.data, "arena")
    scene = writer.scene(1, (), {})
    assert len(set(scene.bodies)) == len(scene.bodies)
    assert SceneModel(scene).place(writer.poses(1))


@pytest.mark.parametrize("distance_m", [0.27, 0.32, 0.36, 0.42, 0.9])
def test_it_approaches_until_it_can_grasp_a_can_from_above(distance_m: float) -> None:
    robot = catalog.load_robot("lekiwi")
    assert robot.arm
    planner = ArmPlanner(arm_model_text(), robot.description())
    home = np.array(robot.arm.home[:-1])
    can = Thing(
        name="can", kind="cylinder", size=(0.0335, 0.12), position=np.array((distance_m, 0, 0.06))
    )
    found = planner.pick(can, [], home, 0, drives=True)
    if distance_m < 0.33:
        assert isinstance(found, Plan)
        assert found.grasp
        assert found.grasp.tilt < math.radians(16)
    else:
        assert isinstance(found, NoWay)
        assert found.stand_off
        assert 0.2 < found.stand_off < 0.29


@pytest.mark.parametrize("place", [(0.3, 0.0), (0.26, 0.05), (0.32, -0.03)])
def test_its_arm_retreats_upwards_from_a_can_that_it_put_down(place: tuple[float, float]) -> None:
    robot = catalog.load_robot("lekiwi")
    assert robot.arm
    planner = ArmPlanner(arm_model_text(), robot.description())
    home, carry = np.array(robot.arm.home[:-1]), np.array(robot.arm.carry[:-1])
    can = Thing(
        name="can", kind="cylinder", size=(0.0335, 0.12), position=np.array((0.26, 0, 0.06))
    )
    picked = planner.pick(can, [], home, 0)
    assert isinstance(picked, Plan)
    assert picked.hold
    put = planner.place(picked.hold, np.array((*place, 0.06)), [], carry)
    assert isinstance(put, Plan)
    retreat = next(phase.arm for phase in put.phases if phase.name == "retreat")
    assert retreat
    first, last = retreat.positions[0], retreat.positions[-1]
    raised = planner.arm.forward(last).position - planner.arm.forward(first).position
    assert raised[2] > 0.05
    put_down = replace(can, position=np.array((*place, 0.06)))
    plan_home = planner.take_posture(
        dict(zip(planner.arm.names, home, strict=True)), [put_down], last, None
    )
    assert isinstance(plan_home, Plan)


def test_it_presses_a_thing_with_the_tip_of_its_gripper() -> None:
    robot = catalog.load_robot("lekiwi")
    assert robot.arm
    planner = ArmPlanner(arm_model_text(), robot.description())
    box = Thing(name="box", kind="box", size=(0.06, 0.06, 0.1), position=np.array((0.28, 0, 0.05)))
    pressed = planner.press(box, None, 0.02, [], np.array(robot.arm.home[:-1]))
    assert isinstance(pressed, Plan), pressed.reason
