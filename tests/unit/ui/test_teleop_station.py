"""Keys and gamepad of teleoperation; releasing either stops the robot."""

import asyncio
import contextlib
import os
import pty
import struct
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Arm, GateStatus, Joint, JointDescription, RobotState
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import GateReply
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.gate.causes import estop
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.testing.waiting import until
from gigabrain_zenoh.ui.teleop_station import (
    EVENT,
    Gamepad,
    HeldKeys,
    PadState,
    TeleopStation,
    joint_readout,
    keys_of,
    readout,
    typed_keys,
)

WAFFLE = load_robot("turtlebot3_waffle")  # 0.26 m/s, 1.82 rad/s
ALPHA = load_robot("alpha")  # 0.2 m/s sideways


def test_keys_and_arrows_are_found_among_other_escape_sequences() -> None:
    assert keys_of("wW\x1b[A\x1bOD +\x1b[1;5C\x1b[15~\x03") == [
        "w", "w", "up", "left", " ", "+", "right", "\x03",
    ]  # fmt: skip
    assert keys_of("\x1b\x1b[") == ["["]


def test_a_press_lasts_400_ms_and_a_repeat_150() -> None:
    keys = HeldKeys()
    assert keys.press("w", 10.0)
    assert keys.velocity(WAFFLE, 10.39) == Velocity(linear_x=0.065)
    assert keys.velocity(WAFFLE, 10.40) == ZERO
    keys.press("w", 20.0)
    keys.press("w", 20.3)
    assert keys.velocity(WAFFLE, 20.44) == Velocity(linear_x=0.065)
    assert keys.velocity(WAFFLE, 20.46) == ZERO


def test_several_keys_add_up_and_opposite_ones_cancel() -> None:
    keys = HeldKeys()
    keys.press("up", 0.0)
    keys.press("a", 0.0)
    assert keys.velocity(WAFFLE, 0.1) == Velocity(linear_x=0.065, angular_z=0.455)
    keys.press("s", 0.0)
    assert keys.velocity(WAFFLE, 0.1) == Velocity(angular_z=0.455)
    keys.release_all()
    assert keys.velocity(WAFFLE, 0.1) == ZERO


def test_the_operator_chooses_a_speed_within_the_limits_of_the_body() -> None:
    keys = HeldKeys()
    assert not keys.press("z", 0.0)
    for _ in range(9):
        keys.press("+", 0.0)
    keys.press("q", 0.0)
    keys.press("s", 0.0)
    assert keys.velocity(ALPHA, 0.1) == Velocity(linear_x=-0.5, linear_y=0.2)
    for _ in range(9):
        keys.press("-", 0.0)
    assert keys.share == 0.25


def test_a_released_key_counts_from_its_next_press_and_not_from_a_repeat() -> None:
    keys = HeldKeys()
    keys.press("w", 0.0)
    keys.release_all()
    keys.press("w", 0.3)
    keys.press("w", 0.4)
    assert keys.velocity(WAFFLE, 0.4) == ZERO
    keys.press("w", 1.0)
    assert keys.velocity(WAFFLE, 1.0) == Velocity(linear_x=0.065)


def event(value: int, kind: int, number: int) -> bytes:
    return struct.pack("<IhBB", 0, value, kind, number)


def test_a_gamepad_moves_nothing_unless_a_dead_man_button_is_held() -> None:
    pad = PadState()
    pad.feed(event(-32767, 2, 1) + event(-32767, 2, 3))
    assert pad.velocity(WAFFLE, 1.0) == ZERO
    pad.feed(event(1, 1, 5))
    assert pad.velocity(WAFFLE, 0.5) == Velocity(linear_x=0.13, angular_z=0.91)
    pad.feed(event(0, 1, 5))
    assert pad.velocity(WAFFLE, 0.5) == ZERO


def test_events_may_arrive_in_pieces_and_a_stick_near_its_centre_is_released() -> None:
    pad = PadState()
    data = event(1, 1, 4) + event(-3200, 2, 1) + event(-16384, 2, 3)
    for at in range(0, len(data), 3):
        pad.feed(data[at : at + 3])
    assert pad.velocity(WAFFLE, 1.0) == Velocity(angular_z=pytest.approx(0.91, abs=0.001))


def test_a_stop_button_counts_when_pressed_and_not_when_held_at_the_start() -> None:
    pad = PadState()
    assert not pad.feed(event(1, 1 | 0x80, 1))
    assert not pad.feed(event(0, 1, 1))
    assert pad.feed(event(1, 1, 1))


def test_a_released_gamepad_moves_nothing_until_a_dead_man_button_is_pressed_again() -> None:
    pad = PadState()
    pad.feed(event(1, 1, 4) + event(-32767, 2, 1))
    pad.feed(event(1, 1 | 0x80, 4))  # sent again, after events were lost
    assert pad.velocity(WAFFLE, 1.0) == Velocity(linear_x=0.26)
    pad.release_all()
    pad.feed(event(1, 1 | 0x80, 4) + event(-32000, 2, 1))
    assert pad.velocity(WAFFLE, 1.0) == ZERO
    pad.feed(event(0, 1, 4) + event(1, 1, 4) + event(-32767, 2, 1))
    assert pad.velocity(WAFFLE, 1.0) == Velocity(linear_x=0.26)


def test_a_dead_man_button_that_is_held_when_the_station_starts_moves_nothing() -> None:
    pad = PadState()
    pad.feed(event(1, 1 | 0x80, 4) + event(-32767, 2 | 0x80, 1))
    assert pad.velocity(WAFFLE, 1.0) == ZERO


async def test_a_gamepad_that_is_unplugged_holds_no_button(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "js0")
    pad = Gamepad(tmp_path)
    with (tmp_path / "js0").open("wb", buffering=0) as kernel:
        kernel.write(event(1, 1, 4) + event(-32767, 2, 1) + event(1, 1, 1))
        await pad.stop.wait()
        assert pad.pad
        assert pad.pad.velocity(WAFFLE, 1.0) == Velocity(linear_x=0.26)
    await until(lambda: pad.pad is None)
    pad.close()
    assert Gamepad(tmp_path / "nowhere").pad is None


def test_the_display_names_commander_causes_and_remedies() -> None:
    gate = GateStatus(mode="latched", causes=(estop("ann"),), commander="")
    state = example(RobotState)
    state = type(state)(robot_type="mock", pose=state.pose, velocity=state.velocity, gate=gate)
    assert readout(state, Velocity(linear_x=0.1), 0.25) == [
        "mock: latched, commander none",
        "speed +0.20 m/s -0.50 rad/s, wanted +0.10 +0.00 (25% of its limits)",
        "  e-stop pressed by ann: find out why it was pressed",
    ]


class FakeRobot:
    """A robot whose gate is enabled for the brain. The station takes it over."""

    def __init__(self, on_hand_back: Callable[[], None] = lambda: None) -> None:
        self.state: RobotState | None = None
        self.steered: list[Velocity] = []
        self.enabled = self.pressed = 0
        self._on_hand_back = on_hand_back

    async def read_body(self) -> object:
        return WAFFLE

    async def read_state(self) -> RobotState:
        if self.enabled:
            self._on_hand_back()
        return replace(example(RobotState), gate=GateStatus(mode="enabled", commander=BRAIN))

    def steer(self, wanted: Velocity) -> None:
        self.steered.append(wanted)

    async def estop(self, reason: str) -> GateReply:
        self.pressed += 1
        return example(GateReply)

    async def enable(self, source: str, *, take: bool) -> object:
        self.enabled += source == BRAIN
        return replace(example(GateReply), text="open")


async def cancelled_while_driving(robot: FakeRobot, folder: Path) -> None:
    station = TeleopStation(cast(Robot, robot), Gamepad(folder))
    driving = asyncio.create_task(station.drive(take=True))
    await until(lambda: len(robot.steered) > 1)
    driving.cancel()  # as a signal does
    with pytest.raises(asyncio.CancelledError):
        await driving


async def test_a_station_that_a_signal_ends_stops_the_body_and_hands_it_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = FakeRobot()
    await cancelled_while_driving(robot, tmp_path)
    assert robot.steered[-1] == ZERO
    assert robot.enabled == 2  # at the station's start, and for the brain at its end


@pytest.mark.parametrize("stopped_by", ["this station", "another station"])
async def test_a_gamepad_held_through_an_estop_must_be_pressed_again(
    tmp_path: Path, stopped_by: str
) -> None:
    os.mkfifo(tmp_path / "js0")
    robot, pad = FakeRobot(), Gamepad(tmp_path)
    latched = replace(example(RobotState), gate=GateStatus(mode="latched"))
    with terminal() as screen, (tmp_path / "js0").open("wb", buffering=0) as kernel:
        driving = asyncio.create_task(TeleopStation(cast(Robot, robot), pad).drive(take=True))
        kernel.write(event(1, 1, 4) + event(-32767, 2, 1))
        await until(lambda: robot.steered and robot.steered[-1] != ZERO)
        if stopped_by == "this station":
            os.write(screen, b" ")
            await until(lambda: robot.pressed)
        else:
            robot.state = latched
            await asyncio.sleep(0.2)  # for several updates
            robot.state = None
        robot.steered.clear()
        await until(lambda: len(robot.steered) > 3)
        assert set(robot.steered) == {ZERO}
        kernel.write(event(0, 1, 4) + event(1, 1, 4))
        await until(lambda: robot.steered[-1] != ZERO)
        driving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await driving
    pad.close()


@contextlib.contextmanager
def terminal() -> Iterator[int]:
    """A terminal as standard input and output; yields its other end."""
    screen, tty = pty.openpty()
    with (
        open(tty) as typed,
        open(tty, "w", closefd=False) as shown,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("TERM", "xterm")
        patch.setattr("rich._console", None)  # it would keep its former output
        patch.setattr("sys.stdin", typed)
        patch.setattr("sys.stdout", shown)
        yield screen
    os.close(screen)


@pytest.mark.parametrize("halt", ["Ctrl-S", "Scroll Lock"])
async def test_the_space_bar_stops_while_the_terminal_accepts_no_output(
    tmp_path: Path, halt: str
) -> None:
    robot, resumed = FakeRobot(), threading.Event()
    station = TeleopStation(cast(Robot, robot), Gamepad(tmp_path))
    with terminal() as screen:
        driving = asyncio.create_task(station.drive(take=True))
        await until(lambda: len(robot.steered) > 1)

        def resume() -> None:
            resumed.set()
            termios.tcflow(sys.stdin, termios.TCOON)
            os.write(screen, b"\x11")

        watchdog = threading.Timer(5.0, resume)
        watchdog.start()
        if halt == "Ctrl-S":
            os.write(screen, b"\x13")
        else:
            termios.tcflow(sys.stdin, termios.TCOOFF)
        await asyncio.sleep(0.2)  # for several updates
        os.write(screen, b" ")
        await until(lambda: robot.pressed)
        if halt == "Scroll Lock":
            termios.tcflow(sys.stdin, termios.TCOON)
        driving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await driving
        watchdog.cancel()
    assert not resumed.is_set()


async def test_an_arrow_key_may_arrive_byte_by_byte() -> None:
    found: list[str] = []
    with terminal() as screen, typed_keys(lambda typed: found.extend(keys_of(typed))):
        for byte in b"\x1b[A\x1bw\x1b[1;5D ":
            os.write(screen, bytes((byte,)))
            await asyncio.sleep(0.01)  # until it is read
        await until(lambda: " " in found)
    assert found == ["up", "w", "left", " "]


async def test_a_station_that_cannot_return_the_body_reports_it_and_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def lost() -> None:
        raise BodyLost("robot/state has stopped")

    await cancelled_while_driving(FakeRobot(lost), tmp_path)
    assert "cannot return the body" in capsys.readouterr().err


ARM = replace(
    WAFFLE.description(),
    arm=Arm(home=(0.0, 0.0, 0.0)),
    joints=tuple(
        JointDescription(name=name, lower=-1.0, upper=1.0, max_speed=2.0)
        for name in ("pan", "lift", "gripper")
    ),
)


def test_a_held_key_moves_the_chosen_joint_and_no_other() -> None:
    keys = HeldKeys()
    assert keys.speeds(ARM, 0.0) == {"pan": 0.0}
    assert keys.press("k", 0.0)
    assert keys.speeds(ARM, 0.1) == {"pan": 0.5}
    assert keys.speeds(ARM, 0.5) == {"pan": 0.0}
    assert keys.press("2", 1.0)
    keys.press("j", 1.0)
    assert keys.speeds(ARM, 1.1) == {"lift": -0.5}
    assert keys.velocity(ARM, 1.1) == ZERO
    keys.press("9", 1.2)
    assert keys.speeds(ARM, 1.2) == {}


def test_the_right_shoulder_button_moves_joints_and_the_left_one_the_base() -> None:
    pad = PadState()
    pad.feed(EVENT.pack(0, -32767, 0x02, 1))
    assert pad.speeds(ARM, 0.5) == {}
    pad.feed(EVENT.pack(0, 1, 0x01, 5))
    assert pad.speeds(ARM, 0.5) == {"pan": 0.0, "lift": 1.0, "gripper": 0.0}
    assert pad.velocity(ARM, 0.5) == ZERO
    pad.feed(EVENT.pack(0, 0, 0x01, 5))
    pad.feed(EVENT.pack(0, 1, 0x01, 4))
    assert pad.speeds(ARM, 0.5) == {}
    assert pad.velocity(ARM, 0.5).linear_x == pytest.approx(0.13)


def test_joints_are_shown_in_degrees_with_a_mark_at_the_chosen_one() -> None:
    state = replace(
        example(RobotState),
        joints=(Joint(name="pan", position=0.5), Joint(name="lift", position=-1)),
    )
    assert joint_readout(state, ARM, 1) == ["1 pan +29° · >2 lift -57°"]
    assert joint_readout(state, WAFFLE, 0) == []
