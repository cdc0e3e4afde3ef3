"""Alpha on its real link: the driver against the emulated firmware over TCP, with real physics."""

import asyncio
import math
import os
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from gigabrain_drivers import catalog
from gigabrain_drivers.alpha import AlphaDriver, AlphaOptions
from gigabrain_drivers.emulators import tcp
from gigabrain_drivers.emulators.alpha import REST, Alpha
from gigabrain_drivers.emulators.base import Snapshot
from gigabrain_drivers.emulators.faults import NONE, Faults
from gigabrain_drivers.emulators.physics import emulated_body
from gigabrain_drivers.emulators.station import Station
from gigabrain_drivers.emulators.tcp import TcpPort
from gigabrain_drivers.kinematics import Gait, Twist
from gigabrain_drivers.legs.gait import WALKER
from gigabrain_drivers.legs.geometry import JOINT_NAMES
from gigabrain_drivers.links.address import address
from gigabrain_drivers.protocols import alpha
from gigabrain_drivers.protocols.alpha import Decoder, State, Walk
from gigabrain_drivers.robot import Run
from gigabrain_drivers.sim.physics import Charge, ImuSample, Motor, Odometry
from gigabrain_schemas.topics import IMU
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost, ConfigError, Unsupported

FORWARD = WALKER.to_gait(Twist(0.3, 0.0, 0.0))
MS = 1_000_000
STANDING = Snapshot(
    time_ns=0,
    odometry=Odometry(0, 0, 0, 0, 0),
    wheels=tuple(Motor(name, 0.1, 0.0, 1.0, 30.0) for name in JOINT_NAMES),
    imu=ImuSample((0, 0, 0, 1), (0, 0, 0), (0, 0, 9.81)),
    battery=Charge(28.0, 90.0, 3.0),
    bumper=False,
    contacts=(True,) * 4,
)


class Firmware:
    """The device alone, on a body that only remembers what it was told, in time that is counted."""

    def __init__(self) -> None:
        self.gaits: list[Gait] = []
        self.bytes = bytearray()
        self.untaken: list[Snapshot] = []
        self.body = SimpleNamespace(snapshot=STANDING, walk=self.gaits.append, fresh=self._fresh)
        wire = SimpleNamespace(write=self._write)
        self.device = Alpha(self.body, AlphaOptions(driver="alpha"), wire)  # type: ignore[arg-type]
        self._decoder, self.now_ns = Decoder(), 0
        self.step(0)

    def _write(self, data: bytes) -> bool:
        self.bytes += data
        return True

    def _fresh(self) -> list[Snapshot]:
        untaken, self.untaken = self.untaken, []
        return untaken

    def step(self, milliseconds: int) -> State:
        self.now_ns += milliseconds * MS
        self.body.snapshot = STANDING._replace(time_ns=self.now_ns)
        self.device.step(self.now_ns)
        frames, self.bytes = self._decoder.feed(bytes(self.bytes)), bytearray()
        state = alpha.state_of(frames[-1])
        assert state
        return state

    def walk(self, sequence: int, gait: Gait = FORWARD, seen: int | None = None) -> None:
        now = self.now_ns // MS if seen is None else seen
        self.device.feed(alpha.walk(Walk(now, gait), sequence))


def test_it_starts_standing_and_reports_what_it_measures() -> None:
    state = Firmware().step(10)
    assert (state.flags, state.echo, state.milliseconds) == (alpha.SILENT, 0, 10)
    assert state.voltage == 28.0
    assert state.senses.contacts == (True,) * 4
    assert state.temperatures == (30.0,) * 12


def test_steps_in_which_it_was_held_up_are_reported_all_the_same() -> None:
    firmware = Firmware()
    firmware.untaken = [STANDING._replace(time_ns=ms * MS) for ms in (10, 20, 30)]
    firmware.device.step(30 * MS)
    frames = Decoder().feed(bytes(firmware.bytes))
    reports = [alpha.state_of(frame) for frame in frames]
    assert [report.milliseconds for report in reports if report] == [10, 20, 30]
    assert [frame.sequence for frame in frames] == [2, 3, 4]


def test_its_clock_stands_still_while_its_body_does() -> None:
    firmware = Firmware()
    firmware.step(10)
    firmware.bytes.clear()
    firmware.device.step(90 * MS)
    [frame] = Decoder().feed(bytes(firmware.bytes))
    report = alpha.state_of(frame)
    assert report
    assert report.milliseconds == 10


def test_it_walks_as_told_and_says_which_command_that_was() -> None:
    firmware = Firmware()
    firmware.walk(41)
    state = firmware.step(10)
    assert WALKER.to_body(firmware.gaits[-1]) == pytest.approx((0.3, 0.0, 0.0), abs=1e-6)
    assert (state.flags, state.echo) == (alpha.WALKING, 41)


def test_it_stops_100_ms_after_the_last_command_and_not_before() -> None:
    firmware = Firmware()
    firmware.walk(1)
    assert firmware.step(99).flags == alpha.WALKING
    assert firmware.step(1).flags == alpha.SILENT
    assert firmware.gaits[-1] == REST


def test_what_is_refused_does_not_keep_it_walking() -> None:
    firmware = Firmware()
    firmware.walk(5)
    firmware.step(60)
    firmware.walk(5)
    firmware.walk(4)
    firmware.walk(6, FORWARD._replace(frequency=9.0))
    firmware.walk(7, FORWARD._replace(stride_x=math.nan))
    firmware.device.feed(alpha.walk(Walk(60, FORWARD), 8)[:-1] + b"\x00")
    state = firmware.step(40)
    assert (state.flags, state.echo, state.refused) == (alpha.SILENT, 5, 5)


def test_a_command_that_knows_only_an_old_state_is_refused() -> None:
    firmware = Firmware()
    firmware.step(1000)
    firmware.walk(1, seen=849)
    assert firmware.step(0).refused == 1
    firmware.walk(1, seen=850)
    assert firmware.step(0).flags == alpha.WALKING


def test_stop_is_always_obeyed() -> None:
    firmware = Firmware()
    firmware.walk(100)
    firmware.device.feed(alpha.stop(3))
    assert firmware.gaits[-1] == REST


def test_after_silence_a_new_count_may_begin_anywhere() -> None:
    firmware = Firmware()
    firmware.walk(1000)
    firmware.step(200)
    firmware.walk(1)
    assert firmware.step(10).echo == 1


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=80), max_size=20))
def test_no_bytes_make_it_walk_or_end(pieces: list[bytes]) -> None:
    firmware = Firmware()
    for piece in pieces:
        firmware.device.feed(piece)
        firmware.device.feed(alpha.MAGIC + piece)
    assert firmware.step(10).flags == alpha.SILENT
    assert set(firmware.gaits) == {REST}


async def until(condition: object, seconds: float = 20.0) -> None:
    async with asyncio.timeout(seconds):
        while not condition():  # type: ignore[operator]  # noqa: ASYNC110
            await asyncio.sleep(0.01)


class Rig:
    """The driver, without its lidar, and the emulated body on a port of its own."""

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

    async def commanding(self) -> None:
        """What the driver's process does every 20 ms."""
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
        task = asyncio.create_task(rig.commanding())
        await until(lambda: rig.connected[-1:] == [True])
        yield rig
        task.cancel()
        await asyncio.wait((task,))
    await rig.station.close()
    await rig.body.close()


async def test_the_real_driver_walks_the_emulated_body_ahead_and_sideways(rig: Rig) -> None:
    received = list[object]()
    rig.driver.emit = lambda topic, message: received.append(topic)
    rig.streaming = (0.3, 0.1, 0.0)
    truth = rig.body.simulation.truth
    start = truth.pose()
    await until(lambda: truth.distance_m > 0.5)
    told = rig.device.executed[-1]
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
    assert WALKER.to_body(told) == pytest.approx((0.3, 0.1, 0.0), abs=1e-6)


async def test_it_returns_what_it_sent_within_the_limits_and_nothing_that_is_no_number(
    rig: Rig,
) -> None:
    rig.streaming = None
    fast = await rig.driver.set_base_velocity(9.0, -9.0, 9.0)
    assert (fast.linear_x, fast.linear_y, fast.angular_z) == pytest.approx((0.5, -0.2, 1.0))
    none = await rig.driver.set_base_velocity(math.nan, 0.0, 0.5)
    assert (none.linear_x, none.linear_y, none.angular_z) == (0.0, 0.0, 0.0)


async def test_when_the_stream_stops_the_body_stops(rig: Rig) -> None:
    rig.streaming = (0.3, 0.0, 0.0)
    await until(lambda: rig.device.executed and rig.device.executed[-1].stride_x > 0)
    rig.streaming = None
    await until(lambda: rig.driver._state and rig.driver._state.flags == alpha.SILENT)
    await until(lambda: abs(rig.body.simulation.truth.speed()[0]) < 0.05)


async def test_a_body_that_falls_silent_is_lost_and_comes_back_with_a_stop(rig: Rig) -> None:
    rig.streaming = (0.3, 0.0, 0.0)
    await until(lambda: rig.device.executed and rig.device.executed[-1].stride_x > 0)
    rig.station.set(Faults(silence=True))
    await until(lambda: not rig.connected[-1])
    assert (await rig.driver.set_base_velocity(0.3, 0.0, 0.0)).linear_x in (0.0, 0.3)
    await until(lambda: rig.driver.link.reconnects > 0)
    rig.device.executed.clear()
    rig.station.set(NONE)
    await until(lambda: len(rig.device.executed) > 2)
    assert rig.device.executed[0] == REST
    await until(lambda: rig.connected[-1])


async def test_unplugged_and_plugged_in_again_it_is_found_again(rig: Rig) -> None:
    rig.station.set(Faults(unplugged=True))
    await until(lambda: not rig.connected[-1])
    assert rig.driver.link.problem
    rig.station.set(NONE)
    await until(lambda: rig.connected[-1])
    assert rig.driver.link.reconnects >= 1


async def test_a_frozen_body_is_dropped_and_executes_nothing_old_when_it_thaws(rig: Rig) -> None:
    rig.streaming = (0.3, 0.0, 0.0)
    await until(lambda: rig.device.executed and rig.device.executed[-1].stride_x > 0)
    rig.station.set(Faults(frozen=True))
    await until(lambda: not rig.connected[-1])
    rig.streaming = (0.0, 0.0, 0.0)
    await asyncio.sleep(0.3)
    rig.device.executed.clear()
    rig.station.set(NONE)
    await until(lambda: rig.connected[-1] and len(rig.device.executed) > 5)
    assert all(gait.stride_x == 0.0 for gait in rig.device.executed)


async def test_byte_errors_lose_frames_and_nothing_else(rig: Rig) -> None:
    rig.streaming = (0.2, 0.0, 0.0)
    rig.station.set(Faults(bit_errors=0.005))
    await until(lambda: rig.driver.link.errors > 5)
    told = {round(gait.stride_x, 4) for gait in rig.device.executed}
    assert told <= {0.0, round(0.2 / 3.6, 4)}
    await until(lambda: rig.connected[-1])


async def test_one_client_at_a_time(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    assert rig.port.address
    loop = asyncio.get_running_loop()
    with socket.socket() as other:
        other.setblocking(False)
        await loop.sock_connect(other, rig.port.address)
        assert await loop.sock_recv(other, 10) == b""
    assert rig.port.refused == 1
    await until(lambda: rig.connected[-1])
    monkeypatch.setattr(tcp, "SILENT_NS", 0)  # as if the first had been silent for long
    with socket.socket() as other:
        other.setblocking(False)
        await loop.sock_connect(other, rig.port.address)
        assert (await loop.sock_recv(other, 10))[:2] == alpha.MAGIC


async def test_the_second_emulator_takes_another_port(tmp_path: Path) -> None:
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


async def test_without_a_body_it_opens_says_so_and_closes(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("wrong", ["nowhere", "host:", ":8080", "host:99999", "host:80a"])
def test_an_address_that_is_none_is_refused(wrong: str) -> None:
    with pytest.raises(ConfigError, match="expected HOST:PORT"):
        address(wrong)


def test_addresses() -> None:
    assert address("192.168.1.10:8080") == ("192.168.1.10", 8080)
    assert address("[::1]:80\n") == ("::1", 80)


def test_the_robot_has_all_three_links() -> None:
    robot, driver, options, _ = catalog.load_link("alpha", Run(folder=Path(), link="real"))
    assert driver is AlphaDriver
    assert isinstance(options, AlphaOptions)
    assert options.port == "192.168.123.10:8080"
    assert catalog.links_of(robot) == ["sim", "emulated", "real"]
    run = Run(folder=Path(), link="emulated", emulator="/ports")
    assert catalog.load_link("alpha", run)[2].port == "/ports/base"  # type: ignore[attr-defined]


def test_it_parks_through_silence_and_stands_up_before_it_walks() -> None:
    firmware = Firmware()
    firmware.walk(1)
    firmware.device.feed(alpha.park(2))
    assert firmware.gaits[-1].height == 0.13
    assert firmware.step(200).flags == alpha.SILENT | alpha.PARKED
    assert firmware.gaits[-1].height == 0.13
    for sequence in range(3, 39):  # 1.8 s
        firmware.walk(sequence)
        assert firmware.gaits[-1] == REST
        firmware.step(50)
    firmware.walk(39)
    assert WALKER.to_body(firmware.gaits[-1]) == pytest.approx((0.3, 0.0, 0.0), abs=1e-6)


async def test_parked_it_lies_and_a_new_driver_leaves_it_lying(rig: Rig) -> None:
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
