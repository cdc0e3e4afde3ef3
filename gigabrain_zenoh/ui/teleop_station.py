"""Operator's station in a terminal: keys and a gamepad publish `robot/teleop`.

It also displays the robot's state.
"""

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.live import Live
from rich.text import Text

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.host.posix import termios
from gigabrain_zenoh.ui.gamepad import Gamepad
from gigabrain_zenoh.ui.teleop_keys import HeldKeys, keys_of

PERIOD_S = 0.05
KEYS = "WASD or arrows drive · Q E sideways · + - speed · SPACE e-stop · R release · G go · X quit"
PAD = "gamepad: hold a shoulder button to drive, B stops"


class Station:
    """Publishes the operator's velocity 20 times a second, zero included."""

    def __init__(self, robot: Robot, pad: Gamepad) -> None:
        self._robot, self._pad = robot, pad
        self._keys, self._said = HeldKeys(), ""
        self._quit = False
        self._asking: set[asyncio.Task[None]] = set()

    async def drive(self, take: bool) -> None:
        """Drive until the operator quits; then stop the body and hand it back to the brain.

        It also hands back when it is cancelled. Raises Refused when another operator or the brain
        drives and `take` is not set.
        """
        body = await self._robot.read_body()
        state = await self._robot.read_state()
        if state.gate.mode == "enabled" and not take:
            raise Refused(f"{state.gate.commander} drives; take it over with --take")
        if state.gate.mode != "latched":
            await self._enable(take)
        try:
            await self._until_quit(body)
        finally:  # a signal, and a terminal that was closed, hand back as well
            await self._hand_back()

    async def _until_quit(self, body: BodyDescription) -> None:
        loop = asyncio.get_running_loop()
        with _typed(self._type), Live(auto_refresh=False, screen=False) as live:
            while not self._quit:
                wanted = self._keys.velocity(body, loop.time())
                if wanted == ZERO and self._pad.pad:
                    wanted = self._pad.pad.velocity(body, self._keys.share)
                if self._pad.stop.is_set():
                    self._pad.stop.clear()
                    self._ask("stop")
                self._robot.steer(wanted)
                live.update(Text("\n".join(self._lines(wanted))), refresh=True)
                await asyncio.sleep(PERIOD_S)

    def _type(self, typed: str) -> None:
        for key in keys_of(typed):
            if key in ("x", "\x03", "\x04"):
                self._quit = True
            elif key in (" ", "r", "g"):
                self._ask({" ": "stop", "r": "release", "g": "go"}[key])
            else:
                self._keys.press(key, asyncio.get_running_loop().time())

    def _ask(self, what: str) -> None:
        """Release all keys, then send a request to the gate."""
        self._keys.let_go()
        self._robot.steer(ZERO)
        task = asyncio.create_task(self._answer(what))
        self._asking.add(task)
        task.add_done_callback(self._asking.discard)

    async def _answer(self, what: str) -> None:
        try:
            if what == "stop":
                reply = await self._robot.estop("teleop")
                self._said = f"CONFIRMED by {reply.robot_type}: {reply.text}"
            elif what == "release":
                self._said = (await self._robot.release()).text
            else:
                await self._enable(take=True)
        except GigabrainError as error:
            self._said = str(error)

    async def _enable(self, take: bool) -> None:
        self._said = (await self._robot.enable(BRAIN, take=take)).text

    async def _hand_back(self) -> None:
        """Stop the body; enable the brain again only if this station still had the body."""
        self._robot.steer(ZERO)
        try:
            for task in tuple(self._asking):
                await task
            state = await self._robot.read_state()
            if state.gate.mode == "enabled" and state.gate.commander == BRAIN:
                with contextlib.suppress(Refused):
                    await self._enable(take=False)
        except GigabrainError as error:
            print(f"the body was not handed back: {error}", file=sys.stderr)

    def _lines(self, wanted: Velocity) -> list[str]:
        state = self._robot.state
        if state is None:
            return ["the robot is silent; is the driver running?", self._said, KEYS]
        return [*readout(state, wanted, self._keys.share), self._said, KEYS, *self._pad_line()]

    def _pad_line(self) -> list[str]:
        return [PAD] if self._pad.pad else []


def readout(state: RobotState, wanted: Velocity, share: float) -> list[str]:
    """Return lines with the gate, its commander, the speed, and causes with their remedies."""
    now, gate = state.velocity, state.gate
    lines = [
        f"{state.robot_type}: {gate.mode}, driven by {gate.commander or 'nobody'}",
        f"speed {now.linear_x:+.2f} m/s {now.angular_z:+.2f} rad/s, "
        f"wanted {wanted.linear_x:+.2f} {wanted.angular_z:+.2f} ({share:.0%} of its limits)",
    ]
    for cause in gate.causes:
        lines.append(f"  {cause.text}" + (f": {cause.remedy}" if cause.remedy else ""))
    return lines


@contextmanager
def _typed(take: Callable[[str], None]) -> Iterator[None]:
    """Pass keys to `take` as they are pressed, without Enter; restore the terminal afterwards."""
    if not sys.stdin.isatty():
        yield
        return
    fd, loop = sys.stdin.fileno(), asyncio.get_running_loop()
    before = termios.tcgetattr(fd)

    def read() -> None:
        take(os.read(fd, 1024).decode(errors="replace"))

    keys = termios.tcgetattr(fd)
    keys[3] &= ~(termios.ICANON | termios.ECHO | termios.ISIG)  # Ctrl-C is a key here, so that the
    termios.tcsetattr(fd, termios.TCSADRAIN, keys)  # body is stopped before the program ends
    loop.add_reader(fd, read)
    try:
        yield
    finally:
        loop.remove_reader(fd)
        termios.tcsetattr(fd, termios.TCSADRAIN, before)
