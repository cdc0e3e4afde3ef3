"""TurtleBot3's driver when its line, its board or its answers fail; then over a real pty."""

import asyncio
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.bodies.turtlebot3.driver import OpenCrDriver, is_opencr
from gigabrain_drivers.bodies.turtlebot3.emulator import OpenCr
from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import Snapshot
from gigabrain_drivers.emulators.emulator import Station, emulated_body
from gigabrain_drivers.emulators.faults import Faults
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.clock import Clock
from tests.unit.drivers.opencr import Rig, make_rig  # noqa: F401


async def test_a_failed_read_does_not_count_as_a_fresh_one(rig: Rig) -> None:
    await rig.drive(0.0, 0.0, 40)
    before = len(rig.published)
    rig.cable.held = []
    await rig.wait(60)
    state = await rig.driver.read_state()
    assert state.link.age_ms == 60.0 + 20.0
    assert state.link.connected
    await rig.wait(40)
    state = await rig.driver.read_state()
    assert not state.link.connected
    assert len(rig.published) == before


async def test_a_late_reply_is_dropped(rig: Rig) -> None:
    await rig.drive(0.0, 0.0, 40)
    before = len(rig.published)
    rig.cable.held = []
    await rig.driver.read_state()
    await rig.wait(20)
    late = b"".join(rig.cable.held)
    rig.cable.held = []
    await rig.driver.read_state()
    rig.cable.arrive(late)
    rig.cable.on_bytes(late)
    assert len(rig.published) == before
    rig.cable.held = None
    assert (await rig.driver.read_state()).link.age_ms == 0.0
    assert len(rig.published) == before + 1


async def test_bytes_from_before_a_reconnection_are_dropped(rig: Rig) -> None:
    rig.cable.held = []
    await rig.driver.read_state()
    answer = b"".join(rig.cable.held)
    before = len(rig.published)
    rig.cable.drop("cut")
    rig.cable.plug()
    rig.cable.on_bytes(answer)
    assert len(rig.published) == before
    assert not (await rig.driver.read_state()).link.connected


async def test_the_line_to_a_silent_board_is_closed(rig: Rig) -> None:
    await rig.drive(0.2, 0.0, 200)
    rig.cable.held = []
    await rig.drive(0.2, 0.0, 240)
    assert rig.cable.drops == ["the OpenCR has stopped answering"]
    assert rig.driver.problem == "the OpenCR has stopped answering"
    before = len(rig.cable.velocities())
    rig.cable.held = None
    rig.cable.plug()
    await rig.wait(40)
    assert set(rig.cable.velocities()[before:]) == {(0, 0)}
    assert (await rig.driver.read_state()).link.connected


async def test_commands_during_a_lost_link_are_dropped(rig: Rig) -> None:
    rig.cable.drop("unplugged")
    before = len(rig.cable.sent)
    sent = await rig.driver.set_base_velocity(0.2, 0.0, 0.0)
    assert (sent.linear_x, sent.angular_z) == (0.0, 0.0)
    assert not (await rig.driver.read_state()).link.connected
    rig.cable.plug()
    assert set(rig.cable.velocities()[before:]) <= {(0, 0)}


async def test_another_dynamixel_device_is_not_driven(rig: Rig) -> None:
    rig.cable.drop("cut")
    rig.cable.to_board = lambda data: None
    rig.cable.plug()
    rig.cable.on_bytes(opencr.status(200, bytes([0x06, 0x04, 0x26])))
    assert rig.cable.drops[-1].endswith("a Dynamixel of model 1030, not to an OpenCR")
    assert not (await rig.driver.set_base_velocity(0.2, 0.0, 0.0)).linear_x


async def test_a_port_without_replies_is_probed_and_reopened(rig: Rig) -> None:
    rig.cable.drop("cut")
    rig.cable.to_board = lambda data: None
    rig.cable.plug()
    before = len(rig.cable.sent)
    await rig.wait(900)
    pings = [p for p in rig.cable.sent[before:] if p.instruction == opencr.PING]
    assert 6 <= len(pings) <= 10
    await rig.wait(200)
    assert rig.cable.drops[-1].endswith("is open, but no OpenCR answers: right port, power on?")


async def test_silent_motors_and_debug_mode_count_as_a_lost_body(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    rig.board.feed(opencr.write(200, 14, b"\x01"))
    await rig.drive(0.0, 0.0, 700)
    assert not (await rig.driver.read_state()).link.connected
    assert "does not stop by itself" in rig.driver.problem
    rig.board.feed(opencr.write(200, 14, b"\x00"))
    rig.board.feed(opencr.write(200, 18, b"\xff"))
    await rig.drive(0.0, 0.0, 60)
    assert "switch their power on" in rig.driver.problem
    rig.board.feed(opencr.write(200, 18, b"\x00"))
    await rig.drive(0.0, 0.0, 60)
    assert (await rig.driver.read_state()).link.connected
    assert [record.message for record in caplog.records] == [
        "OpenCR is in debug mode, in which it does not stop by itself: restart it",
        "OpenCR reaches no motors: switch their power on, then press its reset button",
        "OpenCR on Cable answers, firmware 5",
    ]


async def test_garbage_and_a_board_restart_do_not_move_the_pose(rig: Rig) -> None:
    await rig.drive(0.0, 0.0, 100)
    rig.cable.on_bytes(b"OpenCR boot\r\n\xff\xff\xfd\x00" * 20)
    state = await rig.drive(0.0, 0.0, 100)
    assert state.link.errors > 0
    assert state.link.connected
    rig.board.reset()
    rig.board._table[136] = 99_999
    state = await rig.drive(0.0, 0.0, 100)
    assert (state.pose.x, state.pose.y) == pytest.approx((0, 0), abs=1e-3)


async def test_a_board_that_restarted_during_a_loss_does_not_move_the_pose(rig: Rig) -> None:
    await rig.drive(0.0, 0.0, 1000)
    rig.cable.drop("unplugged")
    rig.board.reset()
    rig.body.snapshot = turned(rig.body.snapshot, 10.0)
    await rig.wait(3000)  # long enough to turn the wheels as far as their counters jump
    rig.cable.plug()
    state = await rig.drive(0.0, 0.0, 100)
    assert state.link.connected
    assert (state.pose.x, state.pose.y) == pytest.approx((0, 0), abs=1e-3)
    rig.body.snapshot = turned(rig.body.snapshot, 0.1)
    state = await rig.drive(0.0, 0.0, 100)
    assert state.pose.x == pytest.approx(0.0033, abs=1e-4)


async def test_a_body_that_is_pushed_during_a_loss_moves_its_pose(rig: Rig) -> None:
    await rig.drive(0.0, 0.0, 1000)
    rig.cable.drop("unplugged")
    rig.body.snapshot = turned(rig.body.snapshot, 10.0)
    await rig.wait(3000)
    rig.cable.plug()
    assert (await rig.drive(0.0, 0.0, 100)).pose.x == pytest.approx(0.33, abs=1e-3)


def turned(now: Snapshot, angle: float) -> Snapshot:
    """Return measurements of wheels that turned by `angle` [rad] since."""
    wheels = (wheel._replace(position=wheel.position + angle) for wheel in now.wheels)
    return now._replace(wheels=tuple(wheels))


@pytest.mark.parametrize(
    ("answer", "ours"),
    [
        (opencr.status(200, b"\x00\x50\x05"), True),
        (opencr.status(200, b"\x06\x04\x26"), False),
        (b"", False),
        (b"\x54\x2c" * 7, False),
    ],
    ids=["opencr", "a motor", "nobody", "a lidar"],
)
def test_an_opencr_port_is_recognised_by_its_reply(answer: bytes, ours: bool) -> None:
    class Port:
        written = b""

        def write(self, data: bytes) -> None:
            self.written += data

        def read(self, _size: int) -> bytes:
            return answer

    port = Port()
    assert is_opencr(port) is ours  # type: ignore[arg-type]
    assert port.written == opencr.ping(200)


async def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not true():
        assert time.monotonic() < deadline, "it never happened"
        await asyncio.sleep(0.005)


async def test_over_a_real_pty_it_drives_stops_and_survives_cable_faults(
    tmp_path: Path,
) -> None:
    body = emulated_body("turtlebot3_waffle", Run(folder=Path()))
    port = Pty(tmp_path / "base")
    station = Station(lambda wire: OpenCr(body, None, wire), port, Clock())
    run = Run(folder=Path(), link="emulated", emulator=str(tmp_path))
    _, driver = make_driver("turtlebot3_waffle", run)
    assert isinstance(driver, OpenCrDriver)
    body.start()
    states: list[RobotState] = []
    goal = 0.0

    async def live() -> None:
        async for _ in driver.ticks(Clock()):
            states.append(await driver.read_state())
            if goal is not None:
                await driver.set_base_velocity(goal, 0.0, 0.0)

    try:
        async with driver:  # before the port exists
            task = asyncio.create_task(live())
            await asyncio.sleep(0.1)
            station.start()
            await until(lambda: bool(states) and states[-1].link.connected)
            goal = 0.2
            await until(lambda: states[-1].pose.x > 0.05)
            goal = 0.0
            await until(lambda: abs(body.snapshot.odometry.linear_x) < 1e-3)
            await until(lambda: abs(states[-1].pose.x - body.snapshot.odometry.x) < 0.02)
            station.set(Faults(unplugged=True))
            await until(lambda: not states[-1].link.connected)
            goal = 0.0
            station.set(Faults())
            await until(lambda: states[-1].link.connected)
            assert states[-1].link.reconnects >= 1
            goal = 0.2
            await until(lambda: body.commanded[0] > 0.19)
            station.set(Faults(frozen=True))
            await until(lambda: not states[-1].link.connected)
            goal = 0.0
            station.set(Faults())
            await until(lambda: body.commanded[0] == 0 and states[-1].link.connected)
            station.set(Faults(bit_errors=0.001))
            await until(lambda: states[-1].link.errors > 3)
            task.cancel()
        await until(lambda: body.commanded[0] == 0)
    finally:
        await station.close()
        await body.close()
