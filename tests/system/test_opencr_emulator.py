"""The emulated OpenCR behaves like the vendor's firmware, also with the vendor's SDK."""

import asyncio
import itertools
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dynamixel_sdk
import pytest

from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.bodies.turtlebot3.driver import OpenCrOptions
from gigabrain_drivers.bodies.turtlebot3.emulator import OpenCr
from gigabrain_drivers.bodies.turtlebot3.protocol import DynamixelDecoder, DynamixelPacket
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.emulators.emulator import Station, emulated_body
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_zenoh.clock import Clock

MS = 1_000_000


class Wire:
    """A wire that records the replies of the board."""

    def __init__(self) -> None:
        self._decoder = DynamixelDecoder()
        self.answers: list[DynamixelPacket] = []

    def write(self, data: bytes) -> bool:
        self.answers += self._decoder.feed(data)
        return True


class Bench:
    """A board in fake time."""

    def __init__(self, robot: str) -> None:
        assert load_robot(robot)
        self.body = emulated_body(robot, Run(folder=Path()))
        self.wire = Wire()
        self.board = OpenCr(self.body, OpenCrOptions(driver="opencr"), self.wire)
        self.now_ns = 10**15
        self.wait(20)

    def wait(self, milliseconds: int) -> None:
        for _ in range(milliseconds // 20):
            self.board.step(self.now_ns)
            self.now_ns += 20 * MS

    def ask(self, frame: bytes) -> DynamixelPacket | None:
        self.wire.answers.clear()
        self.board.feed(frame)
        return self.wire.answers[0] if self.wire.answers else None

    def read(self, address: int, length: int) -> bytes:
        answer = self.ask(opencr.read(opencr.ID, address, length))
        assert answer
        return answer.params[1:]

    def drive(self, forward: float, turn: float, beat: int) -> None:
        self.ask(opencr.heartbeat(beat))
        self.wait(20)
        self.ask(opencr.velocity(forward, turn).frame)
        self.wait(20)


@pytest.fixture(name="bench")
def make_bench() -> Bench:
    return Bench("turtlebot3_waffle")


def test_it_reports_its_model_and_firmware(bench: Bench) -> None:
    answer = bench.ask(opencr.ping(200))
    assert answer == DynamixelPacket(200, opencr.STATUS, bytes([0, 0x00, 0x50, 5]))
    assert bench.read(0, 10).hex(" ") == "00 50 02 00 00 00 05 c8 03 02"


@pytest.mark.parametrize(
    "frame",
    [
        opencr.ping(1),
        opencr.ping(254),
        opencr.encode(DynamixelPacket(200, 0x82, bytes(6))),
        opencr.read(200, 0, 1014),
        opencr.encode(DynamixelPacket(200, opencr.READ, bytes(3))),
        opencr.encode(DynamixelPacket(200, opencr.WRITE, bytes(2))),
        opencr.status(200),
    ],
    ids=["other id", "broadcast", "sync read", "too long", "short read", "empty write", "status"],
)
def test_frames_for_other_devices_are_ignored(bench: Bench, frame: bytes) -> None:
    assert bench.ask(frame) is None


def test_only_whole_items_can_be_read_and_gaps_are_zero(bench: Bench) -> None:
    assert bench.read(1, 1) == b"\0"
    assert bench.read(0, 2) == b"\x00\x50"
    assert bench.read(51, 8) == bytes(8)
    assert len(bench.read(10, 172)) == 172


def test_only_whole_items_can_be_written(bench: Bench) -> None:
    bench.ask(opencr.write(200, 150, b"\x01\x02\x03"))
    assert bench.read(150, 4) == bytes(4)
    bench.ask(opencr.write(200, 149, b"\x00" + struct.pack("<i", 7) + b"\xff"))
    assert bench.read(149, 6) == b"\x00\x07\x00\x00\x00\x00"


def test_without_a_heartbeat_nothing_moves(bench: Bench) -> None:
    bench.ask(opencr.velocity(0.2, 0.0).frame)
    bench.wait(40)
    assert bench.body.commanded == (0.0, 0.0, 0.0)
    assert bench.read(15, 1) == b"\0"


def test_a_velocity_is_rounded_to_the_units_of_the_motors(bench: Bench) -> None:
    bench.drive(0.15, 0.3, beat=1)
    forward, _, turn = bench.body.commanded
    assert forward == pytest.approx((135 + 243) / 2 / 1263.632956882)
    assert turn == pytest.approx((243 - 135) / 1263.632956882 / 0.287)


def test_each_wheel_is_limited_separately(bench: Bench) -> None:
    bench.drive(0.26, 1.0, beat=1)
    forward, _, turn = bench.body.commanded
    assert forward == pytest.approx((147 + 337) / 2 / 1263.632956882)
    assert turn == pytest.approx((337 - 147) / 1263.632956882 / 0.287)


@pytest.mark.parametrize(
    ("robot", "forward", "turn"),
    [("turtlebot3_burger", 0.2108, 2.635), ("turtlebot3_waffle", 0.2661, 1.854)],
)
def test_speeds_are_limited_as_in_the_firmware(robot: str, forward: float, turn: float) -> None:
    bench = Bench(robot)
    bench.drive(1.0, 0.0, beat=1)
    assert bench.body.commanded[0] == pytest.approx(forward, abs=1e-3)
    bench.drive(0.0, -9.0, beat=2)
    assert bench.body.commanded[2] == pytest.approx(-turn, abs=0.01)


def test_the_wheels_stop_half_a_second_after_the_heartbeat_last_changed(bench: Bench) -> None:
    bench.drive(0.2, 0.0, beat=1)
    for _ in range(22):
        bench.ask(opencr.heartbeat(1))
        bench.wait(20)
    assert bench.body.commanded[0] > 0.19
    bench.wait(60)
    assert bench.body.commanded == (0.0, 0.0, 0.0)
    assert bench.read(15, 1) == b"\0"


def test_a_heartbeat_alone_does_not_restore_the_old_speed(bench: Bench) -> None:
    bench.drive(0.2, 0.0, beat=1)
    bench.wait(600)
    bench.ask(opencr.heartbeat(2))
    bench.wait(100)
    assert bench.body.commanded == (0.0, 0.0, 0.0)


def test_in_debug_mode_it_drives_on_without_a_heartbeat(bench: Bench) -> None:
    bench.ask(opencr.write(200, 14, b"\x01"))
    bench.drive(0.2, 0.0, beat=1)
    bench.wait(2000)
    assert bench.body.commanded[0] > 0.19


def test_without_torque_it_stands(bench: Bench) -> None:
    bench.ask(opencr.torque(on=False))
    bench.drive(0.2, 0.0, beat=1)
    assert bench.body.commanded == (0.0, 0.0, 0.0)


def test_it_ignores_everything_for_five_seconds_of_calibration(bench: Bench) -> None:
    assert bench.ask(opencr.write(200, 59, b"\x01")) is None
    assert bench.ask(opencr.ping(200)) is None
    bench.wait(4980)
    assert bench.wire.answers == []
    bench.wait(60)
    assert [len(answer.params) for answer in bench.wire.answers] == [1, 4]


def test_the_charge_stands_still_below_ten_and_a_half_volts(bench: Bench) -> None:
    def charge() -> tuple[int, int]:
        voltage, percentage = struct.unpack("<II", bench.read(42, 8))
        return voltage, percentage

    voltage, percentage = charge()
    assert 1230 < voltage < 1270
    assert percentage == pytest.approx((voltage - 1050) / 180 * 10_000, abs=60)
    bench.board.sag_volts = 3.0
    bench.wait(20)
    assert charge() == pytest.approx((voltage - 300, percentage), abs=1)
    assert charge()[1] == percentage


def test_it_is_off_at_low_voltage_and_restarts_afterwards(bench: Bench) -> None:
    bench.drive(0.2, 0.0, beat=1)
    bench.board.sag_volts = 9.0
    bench.wait(20)
    assert bench.ask(opencr.ping(200)) is None
    assert bench.body.commanded == (0.0, 0.0, 0.0)
    bench.board.sag_volts = 0.0
    bench.wait(40)
    assert struct.unpack("<I", bench.read(10, 4))[0] < 100
    assert bench.read(150, 4) == bytes(4)


async def test_the_vendors_sdk_reads_and_drives_the_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # [ms], timeout of the SDK; its default of 16 is too short for a busy machine
    monkeypatch.setattr(dynamixel_sdk.port_handler, "LATENCY_TIMER", 1000)
    body = emulated_body("turtlebot3_waffle", Run(folder=Path()))
    port = Pty(tmp_path / "base")
    station = Station(lambda wire: OpenCr(body, None, wire), port, Clock())
    body.start()
    station.start()
    try:
        await asyncio.to_thread(_by_the_sdk, str(port.path), body)
    finally:
        await station.close()
        await body.close()


def _by_the_sdk(path: str, body: EmulatedBody) -> None:
    line = dynamixel_sdk.PortHandler(path)
    sdk = dynamixel_sdk.PacketHandler(2.0)
    assert line.openPort()
    assert line.setBaudRate(1_000_000)

    def readings() -> opencr.Readings:
        (data,) = _successful_value(sdk.readTxRx(line, 200, 10, 172))
        return opencr.decode_readings(bytes(data))

    try:
        assert _successful_value(sdk.ping(line, 200)) == [0x5000]
        assert _successful_value(sdk.read4ByteTxRx(line, 200, 2)) == [2]
        _until(lambda: readings().linear_acceleration[2] == pytest.approx(9.81, abs=0.2))
        found = readings()
        assert 12.3 < found.voltage < 12.7
        assert found.orientation == pytest.approx((0, 0, 0, 1), abs=0.02)
        assert found.ticks == pytest.approx((1234, 3210), abs=3)
        beats = itertools.cycle(range(256))

        def driven() -> bool:
            _successful_value(sdk.write1ByteTxRx(line, 200, 19, next(beats)))
            _successful_value(
                sdk.writeTxRx(line, 200, 150, 24, struct.pack("<6i", 20, 0, 0, 0, 0, 0))
            )
            return readings().ticks[0] > 1234 + 500

        _until(driven)
        assert body.commanded[0] == pytest.approx(0.2, abs=1e-3)
        assert readings().velocities == pytest.approx((6.06, 6.06), abs=0.2)
        assert sdk.ping(line, 1)[1] == dynamixel_sdk.COMM_RX_TIMEOUT
        _until(lambda: body.commanded == (0.0, 0.0, 0.0))
    finally:
        line.closePort()


def _until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not true():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.005)


def _successful_value(answer: tuple[Any, ...]) -> list[Any]:
    """Assert that the SDK reports success; return the values that it read, as a list."""
    *values, result, error = answer
    assert (result, error) == (dynamixel_sdk.COMM_SUCCESS, 0)
    return values[:1]
