"""How a process is doing: once a second on `robot/health/<process>`."""

import os
import socket
import time
from collections import Counter

import psutil

from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import HEALTH
from gigabrain_zenoh.bus.bus import Bus

PERIOD_NS = 1_000_000_000


def rss_bytes() -> int:
    """Return the memory that this process holds."""
    return psutil.Process().memory_info().rss


async def publish_health(bus: Bus) -> None:
    """Until cancelled."""
    host, pid, began = socket.gethostname(), os.getpid(), bus.clock.now_ns()
    then, cpu = began, time.process_time()
    received, sent = Counter[str](), Counter[str]()
    async for now in bus.clock.every(PERIOD_NS):
        seconds = max((now - then) / 1e9, 1e-3)
        used = time.process_time()
        message = Health(
            process=bus.process,
            pid=pid,
            host=host,
            uptime_s=(now - began) / 1e9,
            cpu=(used - cpu) / seconds,
            rss_bytes=rss_bytes(),
            received_hz=_rates(bus.received, received, seconds),
            sent_hz=_rates(bus.sent, sent, seconds),
            rejected=dict(bus.rejected),
            latency_ms=dict(bus.latency_ms),
            counters=dict(bus.counters),
            problems=bus.problems,
        )
        then, cpu, received, sent = now, used, bus.received.copy(), bus.sent.copy()
        bus.publish(HEALTH, message, name=bus.process)


def _rates(now: Counter[str], before: Counter[str], seconds: float) -> dict[str, float]:
    return {key: round((count - before[key]) / seconds, 2) for key, count in now.items()}
