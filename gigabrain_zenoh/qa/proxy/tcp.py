"""A proxy in front of a TCP port, such as a Zenoh router's, whose faults can be set."""

import asyncio
import contextlib
import random
import socket
import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Self, cast

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.proxy.chaos import CALM, WAYS, Chaos, LinkDamage, Way, WayCounters

Address = tuple[str, int]

RESET = struct.pack("ii", 1, 0)  # linger for 0 s: closing resets the connection
BACKLOG = 128
MAX_WAITING_BYTES = 4 << 20  # in a pipe; then the sender waits


class Pipe:
    """Delays and damages bytes from `feed` to `forward`, in order.

    `on_room` is called with True while the sender may send more.
    """

    def __init__(
        self,
        damage: LinkDamage,
        forward: Callable[[bytes], object],
        on_room: Callable[[bool], None],
        on_end: Callable[[], None],
    ) -> None:
        self._damage, self._figures = damage, damage.figures
        self._forward, self._on_room, self._on_end = forward, on_room, on_end
        self._chaos = CALM
        self._queue: deque[tuple[float, bytes]] = deque()
        self._waiting = 0
        self._stuck = self._ended = False
        self._timer: asyncio.TimerHandle | None = None

    def set(self, chaos: Chaos) -> None:
        """Replace the faults; pieces in the pipe keep their arrival times."""
        self._chaos = chaos
        self.flush()

    def feed(self, data: bytes) -> None:
        """Accept bytes from the sender."""
        now_s = asyncio.get_running_loop().time()
        pieces = self._damage.damaged(data, self._chaos, now_s)
        self._queue.extend(pieces)
        self._count(sum(len(piece) for _, piece in pieces))
        self.flush()

    def end(self) -> None:
        """End the stream: `on_end` is called after the last byte."""
        self._ended = True
        self.flush()

    def stick(self, stuck: bool) -> None:
        """Set whether the receiver is full."""
        self._stuck = stuck
        self.flush()

    def close(self) -> None:
        """Drop the pieces in the pipe."""
        if self._timer:
            self._timer.cancel()
        self._queue.clear()
        self._count(-self._waiting)

    def flush(self) -> None:
        """Forward all pieces that are due."""
        if self._timer:
            self._timer.cancel()
            self._timer = None
        loop = asyncio.get_running_loop()
        if not (self._chaos.hole or self._stuck):
            due = []
            while self._queue and self._queue[0][0] <= loop.time():
                due.append(self._queue.popleft()[1])
            if due:
                self._deliver(due)
            if self._queue:
                self._timer = loop.call_at(self._queue[0][0], self.flush)
            elif self._ended:
                self._ended = False
                self._on_end()
        self._on_room(not self._chaos.hole and self._waiting < MAX_WAITING_BYTES)

    def _deliver(self, pieces: list[bytes]) -> None:
        size = sum(map(len, pieces))
        self._count(-size)
        self._figures.handed_on += size
        for piece in [b"".join(pieces)] if self._chaos.merge_ms else pieces:
            self._forward(piece)

    def _count(self, more: int) -> None:
        self._waiting += more
        self._figures.waiting += more


class ProxiedCall:
    """Two sockets with a pipe in each direction; calls `on_gone` when both are closed."""

    def __init__(
        self,
        target: Address,
        damages: Sequence[LinkDamage],
        on_gone: Callable[["ProxiedCall"], None],
    ) -> None:
        self._gone = asyncio.Event()
        self.caller, self.called = End(self), End(self)
        self.caller.join(self.called, damages[0])
        self.called.join(self.caller, damages[1])
        self._target, self._on_gone = target, on_gone
        self._through = self._over = False
        self._calling: asyncio.Task[None] | None = None

    def set(self, chaos: Mapping[Way, Chaos]) -> None:
        """Replace the faults, by direction."""
        self._through = not any(one.hole for one in chaos.values())
        for end, way in zip((self.caller, self.called), WAYS, strict=True):
            end.out.set(chaos[way])
        self.begin()

    def begin(self) -> None:
        """Connect to the target if the caller is connected and there is no hole."""
        if self._through and self.caller.transport and not self._calling and not self._over:
            self._calling = asyncio.create_task(self._call())

    async def _call(self) -> None:
        try:
            await asyncio.get_running_loop().create_connection(lambda: self.called, *self._target)
        except OSError:  # no server: reset the caller
            self.cut(reset=True)

    def cut(self, reset: bool) -> None:
        """Close both connections, with RST or with FIN."""
        self._over = True
        if self._calling and self._calling is not asyncio.current_task():
            self._calling.cancel()
        for end in (self.caller, self.called):
            end.cut(reset)
        self.release_if_closed()

    async def ended(self) -> None:
        """Wait until both connections are closed."""
        await self._gone.wait()
        if self._calling:
            await asyncio.wait([self._calling])

    def release_if_closed(self) -> None:
        """Release the pipes when both connections are closed."""
        if self.caller.transport is None and self.called.transport is None:
            self.caller.out.close()
            self.called.out.close()
            self._on_gone(self)
            self._gone.set()


class End(asyncio.Protocol):
    """One of the two sockets, and the pipe for the bytes that it receives."""

    def __init__(self, call: ProxiedCall) -> None:
        self.transport: asyncio.Transport | None = None
        self._call = call
        self._received_all = self._sent_all = False

    def join(self, other: "End", damage: LinkDamage) -> None:
        """Forward the bytes of this end into the `other`."""
        self._other = other
        self.out = Pipe(damage, other.write, self.room, other.end)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start. Asyncio calls this method and the next five."""
        self.transport = cast(asyncio.Transport, transport)
        self.transport.pause_reading()
        self.out.flush()
        self._other.out.flush()
        self._call.begin()

    def data_received(self, data: bytes) -> None:
        """Forward the bytes of the peer."""
        self.out.feed(data)

    def eof_received(self) -> bool:
        """End this direction: the peer sends no more, but may still receive."""
        self._received_all = True
        self.out.end()
        return not self._sent_all

    def pause_writing(self) -> None:
        """Stop the other pipe: the peer does not read."""
        self._other.out.stick(True)

    def resume_writing(self) -> None:
        """Continue the other pipe: the peer reads again."""
        self._other.out.stick(False)

    def connection_lost(self, exc: Exception | None) -> None:
        """Close the other socket if this one was reset; release both if both are closed."""
        self.transport = None
        if exc or not self._sent_all:
            self._call.cut(reset=True)
        self._call.release_if_closed()

    def write(self, data: bytes) -> None:
        """Send bytes to the peer."""
        if self.transport:
            self.transport.write(data)

    def end(self) -> None:
        """Send FIN to the peer."""
        self._sent_all = True
        if self.transport and self._received_all:
            self.transport.close()
        elif self.transport:
            self.transport.write_eof()

    def room(self, room: bool) -> None:
        """Read from the peer, or pause."""
        if self.transport is None or self._received_all or self.transport.is_closing():
            return
        if room and self._other.transport:
            self.transport.resume_reading()
        else:
            self.transport.pause_reading()

    def cut(self, reset: bool) -> None:
        """Close at once, with RST or with FIN; unsent bytes are lost."""
        if self.transport is None or self.transport.is_closing():
            return
        sock: socket.socket = self.transport.get_extra_info("socket")
        with contextlib.suppress(OSError):  # the peer has closed it
            if reset:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            else:
                sock.shutdown(socket.SHUT_WR)
        self.transport.abort()


class TcpProxy:
    """Listens at `listen` and connects each caller to `target`. Use it in `async with`.

    `set` sets the faults, `cut` closes connections. During a hole, bytes stay in the sender's
    kernel, as in a dead network; after it, they are forwarded. New callers are still accepted.
    """

    def __init__(
        self, target: Address, listen: Address = ("127.0.0.1", 0), *, seed: int = 0
    ) -> None:
        self.figures: dict[Way, WayCounters] = {way: WayCounters() for way in WAYS}
        self.calls = self.cuts = 0
        self.chaos: dict[Way, Chaos] = dict.fromkeys(WAYS, CALM)
        self._target, self._listen, self._seed = target, listen, seed
        self._server: asyncio.Server | None = None
        self._open: set[ProxiedCall] = set()

    def __str__(self) -> str:
        return "{}:{}".format(*self._listen)

    @property
    def address(self) -> Address:
        """(host, port) of the listener, also while it is unplugged."""
        return self._listen

    @property
    def endpoint(self) -> str:
        """The same address as a Zenoh endpoint."""
        host, port = self._listen
        return f"tcp/[{host}]:{port}" if ":" in host else f"tcp/{host}:{port}"

    @property
    def open_calls(self) -> int:
        """Number of open connections."""
        return len(self._open)

    async def __aenter__(self) -> Self:
        await self.plug()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.unplug()

    def set(self, chaos: Chaos = CALM, *ways: Way) -> None:
        """Replace the faults of the named directions, or of both."""
        for way in ways or WAYS:
            self.chaos[way] = chaos
        for call in list(self._open):
            call.set(self.chaos)

    def cut(self, *, reset: bool = False) -> None:
        """Close all connections, with FIN or with RST; bytes in the pipes are lost."""
        self.cuts += len(self._open)
        for call in list(self._open):
            call.cut(reset)

    async def plug(self) -> None:
        """Listen, always at the same port. Raises ConfigError."""
        if self._server:
            return
        host, port = self._listen
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(self._accept, host, port, backlog=BACKLOG)
        except OSError as error:
            raise ConfigError(f"cannot listen on {host}:{port}: {error.strerror}") from None
        self._listen = (host, self._server.sockets[0].getsockname()[1])

    async def unplug(self) -> None:
        """Reset all connections and stop listening."""
        server, self._server = self._server, None
        if server:
            server.close()
        calls = list(self._open)
        self.cut(reset=True)
        for call in calls:
            await call.ended()

    def _accept(self) -> asyncio.Protocol:
        """Accept a caller. Each has its own random numbers, independent of the order of bytes."""
        self.calls += 1
        chances = (random.Random(f"{self._seed} {self.calls} {way}") for way in WAYS)
        damages = [LinkDamage(c, f) for c, f in zip(chances, self.figures.values(), strict=True)]
        call = ProxiedCall(self._target, damages, self._open.discard)
        self._open.add(call)
        call.set(self.chaos)
        return call.caller
