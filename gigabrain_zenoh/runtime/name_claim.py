"""Serves `robot/describe/<process>`, and ensures that only one process has that name.

A process starts to answer before it queries the name. Of two processes that start together, at
least one therefore receives an answer from the other. The process that is further along stays:
"settled" before "working" before "starting". A process settles after it has queried again for some
seconds, because over a slow link another process's answers arrive late. If both are equally far,
the smaller instance number stays.
"""

import os
import secrets
import socket
from typing import get_args

from gigabrain_schemas.requests import Claim, DescribeRequest, Description
from gigabrain_schemas.topics import DESCRIBE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import ConfigError, Refused

ASK_S = 2.0  # how long an answer may take; without other processes there is no wait
AGAIN_NS = 100_000_000  # until a process that has to exit, or refused to answer, is queried again
TRIES = 10  # after this many refusals a process is ignored
CONFIRM_NS = (1_000_000_000, 3_000_000_000)  # pauses before each query after the first


class NameClaim:
    """A process's claim to its name, from start to settled."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self.instance = bus, secrets.randbits(62)
        self.claim: Claim = "starting"

    async def take(self) -> None:
        """Serve the name and wait until no other process has it.

        Raises ConfigError where another process keeps the name.
        """
        self._bus.serve(DESCRIBE, self._describe, name=self._bus.process)
        await self._alone()
        self.claim = "working"

    async def keep(self) -> None:
        """Query the name again after each pause, then settle. Raises ConfigError like `take`."""
        for pause_ns in CONFIRM_NS:
            await self._bus.clock.sleep_ns(pause_ns)
            await self._alone()
        self.claim = "settled"

    async def _alone(self) -> None:
        """Wait until no other process answers to the name."""
        while await self._others():
            await self._bus.clock.sleep_ns(AGAIN_NS)

    async def _others(self) -> bool:
        """Return whether other processes answer that have to exit.

        Raises ConfigError if this process has to exit.
        """
        name = self._bus.process
        others = [other for other in await self._told() if other.instance != self.instance]
        for other in others:
            if _strength(other.claim, other.instance) > _strength(self.claim, self.instance):
                raise ConfigError(
                    f"a {name} is already running here (pid {other.pid} on {other.host}); "
                    "stop it, or give this robot a namespace of its own"
                )
        return bool(others)

    async def _told(self) -> list[Description]:
        """Query every process of this name; retry after a refusal, as during a flood of queries."""
        for _ in range(TRIES):
            try:
                name = self._bus.process
                return await self._bus.ask(DESCRIBE, DescribeRequest(), timeout_s=ASK_S, name=name)
            except Refused:
                await self._bus.clock.sleep_ns(AGAIN_NS)
        return []  # a process that only refuses does not claim the name

    async def _describe(self, _: DescribeRequest) -> Description:
        from gigabrain_zenoh.version import __version__  # 25 ms, so imported lazily

        bus = self._bus
        return Description(
            process=bus.process,
            pid=os.getpid(),
            host=socket.gethostname(),
            version=__version__,
            publishes=tuple(sorted(bus.sent)),
            subscribes=tuple(sorted(bus.listens)),
            instance=self.instance,
            claim=self.claim,
            report={"rejected_messages": bus.rejected.total(), **bus.report()},
        )


def _strength(claim: Claim, instance: int) -> tuple[int, int]:
    """Return the rank of a claim; the process with the greater rank stays."""
    return get_args(Claim).index(claim), -instance
