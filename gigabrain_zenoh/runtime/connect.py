"""Connects to a robot's bus: for its own processes, and for tools, scripts and tests."""

import asyncio
import contextlib
import errno
import logging
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from pathlib import Path

from msgspec import Struct, structs

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Transport
from gigabrain_zenoh.bus.zenoh.config import session_config
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.bus.zenoh.workarounds import NAP_S
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.host.network import host_and_port, is_ip
from gigabrain_zenoh.host.this_process import step_aside
from gigabrain_zenoh.runtime.running import find_endpoint
from gigabrain_zenoh.security.identity_files import identity_in, no_router

log = logging.getLogger("gigabrain")
MakeBus = Callable[[Transport, Clock, str], Bus]
WARN_AFTER_S = 1.0  # without a router, before a warning is logged
RETRY_S = 1.0  # pause between attempts to resolve a host name
ROUTER_TIMEOUT_S = 3.0


class Where(Struct, frozen=True, kw_only=True):
    """A robot's address, as options and scripts give it."""

    connect: str | None = None  # endpoint of its router; None is the only robot on this machine
    namespace: str = ""
    keys: str = ""  # folder of an identity


@asynccontextmanager
async def connect(
    where: Where | Endpoint,
    name: str,
    *,
    timeout_s: float | None = ROUTER_TIMEOUT_S,
    looks_on: bool = False,
    make_bus: MakeBus = Bus,
) -> AsyncIterator[Bus]:
    """Connect to a robot's bus as `name`, and disconnect at the end.

    With `timeout_s` None it waits without limit, and logs the reason. With `looks_on` messages are
    delivered in batches, and the robot's own processes have priority. Raises BusError without a
    router, and ConfigError for invalid keys.
    """
    if isinstance(where, Where):
        endpoint = find_endpoint(where.connect, where.namespace, where.keys)
    else:
        endpoint = where
    if looks_on:
        step_aside()
        endpoint = structs.replace(endpoint, nap_s=NAP_S)
    try:
        opening = ZenohTransport.open(endpoint) if timeout_s else open_session(endpoint)
        transport = await asyncio.wait_for(opening, timeout_s)
    except TimeoutError:
        raise no_router(endpoint) from None
    bus = make_bus(transport, Clock(), name)
    try:
        yield bus
    finally:
        await bus.close()


async def open_session(endpoint: Endpoint) -> ZenohTransport:
    """Open the session. Log a warning once if the router is missing for longer than WARN_AFTER_S.

    Raises BusError when a router cannot listen. Raises ConfigError for errors that waiting cannot
    fix, such as invalid keys of this process.
    """
    session_config(endpoint)
    await _wait_for_names(endpoint.listen)
    await _wait_for_addresses(endpoint.listen)
    opening = asyncio.ensure_future(ZenohTransport.open(endpoint))
    try:
        done, _ = await asyncio.wait((opening,), timeout=WARN_AFTER_S)
        if not done:
            if endpoint.keys:  # a router rejects invalid keys without an error
                await asyncio.to_thread(identity_in, Path(endpoint.keys))
            await _explain(endpoint, opening)
        return await opening
    finally:
        opening.cancel()


async def unknown_host(endpoints: Iterable[str]) -> str:
    """Return the first host in these endpoints whose name cannot be resolved, or an empty text.

    Resolves in a daemon thread: a resolver may take many seconds, and must not delay the exit of
    the process.
    """
    hosts = [host for host, _ in map(host_and_port, endpoints) if host and not is_ip(host)]
    if not hosts:
        return ""
    loop = asyncio.get_running_loop()
    found: asyncio.Future[str] = loop.create_future()

    def settle(unknown: str) -> None:
        if not found.done():
            found.set_result(unknown)

    def work() -> None:
        unknown = next((host for host in hosts if not _resolves(host)), "")
        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(settle, unknown)

    threading.Thread(target=work, name="resolver", daemon=True).start()
    return await found


def _resolves(host: str) -> bool:
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError):
        return False
    return True


async def _wait_for_names(listen: Iterable[str]) -> None:
    """Wait until the router's own listen addresses resolve.

    At boot, name resolution may start later than the router.
    """
    reported = ""
    while host := await unknown_host(listen):
        if host != reported:
            _warn(_unknown_name(host))
        reported = host
        await asyncio.sleep(RETRY_S)


async def _wait_for_addresses(listen: Iterable[str]) -> None:
    """Wait until this host has the router's own addresses: at boot, DHCP may be later."""
    reported = ""
    while missing := _missing_address(listen):
        if missing != reported:
            _warn(f"this host has no address {missing}; waiting for it (is it this host's own?)")
        reported = missing
        await asyncio.sleep(RETRY_S)


def _missing_address(endpoints: Iterable[str]) -> str:
    """Return the first IP address in endpoints that this host does not have; empty for none."""
    for host, _ in map(host_and_port, endpoints):
        if is_ip(host):
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            try:
                with socket.socket(family, socket.SOCK_STREAM) as trial:
                    trial.bind((host, 0))
            except OSError as error:
                if error.errno == errno.EADDRNOTAVAIL:  # the session reports all others
                    return host
    return ""


async def _explain(endpoint: Endpoint, opening: asyncio.Future[ZenohTransport]) -> None:
    """Log what the session waits for, unless it opens while the host name is being resolved."""
    naming = asyncio.ensure_future(unknown_host(endpoint.connect))
    try:
        await asyncio.wait((opening, naming), return_when=asyncio.FIRST_COMPLETED)
        if not opening.done():
            _warn(_unknown_name(naming.result()) if naming.result() else _no_router(endpoint))
    finally:
        naming.cancel()


def _unknown_name(host: str) -> str:
    return f"cannot resolve host {host!r}; waiting for its name (is it spelt right?)"


def _no_router(endpoint: Endpoint) -> str:
    where = ", ".join(endpoint.connect) or ", ".join(endpoint.listen)
    return f"no router at {where} yet; waiting for it (start one with: gigabrain router)"


def _warn(text: str) -> None:
    log.warning("%s", text, extra={"data": {"event": "waiting"}})
