"""Ports and addresses of a participant. The last domain has ports for only 63 participants."""

import contextlib
import errno
import socket

import psutil
import pytest

from gigabrain_zenoh.errors import BusError
from gigabrain_zenoh.ros2.rtps_discovery import (
    MAX_DOMAIN,
    multicast_port,
    participant_ports,
)
from gigabrain_zenoh.ros2.rtps_sockets import Sockets, outer_addresses


async def test_announcements_in_the_last_domain_use_only_valid_ports():
    sockets = Sockets(MAX_DOMAIN, localhost=True, peers=["127.0.0.2"])
    await sockets.open(lambda datagram, host: None)
    with contextlib.closing(sockets):
        assert 65410 <= sockets.builtin_port < 65535
        sockets.announce(b"RTPS")


async def test_an_error_names_the_ports_of_a_domain_without_free_ones():
    with contextlib.ExitStack() as others:
        for index in range(63):
            for port in participant_ports(MAX_DOMAIN, index):
                taken = others.enter_context(socket.socket(type=socket.SOCK_DGRAM))
                with contextlib.suppress(OSError):
                    taken.bind(("127.0.0.1", port))
        sockets = Sockets(MAX_DOMAIN, localhost=True, peers=())
        with pytest.raises(BusError, match=r"domain 232 \(65410 to 65535\)"):
            await sockets.open(lambda datagram, host: None)


async def test_an_error_names_an_occupied_multicast_port():
    domain = 231
    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        taken.bind(("", multicast_port(domain)))
        sockets = Sockets(domain, localhost=False, peers=())
        with pytest.raises(BusError, match=r"UDP port 65150 of DDS domain 231: Address already"):
            await sockets.open(lambda datagram, host: None)
    sockets.close()
    for port in participant_ports(domain, 0):  # nothing is left open
        with socket.socket(type=socket.SOCK_DGRAM) as free:
            free.bind(("", port))


async def test_the_known_addresses_are_kept_while_none_can_be_read(monkeypatch):
    sockets = Sockets(MAX_DOMAIN, localhost=False, peers=())
    before = sockets.refresh()

    def fail():
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(psutil, "net_if_stats", fail)
    assert sockets.refresh() == before
    assert outer_addresses() == set()
