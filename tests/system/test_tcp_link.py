"""TCP links: data both ways, and peers that are gone, silent, or do not read."""

import asyncio
import socket

import pytest

from gigabrain_drivers.links.tcp_link import TcpLink
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.testing.waiting import PATIENCE_S, until
from tests.system.links import LinkRecorder


def server() -> socket.socket:
    listening = socket.create_server(("127.0.0.1", 0))
    listening.settimeout(PATIENCE_S)
    return listening


async def test_a_tcp_link_transfers_both_ways_and_reconnects_to_its_peer() -> None:
    with server() as listening:
        link = TcpLink("127.0.0.1", listening.getsockname()[1], Clock(), quiet_ns=None)
        received = LinkRecorder(link)
        link.open()
        peer, _ = await asyncio.to_thread(listening.accept)
        await until(lambda: link.connected)
        assert link.write(b"hello")
        assert await asyncio.to_thread(peer.recv, 100) == b"hello"
        peer.close()
        await until(lambda: received.lost)
        peer, _ = await asyncio.to_thread(listening.accept)
        await until(lambda: link.connected)
        assert link.reconnects == 1
        await link.close()
        peer.close()


async def test_a_silent_tcp_peer_is_dropped_and_gets_no_old_bytes() -> None:
    with server() as listening:
        link = TcpLink("127.0.0.1", listening.getsockname()[1], Clock(), quiet_ns=100_000_000)
        received = LinkRecorder(link)
        link.open()
        frozen, _ = await asyncio.to_thread(listening.accept)
        await until(lambda: link.connected)
        while not received.lost:
            link.write(b"old")
            await asyncio.sleep(0.01)
        assert "no data for" in received.lost[0]
        peer, _ = await asyncio.to_thread(listening.accept)
        peer.sendall(b"alive")
        await until(lambda: received.data)
        link.write(b"new")
        assert await asyncio.to_thread(peer.recv, 100) == b"new"
        await link.close()
        frozen.close()
        peer.close()


async def test_a_tcp_peer_that_does_not_read_is_dropped_in_mid_frame() -> None:
    with server() as listening:
        link = TcpLink("127.0.0.1", listening.getsockname()[1], Clock(), quiet_ns=None)
        received = LinkRecorder(link)
        link.open()
        peer, _ = await asyncio.to_thread(listening.accept)
        await until(lambda: link.connected)
        while link.write(b"x" * 65536):
            pass
        assert received.lost == ["it does not read what is sent to it"]
        await link.close()
        peer.close()


@pytest.mark.parametrize(
    ("host", "complaint"), [("127.0.0.1", "nothing listens"), ("no.such.host.invalid", "no host")]
)
async def test_an_unreachable_tcp_port_is_reported(host: str, complaint: str) -> None:
    with server() as listening:
        port = listening.getsockname()[1]
    link = TcpLink(host, port, Clock())
    link.open()
    await until(lambda: complaint in link.problem)
    await link.close()


async def test_all_addresses_of_a_host_name_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    with server() as listening:
        port = listening.getsockname()[1]
        loop = asyncio.get_running_loop()

        async def both(*_: object, **__: object) -> list[tuple[object, ...]]:
            kind = (socket.SOCK_STREAM, socket.IPPROTO_TCP, "")
            return [
                (socket.AF_INET6, *kind, ("::1", port, 0, 0)),
                (socket.AF_INET, *kind, ("127.0.0.1", port)),
            ]

        monkeypatch.setattr(loop, "getaddrinfo", both)
        link = TcpLink("robot", port, Clock(), quiet_ns=None)
        link.open()
        await until(lambda: link.connected)
        await link.close()
