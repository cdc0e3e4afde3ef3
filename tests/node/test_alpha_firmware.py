"""Alpha's emulated firmware alone, on a body that only records its commands, in fake time."""

import math
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.bodies.alpha import protocol as alpha
from gigabrain_drivers.bodies.alpha.driver import AlphaOptions
from gigabrain_drivers.bodies.alpha.emulator import REST, Alpha
from gigabrain_drivers.bodies.alpha.protocol import AlphaDecoder, State, Walk
from gigabrain_drivers.emulators.base import Snapshot
from gigabrain_drivers.kinematics.legs import JOINT_NAMES, WALKER, Gait
from gigabrain_drivers.kinematics.wheels import Twist
from gigabrain_drivers.sim.locomotion import Charge, Motor, OdometryReading
from gigabrain_drivers.sim.sensors import ImuSample

FORWARD = WALKER.to_gait(Twist(0.3, 0.0, 0.0))
MS = 1_000_000
STANDING = Snapshot(
    time_ns=0,
    odometry=OdometryReading(0, 0, 0, 0, 0),
    wheels=tuple(Motor(name, 0.1, 0.0, 1.0, 30.0) for name in JOINT_NAMES),
    imu=ImuSample((0, 0, 0, 1), (0, 0, 0), (0, 0, 9.81)),
    battery=Charge(28.0, 90.0, 3.0),
    bumper=False,
    contacts=(True,) * 4,
)


class Firmware:
    """The emulated firmware, with its commands in `gaits`, and its time set by `step`."""

    def __init__(self) -> None:
        self.gaits: list[Gait] = []
        self.bytes = bytearray()
        self.waiting: list[Snapshot] = []
        self.body = SimpleNamespace(
            snapshot=STANDING, walk=self.gaits.append, take_snapshots=self._take_snapshots
        )
        wire = SimpleNamespace(write=self._write)
        self.device = Alpha(self.body, AlphaOptions(driver="alpha"), wire)  # type: ignore[arg-type]
        self._decoder, self.now_ns = AlphaDecoder(), 0
        self.step(0)

    def _write(self, data: bytes) -> bool:
        self.bytes += data
        return True

    def _take_snapshots(self) -> list[Snapshot]:
        waiting, self.waiting = self.waiting, []
        return waiting

    def step(self, milliseconds: int) -> State:
        self.now_ns += milliseconds * MS
        self.body.snapshot = STANDING._replace(time_ns=self.now_ns)
        self.device.step(self.now_ns)
        frames, self.bytes = self._decoder.feed(bytes(self.bytes)), bytearray()
        state = alpha.decode_state(frames[-1])
        assert state
        return state

    def walk(self, sequence: int, gait: Gait = FORWARD, seen: int | None = None) -> None:
        now = self.now_ns // MS if seen is None else seen
        self.device.feed(alpha.encode_walk(Walk(now, gait), sequence))


def test_it_starts_standing_and_reports_its_measurements() -> None:
    state = Firmware().step(10)
    assert (state.flags, state.echo, state.milliseconds) == (alpha.SILENT, 0, 10)
    assert state.voltage == 28.0
    assert state.senses.contacts == (True,) * 4
    assert state.temperatures == (30.0,) * 12


def test_steps_during_a_delay_are_reported_afterwards() -> None:
    firmware = Firmware()
    firmware.waiting = [STANDING._replace(time_ns=ms * MS) for ms in (10, 20, 30)]
    firmware.device.step(30 * MS)
    frames = AlphaDecoder().feed(bytes(firmware.bytes))
    reports = [alpha.decode_state(frame) for frame in frames]
    assert [report.milliseconds for report in reports if report] == [10, 20, 30]
    assert [frame.sequence for frame in frames] == [2, 3, 4]


def test_its_clock_stops_while_the_simulation_of_its_body_does() -> None:
    firmware = Firmware()
    firmware.step(10)
    firmware.bytes.clear()
    firmware.device.step(90 * MS)
    [frame] = AlphaDecoder().feed(bytes(firmware.bytes))
    report = alpha.decode_state(frame)
    assert report
    assert report.milliseconds == 10


def test_it_walks_as_commanded_and_echoes_the_command() -> None:
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


def test_refused_commands_do_not_keep_it_walking() -> None:
    firmware = Firmware()
    firmware.walk(5)
    firmware.step(60)
    firmware.walk(5)
    firmware.walk(4)
    firmware.walk(6, FORWARD._replace(frequency=9.0))
    firmware.walk(7, FORWARD._replace(stride_x=math.nan))
    firmware.device.feed(alpha.encode_walk(Walk(60, FORWARD), 8)[:-1] + b"\x00")
    state = firmware.step(40)
    assert (state.flags, state.echo, state.refused) == (alpha.SILENT, 5, 5)


def test_a_command_based_on_an_old_state_is_refused() -> None:
    firmware = Firmware()
    firmware.step(1000)
    firmware.walk(1, seen=849)
    assert firmware.step(0).refused == 1
    firmware.walk(1, seen=850)
    assert firmware.step(0).flags == alpha.WALKING


def test_stop_is_always_obeyed() -> None:
    firmware = Firmware()
    firmware.walk(100)
    firmware.device.feed(alpha.encode_stop(3))
    assert firmware.gaits[-1] == REST


def test_after_silence_a_new_sequence_may_start_at_any_number() -> None:
    firmware = Firmware()
    firmware.walk(1000)
    firmware.step(200)
    firmware.walk(1)
    assert firmware.step(10).echo == 1


@given(st.lists(st.binary(max_size=80), max_size=20))
def test_random_bytes_never_make_it_walk_or_raise(pieces: list[bytes]) -> None:
    firmware = Firmware()
    for piece in pieces:
        firmware.device.feed(piece)
        firmware.device.feed(alpha.MAGIC + piece)
    assert firmware.step(10).flags == alpha.SILENT
    assert set(firmware.gaits) == {REST}


def test_it_stays_parked_after_silence_and_stands_up_before_it_walks() -> None:
    firmware = Firmware()
    firmware.walk(1)
    firmware.device.feed(alpha.encode_park(2))
    assert firmware.gaits[-1].height == 0.13
    assert firmware.step(200).flags == alpha.SILENT | alpha.PARKED
    assert firmware.gaits[-1].height == 0.13
    for sequence in range(3, 39):  # 1.8 s
        firmware.walk(sequence)
        assert firmware.gaits[-1] == REST
        firmware.step(50)
    firmware.walk(39)
    assert WALKER.to_body(firmware.gaits[-1]) == pytest.approx((0.3, 0.0, 0.0), abs=1e-6)
