"""A caller of a proxy, and the connection that is made for it."""

import asyncio
import contextlib
import socket
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import cast

from gigabrain_zenoh.qa.proxy.chaos import WAYS, Chaos, Way
from gigabrain_zenoh.qa.proxy.damage import Damage
from gigabrain_zenoh.qa.proxy.pipe import Pipe

Address = tuple[str, int]

RESET = struct.pack("ii", 1, 0)  # linger for 0 s: what is closed is reset


class Call:
    """Two sockets with a pipe each way. `on_gone` hears when both are closed."""

    def __init__(
        self, target: Address, damages: Sequence[Damage], on_gone: Callable[["Call"], None]
    ) -> None:
        self._gone = asyncio.Event()
        self.caller, self.called = End(self), End(self)
        self.caller.join(self.called, damages[0])
        self.called.join(self.caller, damages[1])
        self._target, self._on_gone = target, on_gone
        self._through = self._over = False
        self._calling: asyncio.Task[None] | None = None

    def set(self, chaos: Mapping[Way, Chaos]) -> None:
        """Have this go wrong, by way."""
        self._through = not any(its.hole for its in chaos.values())
        for end, way in zip((self.caller, self.called), WAYS, strict=True):
            end.out.set(chaos[way])
        self.begin()

    def begin(self) -> None:
        """Call the target, once the caller is there and nothing lies between."""
        if self._through and self.caller.transport and not self._calling and not self._over:
            self._calling = asyncio.create_task(self._call())

    async def _call(self) -> None:
        try:
            await asyncio.get_running_loop().create_connection(lambda: self.called, *self._target)
        except OSError:  # nobody is there: the caller is told in the only way that is left
            self.cut(reset=True)

    def cut(self, reset: bool) -> None:
        """End both connections, with RST or with FIN."""
        self._over = True
        if self._calling and self._calling is not asyncio.current_task():
            self._calling.cancel()
        for end in (self.caller, self.called):
            end.cut(reset)
        self.look()

    async def ended(self) -> None:
        """Wait until nothing of it is left."""
        await self._gone.wait()
        if self._calling:
            await asyncio.wait([self._calling])

    def look(self) -> None:
        """Let go of it when nothing is open any more."""
        if self.caller.transport is None and self.called.transport is None:
            self.caller.out.close()
            self.called.out.close()
            self._on_gone(self)
            self._gone.set()


class End(asyncio.Protocol):
    """One of the two sockets, and the pipe for what comes out of it."""

    def __init__(self, call: Call) -> None:
        self.transport: asyncio.Transport | None = None
        self._call = call
        self._heard_all = self._said_all = False

    def join(self, other: "End", damage: Damage) -> None:
        """Have what comes out of this one go into the `other`."""
        self._other = other
        self.out = Pipe(damage, other.write, self.room, other.end)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The socket is open (asyncio calls this, and the other ones)."""
        self.transport = cast(asyncio.Transport, transport)
        self.transport.pause_reading()
        self.out.wake()
        self._other.out.wake()
        self._call.begin()

    def data_received(self, data: bytes) -> None:
        """Its peer has sent something."""
        self.out.feed(data)

    def eof_received(self) -> bool:
        """Its peer sends no more, but may still listen."""
        self._heard_all = True
        self.out.end()
        return not self._said_all

    def pause_writing(self) -> None:
        """Its peer does not read."""
        self._other.out.stick(True)

    def resume_writing(self) -> None:
        """Its peer reads again."""
        self._other.out.stick(False)

    def connection_lost(self, exc: Exception | None) -> None:
        """The socket is closed: it was reset, or both have said all."""
        self.transport = None
        if exc or not self._said_all:
            self._call.cut(reset=True)
        self._call.look()

    def write(self, data: bytes) -> None:
        """To its peer."""
        if self.transport:
            self.transport.write(data)

    def end(self) -> None:
        """Tell its peer that there is no more."""
        self._said_all = True
        if self.transport and self._heard_all:
            self.transport.close()
        elif self.transport:
            self.transport.write_eof()

    def room(self, room: bool) -> None:
        """Whether what its peer sends may be read."""
        if self.transport is None or self._heard_all or self.transport.is_closing():
            return
        if room and self._other.transport:
            self.transport.resume_reading()
        else:
            self.transport.pause_reading()

    def cut(self, reset: bool) -> None:
        """Close it at once, with RST or with FIN; what was still to be sent is lost."""
        if self.transport is None or self.transport.is_closing():
            return
        sock: socket.socket = self.transport.get_extra_info("socket")
        with contextlib.suppress(OSError):  # it has just been closed by its peer
            if reset:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            else:
                sock.shutdown(socket.SHUT_WR)
        self.transport.abort()
