"""A body behind a TCP port."""

import asyncio
import contextlib
import socket
import struct

from gigabrain_drivers.links.link import Link, LinkProblem, why
from gigabrain_zenoh.clock import Clock

CONNECT_S = 1.0
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
                family, kind, protocol, _, address = found[0]
                self._socket = socket.socket(family, kind, protocol)
                self._socket.setblocking(False)
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, DISCARD)
                await loop.sock_connect(self._socket, address)
        except TimeoutError:
            self._shut()
            raise LinkProblem(f"no answer from {self}: is it switched on?") from None
        except socket.gaierror as error:
            self._shut()
            raise LinkProblem(f"no host {self._host!r}: {error.strerror}") from None
        except ConnectionRefusedError:
            self._shut()
            raise LinkProblem(f"nobody listens at {self}: is its program running?") from None
        except OSError as error:
            self._shut()
            raise LinkProblem(f"{self}: {why(error)}") from None
        except asyncio.CancelledError:
            self._shut()
            raise
        return self._socket.fileno()

    def _shut(self) -> None:
        if self._socket:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None

    def _cut_short(self) -> None:
        self.drop("it does not take what is sent to it")
