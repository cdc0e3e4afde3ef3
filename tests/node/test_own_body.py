"""A user's own body, by its file alone: what it gets, and errors for what does not fit."""

import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gigabrain_drivers.bodies.line.conversion import LineCommand
from gigabrain_drivers.bodies.line.protocol import COMMAND, Template
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.catalog import load_robot, robot_links, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import emulated_body
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.scene import compile_scene
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.conformance import gate_checks
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot
from gigabrain_zenoh.qa.judging import Failed
from gigabrain_zenoh.testing.samples import state

ROBOT_FILE = robot_path("mycustombot")
MODEL = ROBOT_FILE.with_name("model.xml")


def changed_file(folder: Path, *changes: tuple[str, str]) -> str:
    """Write mycustombot's file with changes, and its model; return the path of the file."""
    text = ROBOT_FILE.read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    (folder / "model.xml").write_text(MODEL.read_text())
    (folder / "robot.yaml").write_text(text)
    return str(folder / "robot.yaml")


def test_an_emulated_battery_has_the_voltages_of_the_robot_file(tmp_path: Path) -> None:
    six_cells = changed_file(tmp_path, ("empty: 9.9", "empty: 20"), ("full: 12.6", "full: 25.2"))
    charge = emulated_body(six_cells, Run(folder=tmp_path)).simulation.battery()
    assert charge.voltage == pytest.approx(25.2, abs=0.1)
    assert emulated_body("mycustombot", Run(folder=tmp_path)).simulation.battery().voltage < 12.61


def test_a_body_without_physics_has_no_emulated_link(tmp_path: Path) -> None:
    own = changed_file(
        tmp_path, ("sim: {driver: mujoco, battery_capacity: 10.0}", "sim: {driver: mock}")
    )
    assert robot_links(load_robot(own)) == ["sim", "real"]
    with pytest.raises(ConfigError, match="has no link 'emulated'; it has: sim, real"):
        CheckedRobot(own, "emulated", tmp_path)


def test_a_lidar_without_a_source_is_refused_with_file_and_line(tmp_path: Path) -> None:
    own = changed_file(tmp_path, ("  scan: {driver: ld19, port: usb:10c4:ea60}\n", ""))
    with pytest.raises(ConfigError, match=r"robot.yaml:\d+: real: scan: `lidar` says that"):
        catalog.load_link(own, Run(folder=tmp_path, link="real"))


async def test_a_lidar_that_never_scans_is_reported_unless_the_machine_is_busy() -> None:
    async def never(*_: object) -> None:
        return None

    lidar = load_robot(str(ROBOT_FILE)).lidar
    rig: Any = SimpleNamespace(
        robot=SimpleNamespace(lidar=lidar), until=never, state=state(1), scan=None, states=350
    )
    found = await gate_checks.reports(rig)
    assert not found.ok
    assert "no scan within 350 ticks, though `lidar:` is in the robot's file" in found.measured
    rig.states = 100  # of 350, as on a busy machine
    with pytest.raises(Failed, match="no state and scan within 350 ticks"):
        await gate_checks.reports(rig)


@pytest.mark.parametrize("sign", [1, -1])
def test_commands_in_whole_numbers_do_not_exceed_the_limits_of_the_body(sign: int) -> None:
    template = Template("M,{linear_x|mm/s:d},{angular_z|deg/s:d}\n", COMMAND)
    command = LineCommand(template, None)
    wanted = Velocity(linear_x=sign * 0.4996, angular_z=sign * 1.82)  # 104.28 deg/s
    assert command.line(wanted, 0) == f"M,{sign * 499},{sign * 104}\n".encode()
    assert abs(command.sent(wanted).linear_x) == pytest.approx(0.499)
    exact = Velocity(linear_x=sign * 0.3, angular_z=0.0)  # 0.3 is no binary fraction
    assert command.line(exact, 0) == f"M,{sign * 300},0\n".encode()


def compile_model(own: str, folder: Path) -> None:
    """Compile the model of a body as the simulator does."""
    run = Run(folder=folder)
    robot, _, options, place = catalog.load_link(own, run)
    assert isinstance(options, MujocoOptions)
    body = sim_body(robot, options, Run(folder=place))
    compile_scene(body, load_world("arena", 0))


def test_a_wheel_radius_unlike_the_model_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    compile_model(changed_file(tmp_path), tmp_path)
    assert not caplog.records
    radius = f"wheel_radius: {load_robot('mycustombot').wheel_radius:g}"
    own = changed_file(tmp_path, (radius, "wheel_radius: 0.16"))
    with caplog.at_level(logging.WARNING):
        compile_model(own, tmp_path)
    (warning,) = caplog.messages
    assert warning == (
        f"{tmp_path}/model.xml: wheel_radius is 0.080 m here, and 0.160 m in the robot's file"
    )


def test_an_arm_without_joints_is_refused(tmp_path: Path) -> None:
    own = changed_file(tmp_path, ("drive_type: differential", "drive_type: arm"))
    with pytest.raises(ConfigError, match=r"joints: missing; a body that is an arm alone has some"):
        compile_model(own, tmp_path)


def test_a_model_without_a_wheel_joint_is_refused(tmp_path: Path) -> None:
    own = changed_file(tmp_path)
    model = tmp_path / "model.xml"
    model.write_text(model.read_text().replace("wheel_left_joint", "left"))
    with pytest.raises(ConfigError, match=r"model\.xml: the model has no joint 'wheel_left_joint'"):
        compile_model(own, tmp_path)
