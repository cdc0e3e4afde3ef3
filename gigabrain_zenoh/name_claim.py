"""Answers `robot/describe/<process>`, and sees to it that one process alone has that name.

A process answers first and asks afterwards, so of two that start together at least one hears of
the other. Who has got further stays: it already works, or it has settled, having asked for some
seconds more. Those seconds are for slow links, over which another process is heard of late. Of
two that have got equally far the smaller instance number stays.
"""

import os
import secrets
import socket
from typing import get_args

from gigabrain_schemas.requests import Claim, DescribeRequest, Description
from gigabrain_schemas.topics import DESCRIBE
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.errors import ConfigError, Refused

ASK_S = 2.0  # how long an answer may take; who is alone does not wait
AGAIN_NS = 100_000_000  # until one that has to leave, or refused to answer, is asked again
TRIES = 10  # then a process that only refuses is ignored
CONFIRM_NS = (1_000_000_000, 3_000_000_000)  # pauses before the questions that follow the first


class NameClaim:
    """The claim of one process to its name."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self.instance = bus, secrets.randbits(62)
        self.claim: Claim = "starting"

    async def take(self) -> None:
        """Answer to the name. Raises ConfigError where another process has it."""
        self._bus.serve(DESCRIBE, self._describe, name=self._bus.process)
        await self._alone()
        self.claim = "working"

    async def keep(self) -> None:
        """Ask again while the process begins its work. Raises ConfigError, as `take`."""
        for pause_ns in CONFIRM_NS:
            await self._bus.clock.sleep_ns(pause_ns)
            await self._alone()
        self.claim = "settled"

    async def _alone(self) -> None:
        """Wait until nobody else answers to the name."""
        while await self._others():
            await self._bus.clock.sleep_ns(AGAIN_NS)

    async def _others(self) -> bool:
        """Whether others answer that have to leave. Raises ConfigError if this one has to."""
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
        """Ask every process of this name; ask again after a refusal, as during a flood."""
        for _ in range(TRIES):
            try:
                name = self._bus.process
                return await self._bus.ask(DESCRIBE, DescribeRequest(), timeout_s=ASK_S, name=name)
            except Refused:
                await self._bus.clock.sleep_ns(AGAIN_NS)
        return []  # errors alone claim no name

    async def _describe(self, _: DescribeRequest) -> Description:
        from gigabrain_zenoh.version import __version__  # 25 ms, which no start should wait for

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
    """The greater one stays."""
    return get_args(Claim).index(claim), -instance
