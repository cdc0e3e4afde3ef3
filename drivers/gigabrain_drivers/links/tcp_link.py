"""TCP connections to a body, whose address may be in a file."""

import asyncio
import contextlib
import errno
import socket
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gigabrain_drivers.links.link import Link, LinkProblem, describe_error
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import read_bounded

CONNECT_TIMEOUT_S = 1.0  # divided by the number of addresses of a host name
QUIET_NS = 200_000_000  # only bytes prove a peer alive: the kernel acknowledges for a frozen one
LINGER_DISCARD = struct.pack("ii", 1, 0)  # linger for 0 s: unsent bytes are dropped
MAX_ADDRESS_BYTES = 256  # in a file with an address

AddressInfo = tuple[socket.AddressFamily, socket.SocketKind, int, str, Any]  # from getaddrinfo


class TcpLink(Link):
    """A TCP connection. It is dropped after `quiet_ns` without bytes from the peer."""

    def __init__(
        self, host: str, port: int, clock: Clock, *, quiet_ns: int | None = QUIET_NS
    ) -> None:
        super().__init__(clock)
        self._host, self._port, self.quiet_ns = host, port, quiet_ns
        self._socket: socket.socket | None = None

    def __str__(self) -> str:
        return f"{self._host}:{self._port}"

    async def _connect(self) -> int:
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                addresses = await loop.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM)
                self._socket = await _first_connected(addresses, CONNECT_TIMEOUT_S / len(addresses))
        except TimeoutError:
            raise LinkProblem(f"no answer from {self}: is it switched on?") from None
        except (socket.gaierror, UnicodeError) as error:
            raise LinkProblem(f"no host {self._host!r}: {error.args[-1]}") from None
        except OSError as error:
            if error.errno == errno.ECONNREFUSED:
                raise LinkProblem(f"nothing listens at {self}: is its program running?") from None
            raise LinkProblem(f"{self}: {describe_error(error)}") from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER_DISCARD)
        return self._socket.fileno()

    def _shut(self) -> None:
        if self._socket:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None

    def _cut_short(self) -> None:
        self.drop("it does not read what is sent to it")


class AddressLink(TcpLink):
    """A TCP connection to `HOST:PORT`, or to the address in a file.

    The file is read for each connection, because an emulator may use another port after a restart.
    """

    def __init__(self, target: str, clock: Clock) -> None:
        super().__init__("", 0, clock)
        self._target = target
        if "/" not in target:
            self._host, self._port = address(target)

    def __str__(self) -> str:
        return f"{self._host}:{self._port}" if self._host else self._target

    async def _connect(self) -> int:
        if "/" in self._target:
            self._host, self._port = read_address(Path(self._target))
        return await super()._connect()


async def _first_connected(addresses: Sequence[AddressInfo], timeout_s: float) -> socket.socket:
    """Return a socket connected to the first address that answers. Raises OSError."""
    loop, problem = asyncio.get_running_loop(), OSError(errno.EADDRNOTAVAIL, "no address")
    for family, kind, protocol, _, sockaddr in addresses:
        candidate = socket.socket(family, kind, protocol)
        candidate.setblocking(False)
        try:
            async with asyncio.timeout(timeout_s):
                await loop.sock_connect(candidate, sockaddr)
        except OSError as error:  # includes timeouts
            candidate.close()
            problem = error
        except asyncio.CancelledError:
            candidate.close()
            raise
        else:
            return candidate
    raise problem


def address(text: str) -> tuple[str, int]:
    """Return (host, port) of `HOST:PORT`. Raises ConfigError."""
    host, _, port = text.strip().rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"port: expected HOST:PORT, such as 192.168.1.10:8080, got {text!r}")
    return host.strip("[]"), int(port)


def read_address(path: Path) -> tuple[str, int]:
    """Return (host, port) from a file. Raises LinkProblem."""
    try:
        return address(read_bounded(path, MAX_ADDRESS_BYTES).decode("ascii"))
    except OSError:
        raise LinkProblem(f"no {path}: is the emulator running?") from None
    except (ConfigError, UnicodeDecodeError):
        raise LinkProblem(f"{path} does not hold HOST:PORT") from None
