"""A gamepad by the kernel's joystick interface: Documentation/input/joydev/joystick-api.rst."""

import asyncio
import contextlib
import os
import struct
from pathlib import Path

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.geometry.limits import ZERO

EVENT = struct.Struct("<IhBB")  # milliseconds, value, type, number
BUTTON, AXIS, INITIAL = 0x01, 0x02, 0x80
DEAD_MAN = (4, 5)  # the shoulder buttons: nothing moves unless one of them is held
STOP = 1  # the button at the right (B, circle)
AHEAD, TURN, SIDEWAYS = 1, 3, 0  # axes: left stick up and down, right stick, left stick
FULL = 32767.0
DEAD_ZONE = 0.1  # of a stick's way, in which it counts as let go


class Pad:
    """What is held and pushed, by the events that came. Pure."""

    def __init__(self) -> None:
        self._buttons: dict[int, bool] = {}
        self._axes: dict[int, float] = {}
        self._rest = b""

    def feed(self, data: bytes) -> bool:
        """Take events; whether the stop button was pressed among them."""
        data = self._rest + data
        whole = len(data) - len(data) % EVENT.size
        self._rest, stop = data[whole:], False
        for _, value, kind, number in EVENT.iter_unpack(data[:whole]):
            if kind & BUTTON:
                self._buttons[number] = bool(value)
                stop = stop or (number == STOP and bool(value) and not kind & INITIAL)
            elif kind & AXIS:
                self._axes[number] = value / FULL
        return stop

    @property
    def held(self) -> bool:
        """Whether somebody holds a dead-man button."""
        return any(self._buttons.get(button) for button in DEAD_MAN)

    def velocity(self, body: BodyDescription, share: float) -> Velocity:
        """What the sticks ask for, at most `share` of the body's limits."""
        if not self.held:
            return ZERO
        ahead, turn, left = (-self._pushed(axis) * share for axis in (AHEAD, TURN, SIDEWAYS))
        return Velocity(
            linear_x=ahead * body.max_linear_speed,
            linear_y=left * body.max_lateral_speed,
            angular_z=turn * body.max_angular_speed,
        )

    def _pushed(self, axis: int) -> float:
        value = max(-1.0, min(1.0, self._axes.get(axis, 0.0)))
        return value if abs(value) > DEAD_ZONE else 0.0


class Gamepad:
    """The first gamepad of this machine, for as long as it is plugged in."""

    def __init__(self, folder: Path = Path("/dev/input")) -> None:
        self.pad: Pad | None = None
        self.stop = asyncio.Event()  # the stop button was pressed
        self._fd: int | None = None
        for path in sorted(folder.glob("js*")):
            with contextlib.suppress(OSError):
                self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
                self.pad = Pad()
                asyncio.get_running_loop().add_reader(self._fd, self._read)
                return

    def close(self) -> None:
        """Let go of it."""
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
        except OSError:  # unplugged: nobody holds the dead-man button any more
            data = b""
        if not data:
            self.close()
        elif self.pad.feed(data):
            self.stop.set()
