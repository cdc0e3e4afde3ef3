"""An emulator that dies and restarts continues where the body stood, with its electronics off."""

import contextlib
import logging
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers.bodies.alpha.emulator import LYING
from gigabrain_drivers.bodies.feetech.emulator import FeetechArm
from gigabrain_drivers.bodies.piper.emulator import Piper
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.emulators.emulator import device_class, emulated_body
from gigabrain_drivers.sim import STEP_NS
from gigabrain_drivers.sim.checkpoint import CheckpointFiles
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.testing.waiting import until

WAFFLE = "turtlebot3_waffle"


def body_of(path: Path, name: str = WAFFLE, world: str = "arena") -> EmulatedBody:
    """Return the body of an emulator's process, in the run with these checkpoints."""
    return emulated_body(name, Run(folder=Path(), world=world, checkpoint=str(path)))


@asynccontextmanager
async def running(body: EmulatedBody) -> AsyncIterator[EmulatedBody]:
    """Run the physics; the files stay as after a kill of the process."""
    body.start()
    try:
        yield body
    finally:
        await body.close()


async def saved(path: Path, body: EmulatedBody) -> None:
    """Wait for a checkpoint of a step from now on."""
    since_ns = body.simulation.time_ns

    def newest() -> bool:
        with contextlib.suppress(ConfigError):  # the first one is being written
            found = CheckpointFiles(path).read()
            return found is not None and found.steps * STEP_NS > since_ns
        return False

    await until(newest)


def height_of(body: EmulatedBody) -> float:
    simulation = body.simulation
    return float(simulation.data.xpos[simulation.model.body("robot/base").id, 2])


def place_of(body: EmulatedBody) -> tuple[float, float, float]:
    pose = body.simulation.truth.pose()
    return pose.x, pose.y, pose.yaw


async def test_the_next_emulator_of_a_run_continues_where_the_last_one_died(
    tmp_path: Path,
) -> None:
    path = tmp_path / "checkpoint"
    start = place_of(body_of(path))
    async with running(body_of(path)) as first:
        first.command(0.2, 0.0, 0.5)
        await until(lambda: first.simulation.truth.distance_m > 0.2)
        first.command(0.0, 0.0, 0.0)
        await until(lambda: abs(first.simulation.truth.speed()[0]) < 1e-3)
        await saved(path, first)
    second = body_of(path)
    assert place_of(second) == pytest.approx(place_of(first), abs=0.01)
    assert second.report()["distance_m"] == pytest.approx(first.report()["distance_m"], abs=0.01)
    assert second.commanded == (0.0, 0.0, 0.0)
    assert second.clock_ns == 0  # of the electronics
    assert second.snapshot.odometry == (0, 0, 0, 0, 0)
    assert [wheel.position for wheel in second.wheels] == pytest.approx([0, 0], abs=0.01)
    assert place_of(body_of(tmp_path / "another run")) == start


async def test_after_an_error_of_the_physics_an_emulator_starts_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "checkpoint"
    async with running(body_of(path)) as body:
        await saved(path, body)
        monkeypatch.setattr(Simulation, "advance", lambda _: 1 / 0)
        await until(lambda: body.lost)
    assert CheckpointFiles(path).read() is None


def test_a_damaged_file_starts_an_emulator_over_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "checkpoint"
    for number in range(2):
        Path(f"{path}.{number}").write_bytes(b"?" * 99)
    with caplog.at_level(logging.WARNING):
        assert body_of(path).report()["sim_seconds"] == 0.0
    assert "starts from the beginning: the checkpoint is damaged" in caplog.text


async def test_a_fallen_body_starts_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "checkpoint"
    async with running(body_of(path, "alpha")) as body:
        await saved(path, body)
        upset = body.simulation.data.qpos  # of the free joint: place and quaternion
        upset[2:7] = 0.4, math.cos(0.6), math.sin(0.6), 0.0, 0.0
        await until(lambda: body.snapshot.fallen and body.simulation.truth.falls)
        await saved(path, body)
    with caplog.at_level(logging.WARNING):
        again = body_of(path, "alpha")
    assert "the robot had fallen over" in caplog.text
    assert again.report()["sim_seconds"] == 0.0


async def test_a_lying_quadruped_stands_up_without_a_fall(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    async with running(body_of(path, "alpha")) as first:
        first.walk(LYING)
        await until(lambda: height_of(first) < 0.21)
        await saved(path, first)
        lying = [motor.position for motor in first.wheels]
    second = body_of(path, "alpha")
    assert [motor.position for motor in second.wheels] == pytest.approx(lying, abs=0.1)
    assert height_of(second) < 0.21
    rates = list[float]()
    async with running(second):
        second.on_step.append(lambda now: rates.append(max(abs(m.velocity) for m in now.wheels)))
        await until(lambda: height_of(second) > 0.3)
    assert max(rates) < 3.0  # [rad/s]; a jump to the stand would be much faster
    assert second.simulation.truth.falls == 0
    assert math.dist(place_of(second)[:2], place_of(first)[:2]) < 0.05


@pytest.mark.parametrize("name", ["so101", "piper"])
async def test_a_resumed_arm_keeps_its_pose_and_its_servos_are_off(
    tmp_path: Path, name: str
) -> None:
    path = tmp_path / "checkpoint"
    async with running(body_of(path, name, "table")) as first:
        aim = {first.robot.joints[0].name: 0.4}
        first.aim(aim)
        await until(lambda: abs(first.joints[0].position - 0.4) < 0.05)
        await saved(path, first)
        before = [motor.position for motor in first.joints]
    second = body_of(path, name, "table")
    assert [motor.position for motor in second.joints] == pytest.approx(before, abs=0.05)
    device = device_of(second)
    device.reset()
    device.step(0)
    second.on_step.clear()
    assert second._aims is None  # switched off
    on_at_the_start = device_of(body_of(tmp_path / "another run", name, "table"))
    on_at_the_start.reset()
    on_at_the_start.step(0)
    assert on_at_the_start.body._aims


def device_of(body: EmulatedBody) -> FeetechArm | Piper:
    run = Run(folder=Path(), link="emulated", emulator="memory")
    _, _, options, _ = catalog.load_link(body.robot.robot_type, run)
    device = device_class(options.driver)(body, options, Silent())
    assert isinstance(device, FeetechArm | Piper)
    return device


class Silent:
    """A wire without a host."""

    def write(self, data: bytes) -> bool:
        return False


@pytest.mark.parametrize(("link", "kept"), [("emulated", True), ("sim", False), ("real", False)])
def test_each_emulated_run_has_its_own_checkpoint(
    link: LinkName, kept: bool, tmp_path: Path
) -> None:
    for run_dir in (tmp_path / "one", tmp_path / "two"):
        specs = process_specs(Deployment(link=link), "robot", run_dir, tmp_path / "state")
        found = [
            msgspec.json.decode(one.config)["settings"]["checkpoint"]
            for one in specs
            if one.name == "emulator"
        ]
        assert found == [str(run_dir / "checkpoint")] * kept
