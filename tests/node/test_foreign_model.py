"""Public MuJoCo models are driven unedited, by a table of names in the robot's file."""

import dataclasses
import logging
import math
import re
from pathlib import Path

import pytest

from gigabrain_drivers.driver.catalog import load_link, load_robot, make_driver, robot_files
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.world import Pose, World
from gigabrain_zenoh.errors import ConfigError

# no sensors, lidar site or free joint; geoms in groups 2 and 3; wheels with reversed axes;
# a motor on one wheel only; a caster, a keyframe, options and a scene
MODEL = """
<mujoco model="cart">
  <compiler angle="radian" autolimits="true"/>
  <option integrator="Euler" timestep="0.001"/>
  <size njmax="500" nconmax="100"/>
  <default>
    <default class="visual"><geom group="2" contype="0" conaffinity="0" mass="0"/></default>
    <default class="collision"><geom group="3"/></default>
    <default class="wheel">
      <joint axis="0 0 -1" damping=".01" armature=".005"/>
      <motor ctrlrange="-1 1" gear="2"/>
    </default>
  </default>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="base_link">
      <inertial pos="-.05 0 .1" mass="8" diaginertia=".1 .1 .1"/>
      <geom class="visual" type="box" pos="-.05 0 .12" size=".18 .14 .06" rgba=".2 .5 .2 1"/>
      <geom class="collision" type="box" pos="-.05 0 .12" size=".18 .14 .06" mass="0"/>
      <geom class="collision" type="sphere" pos="-.2 0 .02" size=".02" condim="1" priority="1"
        friction=".001 .001 .0001" mass="0"/>
      <site name="mast" pos="-.05 0 .3"/>
      <body name="link_left_wheel" pos="0 .17 .06" quat="1 -1 0 0">
        <joint name="joint_left" class="wheel"/>
        <geom class="visual" type="cylinder" size=".06 .02" rgba=".1 .1 .1 1"/>
        <geom class="collision" type="ellipsoid" size=".06 .06 .02" mass=".3" priority="1"
          condim="4" friction="1 .005 .0001" solref=".01 1"/>
      </body>
      <body name="link_right_wheel" pos="0 -.17 .06" quat="1 -1 0 0">
        <joint name="joint_right" class="wheel"/>
        <geom class="visual" type="cylinder" size=".06 .02" rgba=".1 .1 .1 1"/>
        <geom class="collision" type="ellipsoid" size=".06 .06 .02" mass=".3" priority="1"
          condim="4" friction="1 .005 .0001" solref=".01 1"/>
      </body>
      <body name="arm" pos="0 0 .2"><joint name="lift" type="slide" range="0 .1" damping="50"/>
        <geom class="collision" type="box" size=".03 .03 .05" mass=".2"/></body>
    </body>
  </worldbody>
  <contact><exclude body1="base_link" body2="link_left_wheel"/>
    <exclude body1="base_link" body2="link_right_wheel"/></contact>
  <actuator>
    <motor name="left" class="wheel" joint="joint_left"/>
    <position name="lift" joint="lift" kp="200"/>
  </actuator>
  <sensor><jointpos name="left_pos" joint="joint_left"/></sensor>
  <keyframe><key name="home" qpos="0 0 .05" ctrl="0 .05"/></keyframe>
</mujoco>
"""
ROBOT = """\
summary: a cart of somebody else
robot_type: cart
drive_type: differential
wheel_separation: 0.34
wheel_radius: 0.06
max_linear_speed: 0.8
max_angular_speed: 2.0
footprint: [[0.15, 0.2], [-0.25, 0.2], [-0.25, -0.2], [0.15, -0.2]]
lidar: {beams: 180, rate_hz: 10, range_min: 0.1, range_max: 6.0, x: -0.05}
sim:
  driver: mujoco
  model: cart.xml
  names:
    base: base_link
    wheel_left: joint_left
    wheel_right: joint_right
    lidar: mast
"""
ROOM = World(
    name="room", description="", half_x=3.0, half_y=3.0, shapes=(), start=Pose(0.0, 0.0, 0.0)
)


def robot_file(folder: Path, *changes: tuple[str, str], model: str = MODEL) -> str:
    """Write the robot's file with changes, and the model; return the path of the file."""
    text = ROBOT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "cart.xml").write_text(model)
    (folder / "robot.yaml").write_text(text)
    return str(folder / "robot.yaml")


def simulated(file: str) -> Simulation:
    robot, _, options, folder = load_link(file, Run(folder=Path()))
    assert isinstance(options, MujocoOptions)
    return Simulation(sim_body(robot, options, Run(folder=folder)), ROOM, 0)


def refusal(file: str) -> str:
    with pytest.raises(ConfigError) as refused:
        make_driver(file, Run(folder=Path()))
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_a_model_is_driven_without_editing_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        simulation = simulated(robot_file(tmp_path))
    assert not caplog.records
    assert (tmp_path / "cart.xml").read_text() == MODEL
    for _ in range(100):
        simulation.command(0.0, 0.0)
        simulation.advance()
    for _ in range(300):
        simulation.command(0.5, 0.0)
        simulation.advance()
    assert simulation.truth.pose().x == pytest.approx(1.45, abs=0.12)
    assert simulation.odometry().x == pytest.approx(simulation.truth.pose().x, abs=0.08)
    yaws = []
    for _ in range(200):
        simulation.command(0.0, 1.0)
        simulation.advance()
        yaws.append(simulation.truth.pose().yaw)
    assert math.remainder(yaws[-1] - yaws[-101], math.tau) == pytest.approx(1, abs=0.15)
    assert simulation.imu().angular_velocity[2] == pytest.approx(1.0, abs=0.15)
    assert simulation.imu().linear_acceleration[2] == pytest.approx(9.81, abs=0.5)
    assert simulation.truth.contacts == 0


def test_an_imu_mounted_upside_down_is_read_in_the_frame_of_the_base(
    tmp_path: Path,
) -> None:
    model = MODEL.replace(
        '<site name="mast"', '<site name="board" pos="-.1 0 .1" euler="3.1416 0 1.57"/>'
        '<site name="mast"',
    ).replace('<sensor>', '<sensor><gyro name="rate" site="board"/>'
              '<accelerometer name="force" site="board"/>')  # fmt: skip
    names = "    lidar: mast\n    gyro: rate\n    accelerometer: force\n"
    simulation = simulated(robot_file(tmp_path, ("    lidar: mast\n", names), model=model))
    for _ in range(300):
        simulation.command(0.0, 1.0)
        simulation.advance()
    assert simulation.imu().angular_velocity[2] == pytest.approx(1.0, abs=0.15)
    assert simulation.imu().linear_acceleration[2] == pytest.approx(9.81, abs=0.5)


def test_geoms_of_the_robot_hide_nothing_from_the_lidar(tmp_path: Path) -> None:
    simulation = simulated(robot_file(tmp_path))
    ranges = simulation.scan()
    assert ranges.min() > 2.5  # the walls are 3 m away


def test_the_outline_of_the_model_is_the_footprint_of_the_file(tmp_path: Path) -> None:
    footprint = simulated(robot_file(tmp_path)).truth.footprint
    edges = footprint.front, footprint.rear, footprint.half_width
    assert edges == pytest.approx((0.15, -0.25, 0.2))


def test_a_lidar_without_a_site_is_placed_by_the_robot_file(tmp_path: Path) -> None:
    file = robot_file(tmp_path, ("    lidar: mast\n", "  lidar_height: 0.3\n"))
    simulation = simulated(file)
    site = simulation.data.site("robot/lidar").xpos.tolist()
    assert site == pytest.approx((-0.05, 0.0, 0.3), abs=0.01)


def test_the_lidar_may_be_placed_by_a_body_of_the_model(tmp_path: Path) -> None:
    simulated(robot_file(tmp_path, ("lidar: mast", "lidar: arm")))


def test_all_missing_parts_are_reported_in_one_message_with_the_line(
    tmp_path: Path,
) -> None:
    text = refusal(
        robot_file(
            tmp_path,
            ("wheel_left: joint_left", "wheel_left: joint_lift"),
            ("wheel_right: joint_right", "wheel_right: {joint: joint_right, actuator: rigth}"),
            ("lidar: mast", "lidar: mist"),
        )
    )
    assert text.startswith(f"{tmp_path}/robot.yaml:15: {tmp_path}/cart.xml: the model has ")
    assert "no joint 'joint_lift' (wheel_left); did you mean 'joint_left'?" in text
    assert "no actuator 'rigth' (wheel_right)" in text
    assert "no site 'mist' (lidar); did you mean 'mast'?" in text


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("base: base_link", "base: arm", 14, "'arm' (base) inside another body"),
        ("base: base_link", "base: chassis", 14, "no body 'chassis' (base)"),
        ("base: base_link", "bass: base_link", 14, "no part 'bass'; did you mean 'base'?"),
        ("    lidar: mast\n", "", 12, "`lidar_height`, above the floor"),
        ("    wheel_left: joint_left\n", "", 12, "name it in `names: {wheel_left: …}`"),
        ("wheel_left: joint_left", "wheel_left: lift", 15, "no geom|several geoms|one geom|axis"),
        ("base: base_link", "gyro: rate", 14, "no sensor 'rate' (gyro)"),
    ],
)
def test_each_mistake_in_the_table_is_refused_with_its_line(
    tmp_path: Path, old: str, new: str, line: int, reason: str
) -> None:
    text = refusal(robot_file(tmp_path, (old, new)))
    assert text.startswith(f"{tmp_path}/robot.yaml:{line}: ")
    assert any(one in text for one in reason.split("|")), text


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('axis="0 0 -1"', 'axis="1 0 0"', "the axis of wheel_left is"),
        ("<body name=\"base_link\">", '<body name="base_link"><joint type="slide"/>', "on rails"),
        ("</mujoco>", "", "cannot be used"),
        ("</worldbody>", "</worldbody><tendon><fixed name='belt'><joint joint='joint_left' "
         "coef='1'/></fixed></tendon>", "tendon 'belt' runs over 'joint_left'"),
        ('<geom class="collision" type="ellipsoid" size=".06 .06 .02" mass=".3" priority="1"',
         '<geom class="visual" type="box" size=".06 .06 .02" priority="1"', "no geom that touches"),
    ],
)  # fmt: skip
def test_a_model_that_cannot_be_driven_is_refused_in_one_line(
    tmp_path: Path, old: str, new: str, problem: str
) -> None:
    assert old in MODEL
    text = refusal(robot_file(tmp_path, model=MODEL.replace(old, new)))
    assert problem in text
    assert text.startswith(f"{tmp_path}/robot.yaml:")


@pytest.mark.parametrize(
    ("old", "new", "warning"),
    [
        ("wheel_radius: 0.06", "wheel_radius: 0.12", "wheel_radius is 0.060 m here, and 0.120 m"),
        ("separation: 0.34", "separation: 0.5", "wheel_separation is 0.340 m here, and 0.500 m"),
        ("x: -0.05}", "x: 0.1}", "lidar: x is -0.050 m here, and 0.100 m"),
        ("x: -0.05}", "x: -0.05, yaw: 1.57}", "lidar: yaw is 0.000 rad here, and 1.570 rad"),
    ],
)
def test_a_contradiction_between_file_and_model_is_a_warning_with_both_numbers(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, old: str, new: str, warning: str
) -> None:
    with caplog.at_level(logging.WARNING):
        simulated(robot_file(tmp_path, (old, new)))
    (text,) = caplog.messages
    assert text == f"{tmp_path}/cart.xml: {warning} in the robot's file"


def test_an_outline_unlike_the_footprint_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    box = 'pos="-.05 0 .12" size=".18 .14 .06" mass="0"'
    wide = MODEL.replace(box, box.replace("-.05 0", "-.05 .1"))
    with caplog.at_level(logging.WARNING):
        simulated(robot_file(tmp_path, model=wide))
    left = "the left side of the footprint is 0.240 m here, and 0.200 m in the robot's file"
    assert caplog.messages == [f"{tmp_path}/cart.xml: {left}"]


def test_an_actuator_too_slow_for_the_speed_limit_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    slow = MODEL.replace(
        '<motor name="left" class="wheel" joint="joint_left"/>',
        '<velocity name="left" joint="joint_left" kv="1" ctrlrange="-5 5"/>',
    )
    with caplog.at_level(logging.WARNING):
        simulated(robot_file(tmp_path, model=slow))
    (text,) = caplog.messages
    assert "the actuator of wheel_left ends at 5 rad/s" in text
    assert "ask for 13.3 rad/s" in text


async def test_meshes_and_included_files_are_found_beside_the_model(tmp_path: Path) -> None:
    assets = tmp_path / "assets"
    assets.mkdir()
    corners = "\n".join(f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    triangles = ("124", "143", "586", "578", "156", "162", "348", "387", "137", "175", "268", "284")
    faces = "\n".join(f"f {' '.join(three)}" for three in triangles)
    (assets / "cube.obj").write_text(f"{corners}\n{faces}\n")
    part = '<mujoco><asset><mesh name="cube" file="cube.obj" scale=".1 .1 .1"/></asset></mujoco>'
    (tmp_path / "part.xml").write_text(part)
    model = MODEL.replace('autolimits="true"', 'autolimits="true" meshdir="assets"')
    model = model.replace("<worldbody>", '<include file="part.xml"/><worldbody>')
    model = model.replace(
        '<site name="mast"', '<geom class="visual" type="mesh" mesh="cube"/><site name="mast"'
    )
    _, driver = make_driver(robot_file(tmp_path, model=model), Run(folder=Path()))
    assert isinstance(driver, MujocoDriver)
    await driver.close()


ATTACHES = {"lekiwi"}  # some names of its model are in another file
SIMULATED = [n for n in robot_files() if (load_robot(n).sim or {}).get("driver") == "mujoco"]
BODIES = [name for name in SIMULATED if name not in ATTACHES]


@pytest.mark.parametrize("name", BODIES)
def test_every_body_drives_the_same_with_renamed_parts(name: str, tmp_path: Path) -> None:
    """Rename each part of the model, and list the new names in the table."""
    robot, _, options, folder = load_link(name, Run(folder=Path()))
    assert isinstance(options, MujocoOptions)
    body = sim_body(robot, options, Run(folder=folder))
    parts = {name for kind, name in body.parts() if kind == "actuator"}
    joints = {name for kind, name in body.parts() if kind == "joint"}
    sensors = {name for kind, name in body.parts() if kind == "sensor"}
    base_names = {"base", "free", "lidar", "gyro", "accelerometer", "attitude"}
    words = sorted(parts | joints | sensors | base_names, key=len, reverse=True)
    other = re.sub(rf'"({"|".join(words)})"', r'"their_\1"', body.model)
    assert other != body.model
    own = base_names & set(re.findall(r'"(\w+)"', body.model))
    table = {key: f"their_{key}" for key in own - {"free"}}
    table |= {key: f"their_{key}" for key in sensors}
    table |= {key: f"their_{f'{key}_joint' if f'{key}_joint' in joints else key}" for key in parts}
    path = tmp_path / "model.xml"
    path.write_text(other)
    renamed = dataclasses.replace(body, model=other, path=str(path), names=table, motor=body.motor)
    poses = []
    for one in (body, renamed):
        simulation = Simulation(one, ROOM, 3)
        for _ in range(100):
            simulation.command(0.2, 0.3)
            simulation.advance()
        scan = simulation.scan().tolist() if robot.lidar else []
        turned = [motor.position for motor in simulation.motors()]
        poses.append((simulation.truth.pose(), simulation.odometry(), turned, scan))
    assert poses[0] == poses[1]
