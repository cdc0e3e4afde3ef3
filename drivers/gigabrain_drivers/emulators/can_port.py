"""The emulated end of a CAN bus, by UDP multicast on this machine only."""

import asyncio
import contextlib
import errno
import os
import random
import socket
from collections.abc import Callable
from pathlib import Path

import can

from gigabrain_drivers.links.can_link import (
    CanDecoder,
    address_text,
    message_of,
    open_multicast,
    receive,
    records,
)
from gigabrain_drivers.links.link import LinkProblem

GROUPS = "239.255.{}.{}"  # the local scope of RFC 2365


class CanPort:
    """The device's end. Each `plug` creates a new bus, and writes its address to `path`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.on_bytes: Callable[[bytes], None] = lambda data: None
        self._bus: can.BusABC | None = None

    def plug(self) -> None:
        """Create the bus. Does nothing if it exists. Raises OSError."""
        if self._bus is not None:
            return
        group, port = GROUPS.format(random.randrange(256), random.randrange(1, 255)), _free_port()
        try:
            self._bus = open_multicast(group, port)
        except LinkProblem as error:
            raise OSError(errno.ENODEV, str(error)) from None
        asyncio.get_running_loop().add_reader(self._bus.fileno(), self._readable)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.write_text(address_text(group, port), encoding="ascii")
        os.replace(fresh, self.path)

    def unplug(self) -> None:
        """Remove the bus, even while it is in use. Does nothing if it is gone."""
        bus, self._bus = self._bus, None
        if bus:
            asyncio.get_running_loop().remove_reader(bus.fileno())
            bus.shutdown()
            self.path.unlink(missing_ok=True)

    def write(self, data: bytes) -> bool:
        """Send whole frames to the host. Return False when the bus is unplugged."""
        if self._bus is None:
            return False
        for frame in CanDecoder().feed(data):
            with contextlib.suppress(can.CanError):
                self._bus.send(message_of(frame))
        return True

    def _readable(self) -> None:
        if self._bus is None:
            return
        with contextlib.suppress(OSError):
            frames, _ = receive(self._bus)
            if frames:
                self.on_bytes(records(frames))


def _free_port() -> int:
    """Return an unused UDP port: on a shared port, two buses would receive each other's frames."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port: int = probe.getsockname()[1]
        return port
