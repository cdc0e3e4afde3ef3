"""A process waits for its router while a host name or address is unknown."""

import asyncio
import errno
import logging
import socket

import pytest

from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.runtime import connect
from gigabrain_zenoh.runtime.connect import open_session, unknown_host
from gigabrain_zenoh.testing.processes import free_endpoint, session_threads
from gigabrain_zenoh.testing.waiting import until

CANNOT_RESOLVE = "cannot resolve host {!r}; waiting for its name (is it spelt right?)"


class Resolver:
    """A fake of the system's resolver, which knows no name until `knows` is set."""

    def __init__(self) -> None:
        self.queries: list[str] = []
        self.knows = False

    def __call__(self, host: str, *_: object) -> list[object]:
        self.queries.append(host)
        if not self.knows:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return []


@pytest.fixture
def resolver(monkeypatch: pytest.MonkeyPatch) -> Resolver:
    """Replace the system's resolver and shorten the waits."""
    made = Resolver()
    monkeypatch.setattr(socket, "getaddrinfo", made)
    monkeypatch.setattr(connect, "RETRY_S", 0.01)
    monkeypatch.setattr(connect, "WARN_AFTER_S", 0.01)
    return made


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]


async def test_only_host_names_are_looked_up(resolver: Resolver) -> None:
    addresses = ("tcp/127.0.0.1:1", "tls/[::1]:2", "unixsock-stream//x")
    assert await unknown_host(addresses) == ""
    assert resolver.queries == []
    assert await unknown_host((*addresses, "tcp/robot.lan:3")) == "robot.lan"
    resolver.knows = True
    assert await unknown_host(("tcp/robot.lan:3",)) == ""


async def test_a_router_waits_for_its_own_name_with_one_warning(
    resolver: Resolver, caplog: pytest.LogCaptureFixture
) -> None:
    here = free_endpoint().replace("127.0.0.1", "localhost")
    joining = asyncio.ensure_future(open_session(Endpoint(listen=(here,))))
    await until(lambda: len(resolver.queries) > 2)
    assert warnings(caplog) == [CANNOT_RESOLVE.format("localhost")]
    resolver.knows = True
    transport = await joining
    await transport.close()
    assert len([text for text in warnings(caplog) if "cannot resolve" in text]) == 1


async def test_a_router_waits_for_its_own_address_with_one_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connect, "RETRY_S", 0.01)
    here, bind, queries = free_endpoint(), socket.socket.bind, list[object]()

    def bind_late(self: socket.socket, address: tuple[str, int]) -> None:
        queries.append(address)
        if len(queries) < 4:  # as before a DHCP lease
            raise OSError(errno.EADDRNOTAVAIL, "Cannot assign requested address")
        bind(self, address)

    monkeypatch.setattr(socket.socket, "bind", bind_late)
    transport = await open_session(Endpoint(listen=(here,)))
    await transport.close()
    assert warnings(caplog) == [
        "this host has no address 127.0.0.1; waiting for it (is it this host's own?)"
    ]


async def test_a_client_waits_for_an_unknown_router_name_with_a_warning(
    resolver: Resolver, caplog: pytest.LogCaptureFixture
) -> None:
    others, here = session_threads(), free_endpoint()
    elsewhere = here.replace("127.0.0.1", "localhost")
    joining = asyncio.ensure_future(open_session(Endpoint(connect=(elsewhere,))))
    await until(lambda: bool(warnings(caplog)))
    assert warnings(caplog) == [CANNOT_RESOLVE.format("localhost")]
    joining.cancel()
    with pytest.raises(asyncio.CancelledError):
        await joining
    resolver.knows = True
    router = await ZenohTransport.open(Endpoint(listen=(here,)))
    await until(lambda: session_threads() <= others)  # no waiting thread is left
    await router.close()


async def test_an_invalid_endpoint_is_refused_at_once() -> None:
    with pytest.raises(ConfigError, match="is not a Zenoh endpoint"):
        await open_session(Endpoint(listen=("tcp/bad host!:7447",)))
