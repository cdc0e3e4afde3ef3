"""TurtleBot3's driver: with a board in memory and time by hand, then over a real pty."""

import asyncio
import math
import struct
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from gigabrain_drivers.catalog import load_robot, make_driver
from gigabrain_drivers.emulators.faults import Faults
from gigabrain_drivers.emulators.opencr import OpenCr
from gigabrain_drivers.emulators.physics import emulated_body
from gigabrain_drivers.emulators.pty import Pty
from gigabrain_drivers.emulators.station import Station
from gigabrain_drivers.links.link import Link
from gigabrain_drivers.opencr.board import is_opencr
from gigabrain_drivers.opencr.driver import OpenCrDriver, OpenCrOptions, imu_of
from gigabrain_drivers.protocols import dynamixel, opencr
from gigabrain_drivers.protocols.dynamixel import Decoder, Packet
from gigabrain_drivers.robot import Run
from gigabrain_schemas.base import Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import Imu
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.clock import Clock, FakeClock
from gigabrain_zenoh.errors import BodyLost, Unsupported

MS = 1_000_000
WAFFLE = load_robot("turtlebot3_waffle")
OPTIONS = OpenCrOptions(driver="opencr", port="memory")


class Cable(Link):
    """A link in memory. Both ways can be cut, or hold back what is sent."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.to_board: Callable[[bytes], None] = lambda data: None
        self.sent: list[Packet] = []
        self.held: list[bytes] | None = None  # answers on their way, while they are held back
        self.drops: list[str] = []
        self._decoder = Decoder()

    def __str__(self) -> str:
        return "Cable"

    def open(self) -> None:
        self.plug()

    def plug(self) -> None:
        self._fd, self.problem = 0, ""
        self.on_open()

    def write(self, data: bytes) -> bool:
        """To the board."""
        if self._fd is None:
            return False
        self.sent += self._decoder.feed(data)
        self.to_board(data)
        return True

    def arrive(self, data: bytes) -> bool:
        if self.held is None:
            self.on_bytes(data)
        else:
            self.held.append(data)
        return True

    def drop(self, why: str) -> None:
        if self._fd is not None:
            self._fd, self.problem = None, why
            self.drops.append(why)
            self.on_lost(why)

    async def close(self) -> None:
        self.drop("closed")

    async def _connect(self) -> int:
        raise NotImplementedError

    def _shut(self) -> None:
        raise NotImplementedError

    def _cut_short(self) -> None:
        raise NotImplementedError

    def velocities(self) -> list[tuple[int, int]]:
        """What was sent to address 150, in hundredths."""
        goals = [struct.unpack("<6i", p.params[2:]) for p in self.sent if p.params[:2] == b"\x96\0"]
        return [(goal[0], goal[5]) for goal in goals]


class Wire:
    def __init__(self, cable: Cable) -> None:
        self._cable = cable

    def write(self, data: bytes) -> bool:
        return self._cable.arrive(data)


class Rig:
    """Driver, cable and board on one clock that the test moves."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.cable = Cable(self.clock)
        self.body = emulated_body("turtlebot3_waffle", Run(folder=Path()))
        self.board = OpenCr(self.body, None, Wire(self.cable))
        self.cable.to_board = self.board.feed
        run = Run(folder=Path(), link="real")
        self.driver = OpenCrDriver(WAFFLE, OPTIONS, run, clock=self.clock, link=self.cable)
        self.published: list[tuple[Topic[Imu], Message]] = []
        self.driver.emit = lambda topic, message: self.published.append((topic, message))

    async def wait(self, milliseconds: int) -> None:
        """The board's time goes on in its own steps."""
        for _ in range(milliseconds // 20):
            self.board.step(self.clock.now_ns())
            await self.clock.advance(20 * MS)

    async def drive(self, forward: float, turn: float, milliseconds: int) -> RobotState:
        """As the driver's process does: read, then command."""
        for _ in range(milliseconds // 20):
            state = await self.driver.read_state()
            await self.driver.set_base_velocity(forward, 0.0, turn)
            await self.wait(20)
        return state


@pytest.fixture(name="rig")
async def make_rig() -> AsyncIterator[Rig]:
    rig = Rig()
    async with rig.driver:
        await rig.wait(40)
        yield rig


async def test_a_connection_begins_with_zero_and_with_the_question_who_is_there(rig: Rig) -> None:
    first, second = rig.cable.sent[:2]
    assert rig.cable.velocities()[0] == (0, 0)
    assert (first.instruction, second.instruction) == (dynamixel.WRITE, dynamixel.PING)
    assert rig.driver.problem == ""


async def test_it_drives_and_says_what_was_really_sent(rig: Rig) -> None:
    await rig.drive(0.123, 0.456, 100)
    assert rig.cable.velocities()[-1] == (12, 46)
    sent = await rig.driver.set_base_velocity(0.123, 0.3, 0.456)
    assert (sent.linear_x, sent.linear_y, sent.angular_z) == pytest.approx((0.12, 0.0, 0.46))
    assert rig.body.commanded[0] == pytest.approx(0.12, abs=1e-3)


async def test_commands_stay_within_what_the_body_can_do_and_keep_their_curve(rig: Rig) -> None:
    fast = await rig.driver.set_base_velocity(9.0, 0.0, 0.0)
    assert fast.linear_x == pytest.approx(0.26)
    curve = await rig.driver.set_base_velocity(0.26, 0.0, 1.3)
    assert curve.angular_z / curve.linear_x == pytest.approx(5.0, rel=0.05)
    wheel = curve.linear_x + curve.angular_z * 0.287 / 2
    assert 0.26 < wheel < 0.275


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
async def test_what_is_no_number_stops_it(rig: Rig, bad: float) -> None:
    await rig.drive(0.2, 0.0, 100)
    await rig.driver.set_base_velocity(0.2, 0.0, bad)
    assert rig.cable.velocities()[-1] == (0, 0)
    await rig.drive(0.2, 0.0, 100)
    await rig.driver.set_base_velocity(bad, 0.0, 0.1)
    assert rig.cable.velocities()[-1] == (0, 0)


async def test_the_body_stops_within_150_ms_of_the_last_command(rig: Rig) -> None:
    await rig.drive(0.2, 0.0, 200)
    await rig.driver.set_base_velocity(0.2, 0.0, 0.0)
    last = rig.clock.now_ns()
    while rig.body.commanded[0] > 0:
        await rig.driver.read_state()  # the process lives; only nobody commands any more
        await rig.wait(20)
    assert rig.clock.now_ns() - last <= 150 * MS


async def test_where_zero_gets_lost_it_is_sent_again(rig: Rig) -> None:
    await rig.drive(0.2, 0.0, 200)
    rig.cable.to_board = lambda data: None
    await rig.wait(120)
    rig.cable.to_board = rig.board.feed
    await rig.wait(40)
    assert rig.body.commanded == (0.0, 0.0, 0.0)


async def test_the_board_stops_half_a_second_after_the_driver_has_died(rig: Rig) -> None:
    await rig.drive(0.2, 0.0, 200)
    rig.cable.to_board = lambda data: None
    for _ in range(24):
        rig.board.step(rig.clock.now_ns())
        await rig.clock.advance(20 * MS)
    assert rig.body.commanded[0] > 0.19
    await rig.wait(60)
    assert rig.body.commanded == (0.0, 0.0, 0.0)


async def test_stop_is_zero_at_once_and_can_be_had_in_any_state(rig: Rig) -> None:
    await rig.drive(0.2, 0.0, 200)
    await rig.driver.stop()
    assert rig.cable.velocities()[-1] == (0, 0)
    await rig.driver.close()
    assert rig.cable.velocities()[-1] == (0, 0)
    await rig.driver.close()
    await rig.driver.stop()


async def test_nothing_is_ever_written_to_address_14(rig: Rig) -> None:
    await rig.drive(0.2, 0.5, 400)
    rig.cable.drop("cut")
    rig.cable.plug()
    await rig.drive(-0.2, 0.5, 400)
    await rig.driver.stop()
    await rig.driver.close()
    written = {
        struct.unpack_from("<H", packet.params)[0]: len(packet.params) - 2
        for packet in rig.cable.sent
        if packet.instruction == dynamixel.WRITE
    }
    assert written == {19: 1, 149: 1, 150: 24}


async def test_the_state_is_the_boards(rig: Rig) -> None:
    state = await rig.driver.read_state()
    assert state.robot_type == "turtlebot3_waffle"
    assert state.battery
    assert state.battery.voltage == pytest.approx(12.54, abs=0.02)
    assert state.battery.percentage == 100.0
    assert state.imu
    assert state.imu.orientation == pytest.approx((0, 0, 0, 1), abs=0.02)
    assert state.bumpers == (False, False)
    assert [joint.name for joint in state.joints] == ["wheel_left_joint", "wheel_right_joint"]
    assert [joint.position for joint in state.joints] == pytest.approx(
        [1234 * 0.001533981, 3210 * 0.001533981], abs=0.01
    )
    assert state.link.connected
    assert state.link.age_ms == 0.0
    assert isinstance(rig.published[-1][1], Imu)
    assert await rig.driver.get_sensor_data("imu") is rig.published[-1][1]


async def test_a_failed_read_is_never_taken_for_a_fresh_one(rig: Rig) -> None:
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


async def test_an_answer_that_comes_late_is_thrown_away(rig: Rig) -> None:
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


async def test_what_is_left_from_before_a_reconnection_is_not_looked_at(rig: Rig) -> None:
    rig.cable.held = []
    await rig.driver.read_state()
    answer = b"".join(rig.cable.held)
    before = len(rig.published)
    rig.cable.drop("cut")
    rig.cable.plug()
    rig.cable.on_bytes(answer)
    assert len(rig.published) == before
    assert not (await rig.driver.read_state()).link.connected


async def test_a_board_that_has_stopped_answering_gets_its_line_closed(rig: Rig) -> None:
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


async def test_while_the_link_is_down_nothing_is_kept_for_later(rig: Rig) -> None:
    rig.cable.drop("unplugged")
    before = len(rig.cable.sent)
    sent = await rig.driver.set_base_velocity(0.2, 0.0, 0.0)
    assert (sent.linear_x, sent.angular_z) == (0.0, 0.0)
    assert not (await rig.driver.read_state()).link.connected
    rig.cable.plug()
    assert set(rig.cable.velocities()[before:]) <= {(0, 0)}


async def test_somebody_elses_dynamixel_is_not_driven(rig: Rig) -> None:
    rig.cable.drop("cut")
    rig.cable.to_board = lambda data: None
    rig.cable.plug()
    rig.cable.on_bytes(dynamixel.status(200, bytes([0x06, 0x04, 0x26])))
    assert rig.cable.drops[-1].endswith("a Dynamixel of model 1030, not to an OpenCR")
    assert not (await rig.driver.set_base_velocity(0.2, 0.0, 0.0)).linear_x


async def test_a_port_on_which_nobody_answers_is_knocked_at_and_opened_anew(rig: Rig) -> None:
    rig.cable.drop("cut")
    rig.cable.to_board = lambda data: None
    rig.cable.plug()
    before = len(rig.cable.sent)
    await rig.wait(900)
    pings = [p for p in rig.cable.sent[before:] if p.instruction == dynamixel.PING]
    assert 6 <= len(pings) <= 10
    await rig.wait(200)
    assert rig.cable.drops[-1].endswith("is open, but no OpenCR answers: is its power on?")


async def test_silent_motors_and_debug_mode_count_as_a_body_that_does_not_answer(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    rig.board.feed(dynamixel.write(200, 14, b"\x01"))
    await rig.drive(0.0, 0.0, 700)
    assert not (await rig.driver.read_state()).link.connected
    assert "does not stop by itself" in rig.driver.problem
    rig.board.feed(dynamixel.write(200, 14, b"\x00"))
    rig.board.feed(dynamixel.write(200, 18, b"\xff"))
    await rig.drive(0.0, 0.0, 60)
    assert "switch their power on" in rig.driver.problem
    rig.board.feed(dynamixel.write(200, 18, b"\x00"))
    await rig.drive(0.0, 0.0, 60)
    assert (await rig.driver.read_state()).link.connected
    assert [record.message for record in caplog.records] == [
        "OpenCR is in debug mode, in which it does not stop by itself: restart it",
        "OpenCR reaches no motors: switch their power on, then press its reset button",
        "OpenCR on Cable answers, firmware 5",
    ]


async def test_garbage_and_a_board_that_restarts_do_not_move_the_pose(rig: Rig) -> None:
    await rig.drive(0.0, 0.0, 100)
    rig.cable.on_bytes(b"OpenCR boot\r\n\xff\xff\xfd\x00" * 20)
    state = await rig.drive(0.0, 0.0, 100)
    assert state.link.errors > 0
    assert state.link.connected
    rig.board.reset()
    rig.board._table[136] = 99_999
    state = await rig.drive(0.0, 0.0, 100)
    assert (state.pose.x, state.pose.y) == pytest.approx((0, 0), abs=1e-3)


async def test_an_unknown_sensor_is_refused_with_the_known_ones(rig: Rig) -> None:
    with pytest.raises(Unsupported, match="no sensor 'sonar'; it has: imu"):
        await rig.driver.get_sensor_data("sonar")


@pytest.mark.parametrize("broken", [(0.0,) * 4, (math.nan,) * 4, (2.0, 0.0, 0.0, 0.0)])
def test_an_attitude_that_cannot_be_is_left_out(broken: tuple[float, ...]) -> None:
    data = bytearray(172)
    data[86:102] = struct.pack("<4f", *broken)
    assert imu_of(opencr.readings(bytes(data))) is None


@pytest.mark.parametrize(
    ("answer", "ours"),
    [
        (dynamixel.status(200, b"\x00\x50\x05"), True),
        (dynamixel.status(200, b"\x06\x04\x26"), False),
        (b"", False),
        (b"\x54\x2c" * 7, False),
    ],
    ids=["opencr", "a motor", "nobody", "a lidar"],
)
def test_a_port_is_known_by_its_answer(answer: bytes, ours: bool) -> None:
    class Port:
        written = b""

        def write(self, data: bytes) -> None:
            self.written += data

        def read(self, _size: int) -> bytes:
            return answer

    port = Port()
    assert is_opencr(port) is ours  # type: ignore[arg-type]
    assert port.written == dynamixel.ping(200)


async def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 15
    while not true():
        assert time.monotonic() < deadline, "it never happened"
        await asyncio.sleep(0.005)


async def test_over_a_real_pty_it_drives_stops_and_survives_what_a_cable_can_do(
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
        async with driver:  # before there is any port
            task = asyncio.create_task(live())
            await asyncio.sleep(0.1)
            station.start()
            await until(lambda: bool(states) and states[-1].link.connected)
            goal = 0.2
            await until(lambda: states[-1].pose.x > 0.05)
            assert states[-1].pose.x == pytest.approx(body.snapshot.odometry.x, abs=0.02)
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


async def test_its_motors_can_be_let_go_and_the_next_connection_holds_them_again(rig: Rig) -> None:
    def torques() -> list[int]:
        written = [p.params for p in rig.cable.sent if p.instruction == dynamixel.WRITE]
        return [params[2] for params in written if params[:2] == b"\x95\x00"]

    assert torques() == [1]
    await rig.driver.limp()
    await rig.drive(0.2, 0.0, 200)
    await rig.driver.stop()
    assert torques() == [1, 0]
    rig.cable.drop("unplugged")
    with pytest.raises(BodyLost, match="unplugged"):
        await rig.driver.limp()
    rig.cable.plug()
    await rig.wait(100)
    assert torques() == [1, 0, 1]
