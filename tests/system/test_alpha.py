"""Alpha on its real link: the driver against the emulated firmware over TCP, with real physics."""

import asyncio
import math
import os
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.alpha import protocol as alpha
from gigabrain_drivers.bodies.alpha.driver import AlphaDriver, AlphaOptions
from gigabrain_drivers.bodies.alpha.emulator import REST, Alpha
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators import ports
from gigabrain_drivers.emulators.emulator import Station, emulated_body
from gigabrain_drivers.emulators.faults import NO_FAULTS, Faults
from gigabrain_drivers.emulators.ports import TcpPort
from gigabrain_drivers.kinematics.legs import JOINT_NAMES, WALKER
from gigabrain_drivers.kinematics.wheels import Twist
from gigabrain_drivers.links.tcp_link import address
from gigabrain_schemas.topics import IMU
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost, Unsupported
from gigabrain_zenoh.testing.waiting import until

MS = 1_000_000


class Rig:
    """The driver without its lidar, and the emulated body on a separate port."""

    def __init__(self, folder: Path) -> None:
        run = Run(folder=folder, link="emulated", world="arena", emulator=str(folder))
        self.body = emulated_body("alpha", run)
        options = AlphaOptions(driver="alpha", port=str(folder / "base"))
        self.port = TcpPort(folder / "base", 0)
        self.station = Station(lambda wire: Alpha(self.body, options, wire), self.port, Clock())
        self.driver = AlphaDriver(catalog.load_robot("alpha"), options, run)
        self.streaming: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
        self.connected: list[bool] = []

    @property
    def device(self) -> Alpha:
        assert isinstance(self.station.device, Alpha)
        return self.station.device

    async def run_driver_loop(self) -> None:
        """Read the state and send the velocity every 20 ms, as the driver's process does."""
        while True:
            self.connected.append((await self.driver.read_state()).link.connected)
            if self.streaming:
                await self.driver.set_base_velocity(*self.streaming)
            await asyncio.sleep(0.02)


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Rig]:
    rig = Rig(tmp_path)
    rig.body.start()
    rig.station.start()
    async with rig.driver:
        task = asyncio.create_task(rig.run_driver_loop())
        await until(lambda: rig.connected[-1:] == [True])
        yield rig
        task.cancel()
        await asyncio.wait((task,))
    await rig.station.close()
    await rig.body.close()


async def test_the_real_driver_moves_the_emulated_body_ahead_and_sideways(rig: Rig) -> None:
    received = list[object]()
    rig.driver.emit = lambda topic, message: received.append(topic)
    rig.streaming = (0.3, 0.1, 0.0)
    truth = rig.body.simulation.truth
    start = truth.pose()
    await until(lambda: truth.distance_m > 0.5)
    executed_gait = rig.device.executed[-1]
    rig.streaming = (0.0, 0.0, 0.0)
    await until(lambda: rig.body.commanded == (0.0, 0.0, 0.0) and abs(truth.speed()[0]) < 0.01)
    stood_ns = rig.body.snapshot.time_ns
    await until(lambda: rig.driver._state and rig.driver._state.milliseconds * MS > stood_ns)
    end, state = truth.pose(), await rig.driver.read_state()
    moved = math.hypot(end.x - start.x, end.y - start.y)
    assert math.hypot(state.pose.x, state.pose.y) == pytest.approx(moved, abs=0.15)
    assert state.pose.x == pytest.approx(3 * state.pose.y, abs=0.15)
    assert tuple(joint.name for joint in state.joints) == JOINT_NAMES
    assert all(joint.temperature is not None for joint in state.joints)
    assert state.battery
    assert 28 < state.battery.voltage < 30
    assert IMU in received
    assert WALKER.to_body(executed_gait) == pytest.approx((0.3, 0.1, 0.0), abs=1e-6)


async def test_it_returns_the_sent_velocity_within_limits_and_zero_for_nan(
    rig: Rig,
) -> None:
    rig.streaming = None
    fast = await rig.driver.set_base_velocity(9.0, -9.0, 9.0)
    assert (fast.linear_x, fast.linear_y, fast.angular_z) == pytest.approx((0.5, -0.2, 1.0))
    none = await rig.driver.set_base_velocity(math.nan, 0.0, 0.5)
    assert (none.linear_x, none.linear_y, none.angular_z) == (0.0, 0.0, 0.0)


async def test_the_body_stops_without_commands(rig: Rig) -> None:
    rig.streaming = (0.3, 0.0, 0.0)
    await until(lambda: rig.device.executed and rig.device.executed[-1].stride_x > 0)
    rig.streaming = None
    await until(lambda: rig.driver._state and rig.driver._state.flags == alpha.SILENT)
    await until(lambda: abs(rig.body.simulation.truth.speed()[0]) < 0.05)


async def test_a_silent_body_is_lost_and_gets_a_stop_first_when_it_returns(rig: Rig) -> None:
    rig.streaming = (0.3, 0.0, 0.0)
    await until(lambda: rig.device.executed and rig.device.executed[-1].stride_x > 0)
    rig.station.set(Faults(silence=True))
    await until(lambda: not rig.connected[-1])
    assert (await rig.driver.set_base_velocity(0.3, 0.0, 0.0)).linear_x in (0.0, 0.3)
    await until(lambda: rig.driver.link.reconnects > 0)
    rig.device.executed.clear()
    rig.station.set(NO_FAULTS)
    await until(lambda: len(rig.device.executed) > 2)
    assert rig.device.executed[0] == REST
    await until(lambda: rig.connected[-1])


async def test_a_replugged_body_is_found_again(rig: Rig) -> None:
    rig.station.set(Faults(unplugged=True))
    await until(lambda: not rig.connected[-1])
    assert rig.driver.link.problem
    rig.station.set(NO_FAULTS)
    await until(lambda: rig.connected[-1])
    assert rig.driver.link.reconnects >= 1


async def test_a_new_connection_begins_without_the_velocity_of_the_last_one(rig: Rig) -> None:
    rig.streaming = (0.3, 0.0, 0.0)
    await until(lambda: rig.driver._odometry.velocity.linear_x > 0.2)
    opened, velocities = rig.driver.link.on_open, list[Twist]()

    def open_and_note() -> None:
        opened()
        velocities.append(rig.driver._odometry.velocity)

    rig.driver.link.on_open = open_and_note
    rig.driver.link.drop("cut")
    await until(lambda: velocities)
    assert velocities == [Twist(0.0, 0.0, 0.0)]
    assert rig.driver._odometry.pose.x > 0.0


async def test_a_thawed_body_executes_no_old_commands(rig: Rig) -> None:
    rig.streaming = (0.3, 0.0, 0.0)
    await until(lambda: rig.device.executed and rig.device.executed[-1].stride_x > 0)
    rig.station.set(Faults(frozen=True))
    await until(lambda: not rig.connected[-1])
    rig.streaming = (0.0, 0.0, 0.0)
    await asyncio.sleep(0.3)
    rig.device.executed.clear()
    rig.station.set(NO_FAULTS)
    await until(lambda: rig.connected[-1] and len(rig.device.executed) > 5)
    assert all(gait.stride_x == 0.0 for gait in rig.device.executed)


async def test_bit_errors_only_lose_frames(rig: Rig) -> None:
    rig.streaming = (0.2, 0.0, 0.0)
    rig.station.set(Faults(bit_errors=0.005))
    await until(lambda: rig.driver.link.errors > 5)
    strides = {round(gait.stride_x, 4) for gait in rig.device.executed}
    assert strides <= {0.0, round(0.2 / 3.6, 4)}
    await until(lambda: rig.connected[-1])


async def test_the_emulator_serves_one_client_at_a_time(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert rig.port.address
    loop = asyncio.get_running_loop()
    with socket.socket() as other:
        other.setblocking(False)
        await loop.sock_connect(other, rig.port.address)
        assert await loop.sock_recv(other, 10) == b""
    assert rig.port.refused == 1
    await until(lambda: rig.connected[-1])
    monkeypatch.setattr(ports, "CLIENT_TIMEOUT_NS", 0)  # the first client counts as silent
    with socket.socket() as other:
        other.setblocking(False)
        await loop.sock_connect(other, rig.port.address)
        assert (await loop.sock_recv(other, 10))[:2] == alpha.MAGIC


async def test_a_second_emulator_uses_another_port(tmp_path: Path) -> None:
    first = TcpPort(tmp_path / "one", 0)
    first.plug()
    assert first.address
    second = TcpPort(tmp_path / "two", first.address[1])
    second.plug()
    assert second.address
    assert second.address != first.address
    assert address((tmp_path / "two").read_text()) == second.address
    for port in (first, second):
        port.unplug()
        port.unplug()
        assert port.address is None
    assert os.listdir(tmp_path) == []


async def test_without_a_body_the_driver_opens_reports_and_closes(tmp_path: Path) -> None:
    options = AlphaOptions(driver="alpha", port=str(tmp_path / "base"))
    driver = AlphaDriver(catalog.load_robot("alpha"), options, Run(folder=tmp_path))
    await driver.stop()
    with pytest.raises(BodyLost):
        await driver.set_base_velocity(0.1, 0.0, 0.0)
    async with driver:
        await until(lambda: "is the emulator running?" in driver.link.problem)
        assert not (await driver.read_state()).link.connected
        assert (await driver.set_base_velocity(0.1, 0.0, 0.0)).linear_x == 0.0
        with pytest.raises(Unsupported, match="imu"):
            await driver.get_sensor_data("camera")
    await driver.close()


def test_alpha_has_all_three_links() -> None:
    robot, driver, options, _ = catalog.load_link("alpha", Run(folder=Path(), link="real"))
    assert driver is AlphaDriver
    assert isinstance(options, AlphaOptions)
    assert options.port == "192.168.123.10:8080"
    assert catalog.robot_links(robot) == ["sim", "emulated", "real"]
    run = Run(folder=Path(), link="emulated", emulator="/ports")
    assert catalog.load_link("alpha", run)[2].port == "/ports/base"  # type: ignore[attr-defined]


@pytest.mark.slow
async def test_a_parked_body_stays_down_when_its_driver_reconnects(rig: Rig) -> None:
    rig.driver.robot = replace(rig.driver.robot, safe_state="park")
    rig.streaming = (0.3, 0.0, 0.0)
    truth = rig.body.simulation.truth
    await until(lambda: truth.distance_m > 0.2)
    rig.streaming = None
    await rig.driver.make_safe()
    standing = rig.body.snapshot.wheels
    await rig.driver.stop()
    await until(lambda: rig.device.parked)
    await until(lambda: abs(rig.body.snapshot.wheels[2].position - standing[2].position) > 0.3)
    await rig.driver.close()
    await rig.driver.open()
    await until(lambda: rig.connected[-1:] == [True])
    rig.streaming = (0.0, 0.0, 0.0)
    await asyncio.sleep(0.3)
    assert rig.device.parked
    assert not rig.body.snapshot.fallen
    rig.streaming = (0.3, 0.0, 0.0)
    start = truth.distance_m
    await until(lambda: truth.distance_m > start + 0.2)
    assert not rig.body.snapshot.fallen
