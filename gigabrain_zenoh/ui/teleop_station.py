"""Drives a robot from a terminal, by keys and a gamepad, and shows its state.

The gamepad is read by the kernel's joystick interface: Documentation/input/joydev/joystick-api.rst.
"""

import asyncio
import contextlib
import math
import os
import re
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from rich.live import Live
from rich.text import Text

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription, JointDescription, RobotState
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.host.posix import termios
from gigabrain_zenoh.host.terminal import Display

PERIOD_S = 0.05
KEYS_HELP = (
    "WASD or arrows drive · Q E sideways · + - speed · SPACE e-stop · R release · G go · X quit"
)
JOINT_KEYS_HELP = "1 2 3 … choose a joint · J K move it"
PAD_HELP = "gamepad: hold a shoulder button to drive, B stops"

# A terminal repeats a held key first after 0.25 to 0.6 s, then every 30 to 50 ms.
FIRST_PRESS_S = 0.4  # a key counts as held for so long after its first press
REPEATED_PRESS_S = 0.15  # the same for a repetition; the robot brakes so long after the release
SPEED_SHARES = (0.25, 0.5, 0.75, 1.0)  # speed steps, as fractions of the body's limits

Axes = tuple[int, int, int]  # ahead, left, counter-clockwise: -1, 0 or 1
MOVES: Final[dict[str, Axes]] = {
    "w": (1, 0, 0), "up": (1, 0, 0),
    "s": (-1, 0, 0), "down": (-1, 0, 0),
    "a": (0, 0, 1), "left": (0, 0, 1),
    "d": (0, 0, -1), "right": (0, 0, -1),
    "q": (0, 1, 0), "e": (0, -1, 0),
}  # fmt: skip
JOG_KEYS: Final[dict[str, int]] = {"j": -1, "k": 1}  # direction of the chosen joint
ARROW_KEYS = {"A": "up", "B": "down", "C": "right", "D": "left"}
INCOMPLETE_SEQUENCE = re.compile(r"\x1b(?:[\[O][\d;]*)?\Z")  # at the end of the input
KEY_PATTERN = re.compile(r"\x1b[\[O](?:\d+(?:;\d+)*)?([A-Za-z~])|(.)", re.DOTALL)

EVENT = struct.Struct("<IhBB")  # milliseconds, value, type, number
BUTTON, AXIS, INITIAL = 0x01, 0x02, 0x80  # bits of an event's type; INITIAL: state when opened
DEAD_MAN_BUTTONS = (4, 5)  # the shoulder buttons: nothing moves unless one of them is held
ARM_BUTTON = 5  # of a body with joints, the right one moves these, the left one the base
JOINT_AXES = (0, 1, 3, 4, 6, 7)  # one for each joint: left stick, right stick, cross
STOP_BUTTON = 1  # the button at the right (B, circle)
AHEAD_AXIS, TURN_AXIS, SIDEWAYS_AXIS = 1, 3, 0  # left stick up and down, right stick, left stick
AXIS_RANGE = 32767.0
DEAD_ZONE = 0.1  # share of a stick's range in which it counts as released


def keys_of(typed: str) -> list[str]:
    """Return the keys in a terminal's input; arrows by name, other escape sequences are dropped."""
    found = []
    for sequence, plain in KEY_PATTERN.findall(typed):
        name = ARROW_KEYS.get(sequence, "") if sequence else plain.lower()
        if name and name != "\x1b":
            found.append(name)
    return found


class HeldKeys:
    """Keys that count as held, and the speed that the operator has chosen."""

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}
        self._released: set[str] = set()  # keys to ignore until their next press; no repetition
        self._share_index = 0
        self.joint = 0  # index of the chosen joint

    @property
    def share(self) -> float:
        """Return the chosen fraction of the body's limits."""
        return SPEED_SHARES[self._share_index]

    def press(self, key: str, now_s: float) -> bool:
        """Process a key press; return whether the key is used for driving."""
        if key in ("+", "-"):
            step = 1 if key == "+" else -1
            self._share_index = max(0, min(len(SPEED_SHARES) - 1, self._share_index + step))
        elif key.isdecimal() and key != "0":
            self.joint = int(key) - 1
        elif key in MOVES or key in JOG_KEYS:
            repeated = now_s < self._until_s.get(key, now_s)
            if not repeated:
                self._released.discard(key)
            self._until_s[key] = now_s + (REPEATED_PRESS_S if repeated else FIRST_PRESS_S)
        else:
            return False
        return True

    def release_all(self) -> None:
        """Count all keys as released, until they are pressed again."""
        self._released = set(self._until_s)

    def velocity(self, body: BodyDescription, now_s: float) -> Velocity:
        """Return the velocity for the keys that are held now."""
        held = [MOVES[key] for key in self._held(now_s) if key in MOVES]
        if not held:
            return ZERO
        x, y, z = (max(-1, min(1, sum(axis))) for axis in zip(*held, strict=True))
        return Velocity(
            linear_x=x * self.share * body.max_linear_speed,
            linear_y=y * self.share * body.max_lateral_speed,
            angular_z=z * self.share * body.max_angular_speed,
        )

    def speeds(self, body: BodyDescription, now_s: float) -> dict[str, float]:
        """Return the speed of the chosen joint [rad/s or m/s]; empty if there is none."""
        direction = sum(JOG_KEYS.get(key, 0) for key in self._held(now_s))
        chosen = body.joints[self.joint : self.joint + 1]
        return {joint.name: direction * self.share * joint.max_speed for joint in chosen}

    def _held(self, now_s: float) -> list[str]:
        held = (key for key, until_s in self._until_s.items() if now_s < until_s)
        return [key for key in held if key not in self._released]


class PadState:
    """State of buttons and sticks after the events received. Pure."""

    def __init__(self) -> None:
        self._buttons: dict[int, bool] = {}
        self._axes: dict[int, float] = {}
        self._incomplete = b""  # first bytes of an event

    def feed(self, data: bytes) -> bool:
        """Process events; return whether one of them is a press of the stop button."""
        data = self._incomplete + data
        end = len(data) - len(data) % EVENT.size
        self._incomplete, stop = data[end:], False
        for _, value, kind, number in EVENT.iter_unpack(data[:end]):
            if kind & BUTTON:
                pressed = bool(value and not kind & INITIAL)
                self._buttons[number] = pressed or bool(value and self._buttons.get(number))
                stop = stop or (number == STOP_BUTTON and pressed)
            elif kind & AXIS:
                self._axes[number] = value / AXIS_RANGE
        return stop

    def release_all(self) -> None:
        """Count all buttons as released, until they are pressed again."""
        self._buttons.clear()

    def velocity(self, body: BodyDescription, share: float) -> Velocity:
        """Return the velocity that the sticks command, at most `share` of the body's limits."""
        held = any(self._buttons.get(button) for button in DEAD_MAN_BUTTONS)
        if not held or (body.joints and self._buttons.get(ARM_BUTTON)):
            return ZERO
        ahead, turn, left = (
            -self._deflection(axis) * share for axis in (AHEAD_AXIS, TURN_AXIS, SIDEWAYS_AXIS)
        )
        return Velocity(
            linear_x=ahead * body.max_linear_speed,
            linear_y=left * body.max_lateral_speed,
            angular_z=turn * body.max_angular_speed,
        )

    def speeds(self, body: BodyDescription, share: float) -> dict[str, float]:
        """Return the joint speeds [rad/s or m/s] of the sticks, at most `share` of the limits."""
        if not self._buttons.get(ARM_BUTTON):
            return {}
        pairs = zip(body.joints, JOINT_AXES, strict=False)
        return {
            joint.name: -self._deflection(axis) * share * joint.max_speed for joint, axis in pairs
        }

    def _deflection(self, axis: int) -> float:
        value = max(-1.0, min(1.0, self._axes.get(axis, 0.0)))
        return value if abs(value) > DEAD_ZONE else 0.0


class Gamepad:
    """First gamepad of this machine, while it is plugged in."""

    def __init__(self, folder: Path = Path("/dev/input")) -> None:
        self.pad: PadState | None = None
        self.stop = asyncio.Event()  # set by the stop button
        self._fd: int | None = None
        for path in sorted(folder.glob("js*")):
            with contextlib.suppress(OSError):
                self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
                self.pad = PadState()
                asyncio.get_running_loop().add_reader(self._fd, self._read)
                return

    def close(self) -> None:
        """Close the device."""
        fd, self._fd, self.pad = self._fd, None, None
        if fd is not None:
            asyncio.get_running_loop().remove_reader(fd)
            os.close(fd)

    def _read(self) -> None:
        if self._fd is None or self.pad is None:
            return
        try:
            data = os.read(self._fd, 64 * EVENT.size)
        except BlockingIOError:
            return
        except OSError:  # unplugged: no dead-man button is held
            data = b""
        if not data:
            self.close()
        elif self.pad.feed(data):
            self.stop.set()


class TeleopStation:
    """Publishes the operator's velocity 20 times a second, zero included."""

    def __init__(self, robot: Robot, pad: Gamepad) -> None:
        self._robot, self._pad = robot, pad
        self._keys, self._reply = HeldKeys(), ""
        self._quit = False
        self._body: BodyDescription | None = None
        self._requests: set[asyncio.Task[None]] = set()  # under way

    async def drive(self, take: bool) -> None:
        """Drive until the operator quits; then stop the body and hand it back to the brain.

        It also hands the body back when it is cancelled. Raises Refused when another operator
        or the brain drives and `take` is not set.
        """
        body = self._body = await self._robot.read_body()
        state = await self._robot.read_state()
        if state.gate.mode == "enabled" and not take:
            raise Refused(f"{state.gate.commander} drives; take it over with --take")
        if state.gate.mode != "latched":
            await self._enable(take)
        try:
            await self._until_quit(body)
        finally:  # also after a signal, or if the terminal is closed
            await self._hand_back()

    async def _until_quit(self, body: BodyDescription) -> None:
        loop = asyncio.get_running_loop()
        with (
            typed_keys(self._on_typed),
            Live(auto_refresh=False, screen=False) as live,
            Display[Text](lambda text: live.update(text, refresh=True), room=1) as display,
        ):
            while not self._quit:
                if self._robot.state and self._robot.state.gate.mode == "latched":
                    self._release_all()  # held keys must not move the robot after the release
                wanted = self._keys.velocity(body, loop.time())
                if wanted == ZERO and self._pad.pad:
                    wanted = self._pad.pad.velocity(body, self._keys.share)
                if self._pad.stop.is_set():
                    self._pad.stop.clear()
                    self._request("stop")
                if body.has_base:
                    self._robot.steer(wanted)
                if body.joints:
                    self._jog(body, loop.time())
                display.put(Text("\n".join(map(printable, self._lines(wanted)))))
                await asyncio.sleep(PERIOD_S)

    def _jog(self, body: BodyDescription, now_s: float) -> None:
        speeds = self._keys.speeds(body, now_s)
        if not any(speeds.values()) and self._pad.pad:
            speeds = self._pad.pad.speeds(body, self._keys.share) or speeds
        if speeds:
            self._robot.jog(speeds)

    def _on_typed(self, typed: str) -> None:
        for key in keys_of(typed):
            if key in ("x", "\x03", "\x04"):
                self._quit = True
            elif key in (" ", "r", "g"):
                self._request({" ": "stop", "r": "release", "g": "go"}[key])
            else:
                self._keys.press(key, asyncio.get_running_loop().time())

    def _release_all(self) -> None:
        self._keys.release_all()
        if self._pad.pad:
            self._pad.pad.release_all()

    def _request(self, what: str) -> None:
        """Count keys and gamepad as released, then send a request to the gate."""
        self._release_all()
        self._robot.steer(ZERO)
        task = asyncio.create_task(self._carry_out(what))
        self._requests.add(task)
        task.add_done_callback(self._requests.discard)

    async def _carry_out(self, what: str) -> None:
        try:
            if what == "stop":
                reply = await self._robot.estop("teleop")
                self._reply = f"CONFIRMED by {reply.robot_type}: {reply.text}"
            elif what == "release":
                self._reply = (await self._robot.release()).text
            else:
                await self._enable(take=True)
        except GigabrainError as error:
            self._reply = str(error)

    async def _enable(self, take: bool) -> None:
        self._reply = (await self._robot.enable(BRAIN, take=take)).text

    async def _hand_back(self) -> None:
        """Stop the body; enable the brain again only if this station still had the body."""
        self._robot.steer(ZERO)
        try:
            for task in tuple(self._requests):
                await task
            state = await self._robot.read_state()
            if state.gate.mode == "enabled" and state.gate.commander == BRAIN:
                with contextlib.suppress(Refused):
                    await self._enable(take=False)
        except GigabrainError as error:
            print(f"cannot return the body to the brain: {error}", file=sys.stderr)

    def _lines(self, wanted: Velocity) -> list[str]:
        state = self._robot.state
        if state is None:
            return ["no messages from the robot; is its driver running?", self._reply, KEYS_HELP]
        return [
            *readout(state, wanted, self._keys.share),
            *joint_readout(state, self._body, self._keys.joint),
            self._reply,
            KEYS_HELP,
            *([JOINT_KEYS_HELP] if self._body and self._body.joints else []),
            *([PAD_HELP] if self._pad.pad else []),
        ]


def readout(state: RobotState, wanted: Velocity, share: float) -> list[str]:
    """Return lines with the gate, its commander, the speed, and causes with their remedies."""
    now, gate = state.velocity, state.gate
    lines = [
        f"{state.robot_type}: {gate.mode}, commander {gate.commander or 'none'}",
        f"speed {now.linear_x:+.2f} m/s {now.angular_z:+.2f} rad/s, "
        f"wanted {wanted.linear_x:+.2f} {wanted.angular_z:+.2f} ({share:.0%} of its limits)",
    ]
    for cause in gate.causes:
        lines.append(f"  {cause.text}" + (f": {cause.remedy}" if cause.remedy else ""))
    return lines


def joint_readout(state: RobotState, body: BodyDescription | None, chosen: int) -> list[str]:
    """Return a line with the joints, in degrees or millimetres, and the chosen one marked."""
    measured = {joint.name: joint.position for joint in state.joints}
    shown = [
        f"{'>' if number == chosen else ''}{number + 1} {joint.name} "
        + _position_text(joint, measured[joint.name])
        for number, joint in enumerate(body.joints if body else ())
        if joint.name in measured
    ]
    return [" · ".join(shown)] if shown else []


def _position_text(joint: JointDescription, position: float) -> str:
    sliding = joint.unit == "m"
    return f"{1e3 * position:+.0f} mm" if sliding else f"{math.degrees(position):+.0f}°"


@contextmanager
def typed_keys(on_typed: Callable[[str], None]) -> Iterator[None]:
    """Pass typed text to `on_typed` without waiting for Enter; restore the terminal afterwards."""
    if not sys.stdin.isatty():
        yield
        return
    fd, loop = sys.stdin.fileno(), asyncio.get_running_loop()
    before, incomplete = termios.tcgetattr(fd), ""

    def read() -> None:
        nonlocal incomplete
        typed = incomplete + os.read(fd, 1024).decode(errors="replace")
        found = INCOMPLETE_SEQUENCE.search(typed)
        incomplete = found.group() if found else ""
        on_typed(typed.removesuffix(incomplete))

    settings = termios.tcgetattr(fd)
    settings[0] &= ~termios.IXON  # Ctrl-S does not stop the display
    # Ctrl-C is an ordinary key, so that the body is stopped before the program ends
    settings[3] &= ~(termios.ICANON | termios.ECHO | termios.ISIG)
    termios.tcsetattr(fd, termios.TCSADRAIN, settings)
    loop.add_reader(fd, read)
    try:
        yield
    finally:
        loop.remove_reader(fd)
        termios.tcsetattr(fd, termios.TCSADRAIN, before)
