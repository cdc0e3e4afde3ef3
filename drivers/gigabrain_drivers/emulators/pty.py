"""A serial port that is not there: a pty behind a symlink, which can be unplugged."""

import asyncio
import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path

from gigabrain_zenoh.host.posix import tty

READ_BYTES = 4096
BITS_PER_BYTE = 10  # 8N1: start, eight, stop


class Pty:
    """The device's end. Both ways take the time that a wire of `baud` takes, or none without."""

    def __init__(self, path: Path, baud: int | None = None) -> None:
        self.path = path  # what the host opens
        self.on_bytes: Callable[[bytes], None] = lambda data: None
        self.lost_bytes = 0  # that the host did not read in time; a UART loses them as well
        self._byte_s = BITS_PER_BYTE / baud if baud else 0.0
        self._out_free = self._in_free = 0.0  # when the wire will be free again [loop time]
        self._plugged = 0  # how often: what was on the wire before it was unplugged is gone
        self._master: int | None = None
        self._slave: int | None = None

    @property
    def plugged(self) -> bool:
        """Whether the port exists."""
        return self._master is not None

    def plug(self) -> None:
        """Make the port appear, with nothing old in it. Nothing if it is there."""
        if self._master is not None:
            return
        self._plugged += 1
        self._master, self._slave = os.openpty()  # the slave stays open: no EIO between clients
        for end in (self._master, self._slave):
            tty.setraw(end)
        os.set_blocking(self._master, False)
        asyncio.get_running_loop().add_reader(self._master, self._readable)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists() and not self.path.is_symlink():
            raise OSError(errno.EEXIST, f"{self.path.name} is there and is no emulator's")
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(_lasting(self._slave))
        os.replace(fresh, self.path)

    def unplug(self) -> None:
        """Make the port disappear under whoever has it open. Nothing if it is gone."""
        if self._master is None or self._slave is None:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        if self.path.is_symlink() and os.readlink(self.path) == _lasting(self._slave):
            self.path.unlink(missing_ok=True)  # another's, by now, is left
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = None
        self._out_free = self._in_free = 0.0

    def write(self, data: bytes) -> bool:
        """To the host; False when the port is unplugged."""
        if self._master is None:
            return False
        self._out_free = self._after(self._out_free, self._send, data)
        return True

    def _after(self, free: float, act: Callable[[int, bytes], None], data: bytes) -> float:
        """Act once the bytes have been on the wire; returns when it is free again."""
        if not self._byte_s:
            act(self._plugged, data)
            return free
        loop = asyncio.get_running_loop()
        free = max(free, loop.time()) + len(data) * self._byte_s
        loop.call_at(free, act, self._plugged, data)
        return free

    def _send(self, plugged: int, data: bytes) -> None:
        if plugged != self._plugged or self._master is None:  # unplugged meanwhile
            return
        sent = 0
        with contextlib.suppress(BlockingIOError, OSError):
            sent = os.write(self._master, data)
        self.lost_bytes += len(data) - sent

    def _readable(self) -> None:
        if self._master is None:
            return
        try:
            data = os.read(self._master, READ_BYTES)
        except (BlockingIOError, OSError):
            return
        self._in_free = self._after(self._in_free, self._take, data)

    def _take(self, plugged: int, data: bytes) -> None:
        if plugged == self._plugged and self._master is not None:
            self.on_bytes(data)


def _lasting(terminal: int) -> str:
    """A path of the terminal that leads nowhere once this process is dead, where there is one.

    The name of a terminal is given away again: a driver must not write to somebody's shell.
    """
    of_process = f"/proc/{os.getpid()}/fd/{terminal}"  # Linux
    return of_process if os.path.exists(of_process) else os.ttyname(terminal)
