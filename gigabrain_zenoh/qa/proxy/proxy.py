"""A proxy in front of a TCP port, such as a Zenoh router's, that can be told what goes wrong."""

import asyncio
import random
from typing import Self

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.proxy.call import Address, Call
from gigabrain_zenoh.qa.proxy.chaos import CALM, WAYS, Chaos, Way
from gigabrain_zenoh.qa.proxy.damage import Damage, Figures

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
        self.figures: dict[Way, Figures] = {way: Figures() for way in WAYS}
        self.calls = self.cuts = 0
        self.chaos: dict[Way, Chaos] = dict.fromkeys(WAYS, CALM)
        self._target, self._listen, self._seed = target, listen, seed
        self._server: asyncio.Server | None = None
        self._open: set[Call] = set()

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
        damages = [Damage(c, f) for c, f in zip(chances, self.figures.values(), strict=True)]
        call = Call(self._target, damages, self._open.discard)
        self._open.add(call)
        call.set(self.chaos)
        return call.caller
