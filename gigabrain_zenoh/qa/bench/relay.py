"""The bare relay: four plain Zenoh processes that forward messages, as a reference for the chain.

    source ──scan──► first ──world──► second ──intent──► third ──cmd──► source

A callback publishes at once: no asyncio, no decoding, no work. Each process has the Zenoh threads
and the niceness of the one that it replaces. The command is `python -m
gigabrain_zenoh.qa.bench.relay ROLE`, with a RelayRole in JSON.
"""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import zenoh
from msgspec import Struct

from gigabrain_zenoh.bus.zenoh.config import ZENOH_RUNTIME, session_config
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.this_process import go_first
from gigabrain_zenoh.qa.judging import latencies

STAMP_BYTES = 8
LOST_S = 0.3  # later messages count as lost
ENDS = {signal.SIGTERM, signal.SIGINT}


class RelayRole(Struct, frozen=True, kw_only=True):
    """The role of one process of the relay."""

    gets: str  # key
    puts: str  # key
    size: int  # [bytes], of its messages
    endpoint: Endpoint  # its router; for a peer, where it listens and connects
    first: bool = False  # has a higher priority where allowed, like driver and control
    rate_hz: float = 0.0  # of the source; 0 for the others
    settle_s: float = 0.0  # of the source: time before the measurement
    seconds: float = 0.0  # of the source: time of the measurement


def open_session(endpoint: Endpoint) -> zenoh.Session:
    """Open a session configured like ours. A listening one is a peer here, not a router."""
    settings = session_config(endpoint)
    if endpoint.listen:
        settings["mode"] = "peer"
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """Declare a publisher like the bus's for a stream."""
    return session.declare_publisher(
        key, priority=zenoh.Priority.DATA, congestion_control=zenoh.CongestionControl.DROP
    )


def forward(session: zenoh.Session, role: RelayRole) -> None:
    """Forward messages, cut or padded to this hop's size, until a signal ends the process."""
    put, filler = publisher(session, role.puts).put, bytes(role.size)

    def relay(sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        put(payload[: role.size] + filler[len(payload) :])

    subscriber = session.declare_subscriber(role.gets, relay)
    print_record({"event": "ready"})
    signal.sigwait(ENDS)
    subscriber.undeclare()


def measure(session: zenoh.Session, role: RelayRole) -> None:
    """Send at a steady rate, and report the time of each round trip."""
    put, filler = publisher(session, role.puts).put, bytes(role.size - STAMP_BYTES)
    times_ms: list[float] = []
    settled = threading.Event()

    def on_return(sample: zenoh.Sample) -> None:
        sent_ns = int.from_bytes(sample.payload.to_bytes()[:STAMP_BYTES], "little")
        if settled.is_set():
            times_ms.append((time.monotonic_ns() - sent_ns) / 1e6)

    def send() -> None:
        put(time.monotonic_ns().to_bytes(STAMP_BYTES, "little") + filler)

    subscriber = session.declare_subscriber(role.gets, on_return)
    print_record({"event": "ready"})
    paced(role.rate_hz, role.settle_s, send)
    settled.set()
    paced(role.rate_hz, role.seconds, send)
    time.sleep(LOST_S)
    print_record({"event": "figures", "figures": msgspec.to_builtins(latencies(times_ms))})
    signal.sigwait(ENDS)
    subscriber.undeclare()


def paced(rate_hz: float, seconds: float, act: Callable[[], None]) -> None:
    """Call `act` at a steady rate, by absolute deadlines."""
    begin = time.monotonic()
    for i in range(round(rate_hz * seconds)):
        time.sleep(max(0.0, begin + i / rate_hz - time.monotonic()))
        act()


def print_record(record: Mapping[str, Any]) -> None:
    """Print a line that the supervisor reads."""
    print(msgspec.json.encode(record).decode(), flush=True)


def main() -> None:
    """Run one process of the relay."""
    this_process.die_with_supervisor()
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDS)  # before Zenoh's threads inherit the mask
    role = msgspec.json.decode(sys.argv[1], type=RelayRole)
    os.environ.setdefault("ZENOH_RUNTIME", ZENOH_RUNTIME)
    if role.first:  # before threads start, which inherit it
        go_first()
    session = open_session(role.endpoint)
    if role.rate_hz:
        measure(session, role)
    else:
        forward(session, role)
    session.close()
    os._exit(0)  # Zenoh's threads must not keep a finished process alive


if __name__ == "__main__":
    main()
