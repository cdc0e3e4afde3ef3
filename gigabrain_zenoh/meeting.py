"""A process's way to its session, and what is said while that takes longer than it should."""

import asyncio
import contextlib
import logging
import socket
import threading
from collections.abc import Iterable
from pathlib import Path

from gigabrain_zenoh.addresses import host_and_port, is_ip
from gigabrain_zenoh.keys.checks import identity_in
from gigabrain_zenoh.settings import Endpoint
from gigabrain_zenoh.zenoh_config import session_config
from gigabrain_zenoh.zenoh_transport import ZenohTransport

log = logging.getLogger("gigabrain")

PATIENCE_S = 1.0  # how long the router may be missing before somebody is told
AGAIN_S = 1.0  # between two looks at whether a host's name is known by now


async def join(endpoint: Endpoint) -> ZenohTransport:
    """Open the session, and say so once when that takes longer than a person would wait.

    Raises BusError when a router cannot listen, ConfigError for what can never be right, such as
    our own keys.
    """
    session_config(endpoint)
    await _know(endpoint.listen)
    opening = asyncio.ensure_future(ZenohTransport.open(endpoint))
    try:
        done, _ = await asyncio.wait((opening,), timeout=PATIENCE_S)
        if not done:
            if endpoint.keys:  # a router turns bad ones away without a word
                await asyncio.to_thread(identity_in, Path(endpoint.keys))
            await _explain(endpoint, opening)
        return await opening
    finally:
        opening.cancel()


async def unknown_host(endpoints: Iterable[str]) -> str:
    """The first host in these endpoints whose name nobody knows here, or nothing.

    In a daemon thread: a resolver may take many seconds, and the process must be able to end.
    """
    hosts = [host for host, _ in map(host_and_port, endpoints) if host and not is_ip(host)]
    if not hosts:
        return ""
    loop = asyncio.get_running_loop()
    told: asyncio.Future[str] = loop.create_future()

    def settle(unknown: str) -> None:
        if not told.done():
            told.set_result(unknown)

    def work() -> None:
        unknown = next((host for host in hosts if not _known(host)), "")
        with contextlib.suppress(RuntimeError):  # the loop is gone
            loop.call_soon_threadsafe(settle, unknown)

    threading.Thread(target=work, name="resolver", daemon=True).start()
    return await told


def _known(host: str) -> bool:
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError):
        return False
    return True


async def _know(listen: Iterable[str]) -> None:
    """Wait until a router's own address has a meaning: at boot, names may come later than it."""
    said = ""
    while host := await unknown_host(listen):
        if host != said:
            _tell(_nobody(host))
        said = host
        await asyncio.sleep(AGAIN_S)


async def _explain(endpoint: Endpoint, opening: asyncio.Future[ZenohTransport]) -> None:
    """Say what is waited for, unless that comes while the resolver still thinks."""
    naming = asyncio.ensure_future(unknown_host(endpoint.connect))
    try:
        await asyncio.wait((opening, naming), return_when=asyncio.FIRST_COMPLETED)
        if not opening.done():
            _tell(_nobody(naming.result()) if naming.result() else _no_router(endpoint))
    finally:
        naming.cancel()


def _nobody(host: str) -> str:
    return f"nobody here knows a host {host!r}; waiting for its name (is it spelt right?)"


def _no_router(endpoint: Endpoint) -> str:
    where = ", ".join(endpoint.connect) or ", ".join(endpoint.listen)
    return f"no router at {where} yet; waiting for it (start one with: gigabrain router)"


def _tell(text: str) -> None:
    log.warning("%s", text, extra={"data": {"event": "waiting"}})
