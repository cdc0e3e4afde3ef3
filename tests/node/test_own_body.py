"""A body of one's own, by its file alone: what fits it, and what is said where it does not."""

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

MINE = robot_path("mycustombot")
MODEL = MINE.with_name("model.xml")


def mine(folder: Path, *changes: tuple[str, str]) -> str:
    """mycustombot's file with these changes, beside its model."""
    text = MINE.read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    (folder / "model.xml").write_text(MODEL.read_text())
    (folder / "robot.yaml").write_text(text)
    return str(folder / "robot.yaml")


def test_an_emulated_battery_has_the_voltages_of_the_bodys_own_file(tmp_path: Path) -> None:
    six_cells = mine(tmp_path, ("empty: 9.9", "empty: 20"), ("full: 12.6", "full: 25.2"))
    charge = emulated_body(six_cells, Run(folder=tmp_path)).simulation.battery()
    assert charge.voltage == pytest.approx(25.2, abs=0.1)
    assert emulated_body("mycustombot", Run(folder=tmp_path)).simulation.battery().voltage < 12.61


def test_a_body_without_physics_is_not_said_to_be_emulated(tmp_path: Path) -> None:
    own = mine(tmp_path, ("sim: {driver: mujoco, battery_capacity: 10.0}", "sim: {driver: mock}"))
    assert robot_links(load_robot(own)) == ["sim", "real"]
    with pytest.raises(ConfigError, match="has no link 'emulated'; it has: sim, real"):
        CheckedRobot(own, "emulated", tmp_path)


def test_a_lidar_without_a_source_is_refused_with_file_and_line(tmp_path: Path) -> None:
    own = mine(tmp_path, ("  scan: {driver: ld19, port: usb:10c4:ea60}\n", ""))
    with pytest.raises(ConfigError, match=r"robot.yaml:\d+: real: scan: `lidar` says that"):
        catalog.load_link(own, Run(folder=tmp_path, link="real"))


async def test_a_lidar_that_never_scans_is_told_apart_from_a_busy_machine() -> None:
    async def in_vain(*_: object) -> None:
        return None

    lidar = load_robot(str(MINE)).lidar
    rig: Any = SimpleNamespace(
        robot=SimpleNamespace(lidar=lidar), until=in_vain, state=state(1), scan=None, states=350
    )
    found = await gate_checks.reports(rig)
    assert not found.ok
    assert "no scan within 350 ticks, though `lidar:` is in the robot's file" in found.measured
    rig.states = 100  # of 350: the machine had no time
    with pytest.raises(Failed, match="no state and scan within 350 ticks"):
        await gate_checks.reports(rig)


@pytest.mark.parametrize("sign", [1, -1])
def test_whole_numbers_do_not_exceed_the_bodys_limits(sign: int) -> None:
    template = Template("M,{linear_x|mm/s:d},{angular_z|deg/s:d}\n", COMMAND)
    command = LineCommand(template, None)
    wanted = Velocity(linear_x=sign * 0.4996, angular_z=sign * 1.82)  # 104.28 degrees
    assert command.line(wanted, 0) == f"M,{sign * 499},{sign * 104}\n".encode()
    assert abs(command.sent(wanted).linear_x) == pytest.approx(0.499)
    exact = Velocity(linear_x=sign * 0.3, angular_z=0.0)  # 0.3 is no binary fraction
    assert command.line(exact, 0) == f"M,{sign * 300},0\n".encode()


def compiled(own: str, folder: Path) -> None:
    """Its model as the simulator takes it."""
    run = Run(folder=folder)
    robot, _, options, place = catalog.load_link(own, run)
    assert isinstance(options, MujocoOptions)
    body = sim_body(robot, options, Run(folder=place))
    compile_scene(body, load_world("arena", 0))


def test_a_model_whose_wheels_are_others_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    compiled(mine(tmp_path), tmp_path)
    assert not caplog.records
    radius = f"wheel_radius: {load_robot('mycustombot').wheel_radius:g}"
    own = mine(tmp_path, (radius, "wheel_radius: 0.16"))
    with caplog.at_level(logging.WARNING):
        compiled(own, tmp_path)
    (warning,) = caplog.messages
    assert warning == (
        f"{tmp_path}/model.xml: wheel_radius is 0.080 m here, and 0.160 m in the robot's file"
    )


def test_an_arm_without_joints_is_refused(tmp_path: Path) -> None:
    own = mine(tmp_path, ("drive_type: differential", "drive_type: arm"))
    with pytest.raises(ConfigError, match=r"joints: missing; a body that is an arm alone has some"):
        compiled(own, tmp_path)


def test_a_model_that_lacks_parts_is_named(tmp_path: Path) -> None:
    own = mine(tmp_path)
    model = tmp_path / "model.xml"
    model.write_text(model.read_text().replace("wheel_left_joint", "left"))
    with pytest.raises(ConfigError, match=r"model\.xml: the model has no joint 'wheel_left_joint'"):
        compiled(own, tmp_path)
