"""Proxies between a driver and its body: they lose, damage, split and merge bytes."""

import contextlib
import os
import random
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Self

from gigabrain_drivers.emulators.ports import Pty
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_drivers.links.tcp_link import address
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.proxy.chaos import CALM, WAYS, Chaos, LinkDamage, Way, WayCounters
from gigabrain_zenoh.qa.proxy.tcp import Pipe, TcpProxy

ANY_BAUD = 115200  # a pty takes any


class LineProxy:
    """A pty at `path` that is connected to the serial port `to`. Use it in `async with`.

    A wire has no buffer: during a `hole`, and when the receiver is full, bytes are lost.
    """

    def __init__(self, to: str, path: Path, *, baud: int = ANY_BAUD, seed: int = 0) -> None:
        self.figures: dict[Way, WayCounters] = {way: WayCounters() for way in WAYS}
        self.chaos: dict[Way, Chaos] = dict.fromkeys(WAYS, CALM)
        self._pty, self._link = Pty(path), SerialLink(to, baud, Clock())
        damages = [LinkDamage(random.Random(f"{seed} {way}"), self.figures[way]) for way in WAYS]
        self._wires = _Wire(damages[0], self._link.write), _Wire(damages[1], self._pty.write)
        self._pty.on_bytes, self._link.on_bytes = (wire.feed for wire in self._wires)

    def __str__(self) -> str:
        return str(self._pty.path)

    @property
    def connected(self) -> bool:
        """True while the real port is open."""
        return self._link.connected

    async def __aenter__(self) -> Self:
        if self._pty.path.exists() and not self._pty.path.is_symlink():
            raise ConfigError(f"{self._pty.path} exists already; choose another path")
        self._link.open()
        await self.plug()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.unplug()
        await self._link.close()
        for wire in self._wires:
            wire.pipe.close()

    def set(self, chaos: Chaos = CALM, *ways: Way) -> None:
        """Replace the faults of the named directions, or of both."""
        for way, wire in zip(WAYS, self._wires, strict=True):
            if way in (ways or WAYS):
                self.chaos[way] = chaos
                wire.pipe.set(chaos)

    def cut(self, *, reset: bool = False) -> None:
        """Unplug and plug at once; `reset` makes no difference on a wire."""
        self._pty.unplug()
        self._pty.plug()

    async def plug(self) -> None:
        """Create the port, unless it exists."""
        self._pty.plug()

    async def unplug(self) -> None:
        """Remove the port, if it exists."""
        self._pty.unplug()


class _Wire:
    """One direction: a Pipe whose sender does not wait."""

    def __init__(self, damage: LinkDamage, write: Callable[[bytes], object]) -> None:
        self._figures, self._room = damage.figures, True
        self.pipe = Pipe(damage, write, self._on_room, lambda: None)

    def feed(self, data: bytes) -> None:
        if self._room:
            self.pipe.feed(data)
        else:
            self._figures.taken += len(data)
            self._figures.dropped += len(data)

    def _on_room(self, room: bool) -> None:
        self._room = room


@contextlib.asynccontextmanager
async def in_front_of(
    ports: Path, folder: Path, *, seed: int = 0
) -> AsyncIterator[dict[str, LineProxy | TcpProxy]]:
    """Run a proxy in `folder` for each of an emulator's `ports`; yield them by name.

    The driver uses the ports in `folder` (`--ports`). Raises ConfigError.
    """
    proxies = _proxies(ports, folder, seed)
    async with contextlib.AsyncExitStack() as stack:
        for name, proxy in proxies.items():
            await stack.enter_async_context(proxy)
            if isinstance(proxy, TcpProxy):
                address_file = folder / name
                _write(address_file, f"{proxy}\n")
                stack.callback(address_file.unlink)
        yield proxies


def _proxies(ports: Path, folder: Path, seed: int) -> dict[str, LineProxy | TcpProxy]:
    """Return a proxy per port: a symbolic link points to a pty, a file has a TCP address."""
    folder.mkdir(parents=True, exist_ok=True)
    found: dict[str, LineProxy | TcpProxy] = {}
    for port in sorted(ports.iterdir()):
        if port.is_symlink():
            found[port.name] = LineProxy(str(port), folder / port.name, seed=seed)
        elif port.suffix != ".json":  # the emulator's faults
            found[port.name] = TcpProxy(address(port.read_text(encoding="ascii")), seed=seed)
    return found


def _write(path: Path, text: str) -> None:
    fresh = path.with_name(f".{path.name}.new")
    fresh.write_text(text, encoding="ascii")
    os.replace(fresh, path)
