"""Services of every process: its health, its description under a unique name, its parameters."""

import logging
import os
import secrets
import socket
import time
from collections import Counter
from typing import get_args

import psutil

from gigabrain_schemas.requests import Claim, DescribeRequest, Description, ParamReply, ParamRequest
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import DESCRIBE, HEALTH, PARAM
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import log_accepted
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.logs import LEVELS

PERIOD_NS = 1_000_000_000


def rss_bytes() -> int:
    """Return the resident memory of this process."""
    return psutil.Process().memory_info().rss


async def publish_health(bus: Bus) -> None:
    """Publish this process's health once a second, until cancelled."""
    host, pid, start_ns = socket.gethostname(), os.getpid(), bus.clock.now_ns()
    last_ns, last_cpu_s = start_ns, time.process_time()
    received, sent = Counter[str](), Counter[str]()
    async for now in bus.clock.every(PERIOD_NS):
        seconds = max((now - last_ns) / 1e9, 1e-3)
        cpu_s = time.process_time()
        message = Health(
            process=bus.process,
            pid=pid,
            host=host,
            uptime_s=(now - start_ns) / 1e9,
            cpu=(cpu_s - last_cpu_s) / seconds,
            rss_bytes=rss_bytes(),
            received_hz=_rates(bus.received, received, seconds),
            sent_hz=_rates(bus.sent, sent, seconds),
            rejected=dict(bus.rejected),
            latency_ms=dict(bus.latency_ms),
            counters=dict(bus.counters),
            problems=bus.problems,
        )
        last_ns, last_cpu_s, received, sent = now, cpu_s, bus.received.copy(), bus.sent.copy()
        bus.publish(HEALTH, message, name=bus.process)


def _rates(now: Counter[str], before: Counter[str], seconds: float) -> dict[str, float]:
    return {key: round((count - before[key]) / seconds, 2) for key, count in now.items()}


TIMEOUT_S = 2.0  # without other processes there is no wait
RETRY_NS = 100_000_000  # until the next query of a process that has to exit, or refused
MAX_TRIES = 10  # after this many refusals a process is ignored
CONFIRM_PAUSES_NS = (1_000_000_000, 3_000_000_000)  # pauses before each query after the first
INSTANCE_BITS = 62
WEAKEST_INSTANCE = 1 << INSTANCE_BITS  # no other process exits for it


class NameClaim:
    """A process's claim to its name."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self.instance = bus, secrets.randbits(INSTANCE_BITS)
        self.claim: Claim = "starting"

    async def acquire(self) -> None:
        """Serve the name and wait until no other process has it.

        Raises ConfigError where another process keeps the name.
        """
        self._bus.serve(DESCRIBE, self._describe, name=self._bus.process)
        await self._wait_until_alone()
        self.claim = "working"

    async def settle(self) -> None:
        """Query the name again after each pause, then settle. Raises ConfigError like `acquire`."""
        for pause_ns in CONFIRM_PAUSES_NS:
            await self._bus.clock.sleep_ns(pause_ns)
            await self._wait_until_alone()
        self.claim = "settled"

    async def keep(self) -> None:
        """Settle, and claim the name again after each loss of the link, until cancelled.

        A process that was stopped or cut off may have been replaced. It then has to exit, as a
        settled process keeps the name. Raises ConfigError like `acquire`.
        """
        while True:
            losses = self._bus.transport.losses
            await self.settle()
            while self._bus.transport.losses == losses:
                await self._bus.clock.sleep_ns(PERIOD_NS)
            self.claim = "working"
            while not any(each.instance == self.instance for each in await self._query_claims()):
                await self._bus.clock.sleep_ns(RETRY_NS)  # there is no link yet
            await self._wait_until_alone()

    async def _wait_until_alone(self) -> None:
        """Wait until no other process answers to the name."""
        while await self._others_answer():
            await self._bus.clock.sleep_ns(RETRY_NS)

    async def _others_answer(self) -> bool:
        """Return whether other processes answer that have to exit.

        Raises ConfigError if this process has to exit.
        """
        name = self._bus.process
        others = [other for other in await self._query_claims() if other.instance != self.instance]
        for other in others:
            if _strength(other.claim, other.instance) > _strength(self.claim, self.instance):
                self.claim, self.instance = "starting", WEAKEST_INSTANCE
                raise ConfigError(
                    f"a {name} is already running here (pid {other.pid} on {other.host}); "
                    "stop it, or give this robot a namespace of its own"
                )
        return bool(others)

    async def _query_claims(self) -> list[Description]:
        """Query every process of this name; retry after a refusal, as during a flood of queries."""
        for _ in range(MAX_TRIES):
            try:
                name = self._bus.process
                return await self._bus.ask(
                    DESCRIBE, DescribeRequest(), timeout_s=TIMEOUT_S, name=name
                )
            except Refused:
                await self._bus.clock.sleep_ns(RETRY_NS)
        return []  # a process that only refuses does not claim the name

    async def _describe(self, _: DescribeRequest) -> Description:
        from gigabrain_zenoh.plugins import package_version  # takes 25 ms, so imported lazily

        bus = self._bus
        return Description(
            process=bus.process,
            pid=os.getpid(),
            host=socket.gethostname(),
            version=package_version(),
            publishes=tuple(sorted(bus.sent)),
            subscribes=tuple(sorted(bus.listens)),
            instance=self.instance,
            claim=self.claim,
            report={"rejected_messages": bus.rejected.total(), **bus.report()},
        )


def _strength(claim: Claim, instance: int) -> tuple[int, int]:
    """Return the rank of a claim; the process with the greater rank stays."""
    return get_args(Claim).index(claim), -instance


LOG_LEVEL = "log_level"  # does not affect behaviour, so a change need not be recorded
log = logging.getLogger(__name__)


def serve_params(bus: Bus) -> None:
    """Serve this process's parameters, including its log level."""
    bus.params.add(LOG_LEVEL, f"one of: {', '.join(LEVELS)}", _level, _set_level)

    async def answer(request: ParamRequest) -> ParamReply:
        if not request.name:
            return ParamReply(ok=True, text="", params=bus.params.all())
        data = {"event": "param", "name": request.name, "source": request.source}
        try:
            before, now = bus.params.change(request.name, request.value)
        except Refused as error:
            log.warning("param refused to %s: %s", request.source, error, extra={"data": data})
            return ParamReply(ok=False, text=str(error)[:500], params=bus.params.all())
        if request.name != LOG_LEVEL:
            log_accepted(bus, PARAM.at(bus.process), request, bus.time.tick)
        text = f"{request.name} is {now} now, it was {before}"
        log.info("param by %s: %s", request.source, text, extra={"data": data})
        return ParamReply(ok=True, text=text[:500], params=bus.params.all())

    bus.serve(PARAM, answer, name=bus.process)


def _level() -> str:
    return logging.getLevelName(logging.getLogger().level).lower()


def _set_level(text: str) -> None:
    if text not in LEVELS:
        raise ValueError(text)
    logging.getLogger().setLevel(text.upper())
