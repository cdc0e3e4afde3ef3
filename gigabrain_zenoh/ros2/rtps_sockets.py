"""UDP sockets of a DDS participant: its two ports, and the multicast group of announcements."""

import asyncio
import contextlib
import socket
from collections.abc import Callable, Sequence

import psutil

from gigabrain_zenoh.errors import BusError
from gigabrain_zenoh.ros2.rtps_discovery import (
    MULTICAST_GROUP,
    Address,
    host_ports,
    multicast_port,
)

LOOPBACK = "127.0.0.1"
PEER_PARTICIPANTS = 32  # on a peer, that get announcements by unicast, as in ROS
BUFFER_BYTES = 1 << 20  # of each socket
LOCAL_EVERY = 8  # one announcement in 8 also goes to this host's ports by unicast
ANY_ADDRESS = ""


class _Receiver(asyncio.DatagramProtocol):
    def __init__(self, receive: Callable[[bytes, str], None]) -> None:
        self._receive = receive

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self._receive(data, addr[0])

    def error_received(self, exc: Exception) -> None:
        """Ignore a closed port of a peer, whose lease will expire."""


class Sockets:
    """The sockets. Datagrams that cannot be sent are dropped."""

    def __init__(self, domain: int, *, localhost: bool, peers: Sequence[str]) -> None:
        """Prepare sockets; `peers` are hosts that get announcements by unicast."""
        self.builtin_port = self.user_port = 0
        self._domain, self._localhost, self._peers = domain, localhost, peers
        self._transports: list[asyncio.DatagramTransport] = []
        self._out: socket.socket | None = None
        self._group: socket.socket | None = None
        self._joined: set[str] = set()
        self._announcements = 0

    async def open(self, receive: Callable[[bytes, str], None]) -> None:
        """Bind the ports of the first free participant. Raises BusError if there is none."""
        # none with localhost: it would also receive from groups that other processes joined
        self._group = None if self._localhost else self._group_socket()
        try:
            builtin, user = self._free_pair()
        except BusError:
            if self._group:
                self._group.close()
            raise
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._out.setblocking(False)
        self._out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
        self._out.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        for sock in (builtin, user, *([self._group] if self._group else [])):
            sock.setblocking(False)
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
                lambda: _Receiver(receive), sock=sock
            )
            self._transports.append(transport)

    def close(self) -> None:
        """Close all sockets. May be called twice."""
        for transport in self._transports:
            transport.close()
        if self._out:
            self._out.close()
        self._transports, self._out, self._group = [], None, None

    def refresh(self) -> tuple[list[str], list[str]]:
        """Return this host's IPv4 addresses (to announce, all); join the group on new ones."""
        own = addresses()
        own = sorted(self._joined) if own is None else own
        outer = [host for host in own if not host.startswith("127.")]
        for host in own:
            if self._group and host not in self._joined:
                member = socket.inet_aton(MULTICAST_GROUP) + socket.inet_aton(host)
                with contextlib.suppress(OSError):  # such as a link without multicast
                    self._group.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        self._joined = set(own)
        return ([LOOPBACK] if self._localhost or not outer else outer), own

    def send(self, datagram: bytes, address: Address) -> None:
        """Send a datagram to an address."""
        if self._out:
            with contextlib.suppress(OSError):
                self._out.sendto(datagram, address)

    def announce(self, datagram: bytes) -> None:
        """Send a datagram to all reachable participants of the domain."""
        if not self._localhost and self._out:
            for host in sorted(self._joined):
                with contextlib.suppress(OSError):
                    self._out.setsockopt(
                        socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(host)
                    )
                    self._out.sendto(datagram, (MULTICAST_GROUP, multicast_port(self._domain)))
        local = self._localhost or self._announcements < 3 or self._announcements % LOCAL_EVERY == 0
        for host in (*self._peers, *([LOOPBACK] if local else [])):
            # ROS announces only to the first 32; announcing to all of this host finds the others
            limit = None if host == LOOPBACK else PEER_PARTICIPANTS
            for port, _ in host_ports(self._domain)[:limit]:
                if (host, port) != (LOOPBACK, self.builtin_port):
                    self.send(datagram, (host, port))
        self._announcements += 1

    def _free_pair(self) -> tuple[socket.socket, socket.socket]:
        host = LOOPBACK if self._localhost else ANY_ADDRESS
        pairs = host_ports(self._domain)
        for ports in pairs:
            pair = socket.socket(type=socket.SOCK_DGRAM), socket.socket(type=socket.SOCK_DGRAM)
            try:
                for sock, port in zip(pair, ports, strict=True):
                    sock.bind((host, port))
            except OSError:
                for sock in pair:
                    sock.close()
                continue
            self.builtin_port, self.user_port = ports
            return pair
        first, last = pairs[0][0], pairs[-1][1]
        raise BusError(
            f"no free UDP ports of DDS domain {self._domain} ({first} to {last}); "
            "end other ROS 2 programs, or choose another domain"
        )

    def _group_socket(self) -> socket.socket:
        group = socket.socket(type=socket.SOCK_DGRAM)
        group.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "SO_REUSEPORT"):
            with contextlib.suppress(OSError):
                group.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        port = multicast_port(self._domain)
        try:
            group.bind((ANY_ADDRESS, port))
        except OSError as error:
            group.close()
            raise BusError(
                f"UDP port {port} of DDS domain {self._domain}: {error.strerror}; end the program "
                "that has it, choose another domain, or set localhost: true"
            ) from None
        return group


def addresses() -> list[str] | None:
    """Return the IPv4 addresses of this host's interfaces that are up; None if unknown now."""
    try:
        stats, interfaces = psutil.net_if_stats(), psutil.net_if_addrs()
    except OSError:  # such as too many open files
        return None
    up = {name for name, each in stats.items() if each.isup}
    found = {
        each.address
        for name, of_interface in interfaces.items()
        if name in up
        for each in of_interface
        if each.family == socket.AF_INET
    }
    return sorted(found)


def outer_addresses() -> set[str]:
    """Return this host's addresses without the loopback's; empty if unknown now."""
    return {host for host in addresses() or () if not host.startswith("127.")}
