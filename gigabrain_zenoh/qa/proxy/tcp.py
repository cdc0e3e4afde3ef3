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

MAX_WAITING_BYTES = 4 << 20  # bytes on their way; then the sender has to wait


class Pipe:
    """From `feed` to `hand_on`, in order. `on_room` is told whether the sender may go on."""

    def __init__(
        self,
        damage: LinkDamage,
        hand_on: Callable[[bytes], object],
        on_room: Callable[[bool], None],
        on_end: Callable[[], None],
    ) -> None:
        self._damage, self._figures = damage, damage.figures
        self._hand_on, self._on_room, self._on_end = hand_on, on_room, on_end
        self._chaos = CALM
        self._queue: deque[tuple[float, bytes]] = deque()
        self._waiting = 0
        self._stuck = self._ended = False
        self._timer: asyncio.TimerHandle | None = None

    def set(self, chaos: Chaos) -> None:
        """Be like this from now on; what is under way arrives when it was to arrive."""
        self._chaos = chaos
        self._flush()

    def wake(self) -> None:
        """The ends have changed: hand on what may be, take what may be."""
        self._flush()

    def feed(self, data: bytes) -> None:
        """What the sender has sent."""
        now_s = asyncio.get_running_loop().time()
        pieces = self._damage.damaged(data, self._chaos, now_s)
        self._queue.extend(pieces)
        self._count(sum(len(piece) for _, piece in pieces))
        self._flush()

    def end(self) -> None:
        """The sender sends no more; the receiver is told when the last byte has arrived."""
        self._ended = True
        self._flush()

    def stick(self, stuck: bool) -> None:
        """Whether the receiver takes no more at present."""
        self._stuck = stuck
        self._flush()

    def close(self) -> None:
        """Forget what is under way."""
        if self._timer:
            self._timer.cancel()
        self._queue.clear()
        self._count(-self._waiting)

    def _flush(self) -> None:
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
                self._timer = loop.call_at(self._queue[0][0], self._flush)
            elif self._ended:
                self._ended = False
                self._on_end()
        self._on_room(not self._chaos.hole and self._waiting < MAX_WAITING_BYTES)

    def _deliver(self, pieces: list[bytes]) -> None:
        size = sum(map(len, pieces))
        self._count(-size)
        self._figures.handed_on += size
        for piece in [b"".join(pieces)] if self._chaos.merge_ms else pieces:
            self._hand_on(piece)

    def _count(self, more: int) -> None:
        self._waiting += more
        self._figures.waiting += more


Address = tuple[str, int]

RESET = struct.pack("ii", 1, 0)  # linger for 0 s: what is closed is reset


class ProxiedCall:
    """Two sockets with a pipe each way. `on_gone` hears when both are closed."""

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

    def __init__(self, call: ProxiedCall) -> None:
        self.transport: asyncio.Transport | None = None
        self._call = call
        self._heard_all = self._said_all = False

    def join(self, other: "End", damage: LinkDamage) -> None:
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


CALLS_WAITING = 128


class TcpProxy:
    """Listens where `listen` says and joins each caller to `target`. Used as `async with`.

    `set` says what goes wrong from now on, `cut` ends what is open. A hole keeps the bytes with the
    sender's kernel, as a dead network would, and hands them on when it ends; who calls meanwhile is
    taken and hears nothing.
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
        """(host, port) where it listens, also while it is unplugged."""
        return self._listen

    @property
    def endpoint(self) -> str:
        """The same as a Zenoh endpoint."""
        host, port = self._listen
        return f"tcp/[{host}]:{port}" if ":" in host else f"tcp/{host}:{port}"

    @property
    def open_calls(self) -> int:
        """How many connections there are now."""
        return len(self._open)

    async def __aenter__(self) -> Self:
        await self.plug()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.unplug()

    def set(self, chaos: Chaos = CALM, *ways: Way) -> None:
        """Have this go wrong, and nothing else, with the named ways; with both when none is."""
        for way in ways or WAYS:
            self.chaos[way] = chaos
        for call in list(self._open):
            call.set(self.chaos)

    def cut(self, *, reset: bool = False) -> None:
        """End all that is open, with FIN or with RST; what is under way is lost."""
        self.cuts += len(self._open)
        for call in list(self._open):
            call.cut(reset)

    async def plug(self) -> None:
        """Listen, at the same port as before. Nothing if it does. Raises ConfigError."""
        if self._server:
            return
        host, port = self._listen
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(self._take, host, port, backlog=CALLS_WAITING)
        except OSError as error:
            raise ConfigError(f"cannot listen on {host}:{port}: {error.strerror}") from None
        self._listen = (host, self._server.sockets[0].getsockname()[1])

    async def unplug(self) -> None:
        """Reset all that is open and listen no more. Nothing if it is unplugged."""
        server, self._server = self._server, None
        if server:
            server.close()
        calls = list(self._open)
        self.cut(reset=True)
        for call in calls:
            await call.ended()

    def _take(self) -> asyncio.Protocol:
        """Each caller has a chance of its own, so that it does not matter who sends first."""
        self.calls += 1
        chances = (random.Random(f"{self._seed} {self.calls} {way}") for way in WAYS)
        damages = [LinkDamage(c, f) for c, f in zip(chances, self.figures.values(), strict=True)]
        call = ProxiedCall(self._target, damages, self._open.discard)
        self._open.add(call)
        call.set(self.chaos)
        return call.caller
