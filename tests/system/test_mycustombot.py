"""mycustombot: in MuJoCo directly, and on its real driver with bytes on a pty."""

import asyncio
import itertools
import math
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import numpy as np
import pytest

from gigabrain_drivers.bodies.line.emulator import LineBase
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import Emulator
from gigabrain_drivers.emulators.faults import NO_FAULTS, Faults
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.world import World
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.testing.waiting import until

EMPTY = World(name="empty", description="", half_x=5.0, half_y=5.0, shapes=())


@pytest.fixture
def simulation() -> Simulation:
    robot, _, options, folder = catalog.load_link("mycustombot", Run(folder=Path()))
    assert isinstance(options, MujocoOptions)
    return Simulation(sim_body(robot, options, Run(folder=folder)), EMPTY, 0)


def run(simulation: Simulation, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        simulation.advance()


def test_it_weighs_twelve_kilograms_and_stands_level(simulation: Simulation) -> None:
    model = simulation.model
    base = model.body("robot/base").id
    assert model.body_subtreemass[base] == pytest.approx(12.0)
    run(simulation, 1.0)
    height = simulation.data.qpos[model.joint("robot/free").qposadr[0] + 2]
    assert height == pytest.approx(0.08, abs=0.001)


def test_its_outline_is_the_footprint_of_its_file(simulation: Simulation) -> None:
    corners = catalog.load_robot("mycustombot").footprint
    outline = simulation.truth.footprint
    assert max(x for x, _ in corners) >= outline.front >= 0.19
    assert min(x for x, _ in corners) <= outline.rear <= -0.39
    assert max(y for _, y in corners) == pytest.approx(outline.half_width, abs=0.003)


def test_it_drives_as_commanded_within_a_percent(simulation: Simulation) -> None:
    simulation.command(0.3, 0.6)
    run(simulation, 2.0)
    assert simulation.truth.speed() == pytest.approx((0.3, 0.6), rel=0.01)


def test_a_square_closes_within_a_centimetre_by_odometry(simulation: Simulation) -> None:
    def drive(x: float, turn: float, done: float) -> None:
        start = simulation.odometry()
        while True:
            now = simulation.odometry()
            way = math.hypot(now.x - start.x, now.y - start.y) if x else now.yaw - start.yaw
            rest = done - way
            if rest < 0.0005:
                break
            speed = min(1.0, 3 * rest + 0.02)
            simulation.command(x * speed, turn * speed)
            simulation.advance()
        simulation.command(0.0, 0.0)
        run(simulation, 0.4)

    begin, estimate = simulation.truth.pose(), simulation.odometry()
    for _ in range(4):
        drive(0.25, 0.0, 2.0)
        drive(0.0, 0.6, math.pi / 2)
    end, last = simulation.truth.pose(), simulation.odometry()
    true = (end.x - begin.x, end.y - begin.y)
    cos, sin = math.cos(begin.yaw), math.sin(begin.yaw)
    forward, left = cos * true[0] + sin * true[1], cos * true[1] - sin * true[0]
    error = math.hypot(forward - (last.x - estimate.x), left - (last.y - estimate.y))
    assert error < 0.01
    turned = math.remainder(end.yaw - begin.yaw - (last.yaw - estimate.yaw), math.tau)
    assert abs(math.degrees(turned)) < 0.5


def test_its_lidar_looks_between_the_decks_all_round(simulation: Simulation) -> None:
    seen = simulation.scan()
    assert seen.shape == (360,)
    assert np.all(seen > 0.5)  # nothing of the robot itself


async def test_without_its_emulator_the_robot_is_not_connected(tmp_path: Path) -> None:
    run = Run(folder=Path(), link="emulated", emulator=str(tmp_path))
    _, driver = catalog.make_driver("mycustombot", run)
    async with driver:
        await asyncio.sleep(0.02)
        assert not (await driver.read_state()).link.connected


class Pair:
    """The emulated robot and its real driver."""

    def __init__(self, emulator: Emulator, driver: Driver) -> None:
        self.emulator, self.driver = emulator, driver
        self.scans: list[LaserScan] = []
        driver.emit = lambda topic, message: (
            self.scans.append(message) if topic is SCAN and isinstance(message, LaserScan) else None
        )

    def speed(self) -> float:
        return self.emulator.body.snapshot.odometry.linear_x


@pytest.fixture
async def pair(tmp_path: Path) -> AsyncIterator[Pair]:
    run = Run(folder=Path(), link="emulated", emulator=str(tmp_path))
    _, driver = catalog.make_driver("mycustombot", run)
    async with Emulator("mycustombot", run) as emulator:
        it = Pair(emulator, driver)
        async with driver:
            yield it


async def connected(pair: Pair, wanted: bool = True) -> None:
    async with asyncio.timeout(60):
        while (await pair.driver.read_state()).link.connected is not wanted:  # noqa: ASYNC110
            await asyncio.sleep(0.005)


async def drive(pair: Pair, so: Callable[[], object] | None = None, ticks: int = 10) -> None:
    """Command 0.2 m/s in each tick, for `ticks` ticks or until `so` holds."""
    async with asyncio.timeout(60):
        for tick in itertools.count():
            if so() if so else tick >= ticks:
                return
            await pair.driver.set_base_velocity(0.2, 0.0, 0.0)
            await asyncio.sleep(0.02)


async def test_its_driver_drives_the_simulated_body_by_bytes_alone(pair: Pair) -> None:
    await connected(pair)
    true = pair.emulator.body
    await drive(pair, lambda: true.snapshot.odometry.x > 0.15 and abs(pair.speed() - 0.2) < 0.02)
    async with asyncio.timeout(60):  # its report is slightly older
        while True:
            await drive(pair, ticks=1)
            state = await pair.driver.read_state()
            behind = true.snapshot.odometry.x - state.pose.x
            if abs(state.velocity.linear_x - 0.2) < 0.03 and abs(behind) < 0.03:
                break
    assert state.battery is not None
    assert 12.0 < state.battery.voltage < 12.6
    assert [j.temperature is not None for j in state.joints] == [True, True]
    await until(lambda: len(pair.scans) >= 2)
    assert pair.scans[-1].ranges_m.shape == (360,)


async def test_scan_and_base_fail_independently(pair: Pair) -> None:
    await connected(pair)
    await until(lambda: pair.scans)
    pair.emulator.set({"scan": Faults(unplugged=True)})
    await asyncio.sleep(0.1)
    await connected(pair)
    pair.emulator.set({"base": Faults(unplugged=True)})
    await connected(pair, wanted=False)
    pair.scans.clear()
    await until(lambda: pair.scans)


@pytest.mark.parametrize("fault", [Faults(unplugged=True), Faults(deaf=True)])
async def test_a_body_without_commands_stops_by_itself(pair: Pair, fault: Faults) -> None:
    await connected(pair)
    await drive(pair, lambda: pair.speed() > 0.1)
    pair.emulator.set({"base": fault})
    await drive(pair, lambda: abs(pair.speed()) < 0.001)


async def test_old_bytes_are_not_obeyed_after_a_freeze(pair: Pair) -> None:
    await connected(pair)
    device = pair.emulator.stations["base"].device
    assert isinstance(device, LineBase)
    await drive(pair)
    pair.emulator.set({"base": Faults(unplugged=True)})
    await drive(pair)
    device.executed.clear()
    pair.emulator.set({"base": NO_FAULTS})
    await connected(pair)
    await until(lambda: device.executed)
    assert device.executed[0].linear_x == 0.0


async def test_a_broken_motor_or_wheel_changes_the_motion(pair: Pair) -> None:
    await connected(pair)
    body = pair.emulator.body
    pair.emulator.set({"base": Faults(runaway=0.1)})
    await until(lambda: body.snapshot.odometry.linear_x > 0.05)
    assert body.commanded == (0.0, 0.0, 0.0)
    pair.emulator.set({"base": Faults(stuck_wheel=True)})
    await drive(pair)
    await until(lambda: body.snapshot.odometry.angular_z > 0.2)
    assert body.report()["motors_moved_s"] > body.report()["faulted_s"]
    pair.emulator.set({"base": Faults(frozen_values=True)})
    step = body.report()["sim_seconds"]
    await until(lambda: body.report()["sim_seconds"] > step)
    frozen = body.snapshot
    step = body.report()["sim_seconds"]
    await until(lambda: body.report()["sim_seconds"] > step)
    assert body.snapshot is frozen


def test_faults_are_set_by_typed_commands(tmp_path: Path) -> None:
    emulator = Emulator("mycustombot", Run(folder=Path(), link="emulated", emulator=str(tmp_path)))
    both = emulator.parse_faults("silence bit_errors=0.01")
    assert both == dict.fromkeys(("base", "scan"), Faults(silence=True, bit_errors=0.01))
    assert emulator.parse_faults("scan unplugged") == {
        "base": NO_FAULTS,
        "scan": Faults(unplugged=True),
    }
    assert emulator.parse_faults("off") == {"base": NO_FAULTS, "scan": NO_FAULTS}
    with pytest.raises(ConfigError, match="no fault 'silense'; did you mean 'silence'"):
        emulator.parse_faults("silense")
    for words, expected in (
        ("bit_errors=2", "bit_errors needs a number from 0 to 1, such as bit_errors=0.001"),
        ("garbage", "garbage needs a number from 0 to 1, such as garbage=0.1"),
        ("brown_out=x", "brown_out needs a number of volts from 0, such as brown_out=6"),
        ("silence=3", "silence takes no number: write silence, and off to end it"),
    ):
        with pytest.raises(ConfigError, match=f"^{expected}$"):
            emulator.parse_faults(words)


def test_a_robot_without_a_model_cannot_be_emulated(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has no link 'emulated'; it has: sim"):
        Emulator("mock", Run(folder=Path(), link="emulated", emulator=str(tmp_path)))
