"""A body behind a TCP port."""

import asyncio
import contextlib
import errno
import socket
import struct

from aiohappyeyeballs import start_connection

from gigabrain_drivers.links.link import Link, LinkProblem, why
from gigabrain_zenoh.clock import Clock

CONNECT_S = 1.0
NEXT_S = 0.1  # after which the next address of a name is tried beside the one before
QUIET_NS = 200_000_000  # a frozen peer acknowledges for ever; only what it sends shows it alive
DISCARD = struct.pack("ii", 1, 0)  # linger on, for 0 s: what is still to be sent is thrown away


class TcpLink(Link):
    """Judged by what comes in: a peer that says nothing for `quiet_ns` is dropped."""

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
            async with asyncio.timeout(CONNECT_S):
                found = await loop.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM)
                self._socket = await start_connection(found, happy_eyeballs_delay=NEXT_S)
        except TimeoutError:
            raise LinkProblem(f"no answer from {self}: is it switched on?") from None
        except (socket.gaierror, UnicodeError) as error:
            raise LinkProblem(f"no host {self._host!r}: {error.args[-1]}") from None
        except OSError as error:
            if error.errno == errno.ECONNREFUSED:
                raise LinkProblem(f"nobody listens at {self}: is its program running?") from None
            raise LinkProblem(f"{self}: {why(error)}") from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, DISCARD)
        return self._socket.fileno()

    def _shut(self) -> None:
        if self._socket:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None

    def _cut_short(self) -> None:
        self.drop("it does not take what is sent to it")
