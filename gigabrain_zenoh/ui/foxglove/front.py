"""What stands before Foxglove's server: who may connect, how many, and how slowly they may read.

The server's library looks at no Origin, so a page of any site that is open in a browser of this
machine could look on, and it holds what a viewer does not read. It listens on a loopback address
and a port that nobody can guess (Linux; elsewhere on a port alone), and this passes on to it the
bytes of those who may connect.
"""

import asyncio
import contextlib
import logging
import re
import secrets
import sys
from collections.abc import Collection

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import this_process

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
# pages of this machine, and the viewers that are known; desktop programs are pages of a file
OWN_PAGE = re.compile(r"https?://(localhost|127(\.\d{1,3}){3}|\[::1\])(:\d{1,5})?")
VIEWERS = ("https://app.foxglove.dev", "https://studio.foxglove.dev", "file://")
MAX_VIEWERS = 16
MAX_ARRIVING = 64  # connections that have not asked yet; the oldest gives way to the newest
MAX_HEAD_BYTES = 16 * 1024
HEAD_S = 5.0  # until a request has to be there
STALL_S = 5.0  # so long may a viewer read nothing of what waits for it
MAX_TOLD = 20  # reasons that are logged, each once
GONE_S = 1.0  # until the server has noticed that a viewer has gone
CHUNK_BYTES = 64 * 1024


def hidden_host() -> str:
    """A loopback address of its own, where the system has more than one."""
    if sys.platform != "linux":
        return HOST
    return ".".join(("127", *(str(1 + secrets.randbelow(254)) for _ in range(3))))


class Front:
    """Listens where viewers connect, and passes on what they and the server say."""

    def __init__(self, origins: Collection[str], behind: tuple[str, int]) -> None:
        self._origins = {origin.lower() for origin in (*VIEWERS, *origins)}
        self._behind = behind
        self._arriving: list[asyncio.StreamWriter] = []
        self._viewers = 0
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._told: set[str] = set()  # why viewers were refused, in the log

    async def listen(self, port: int) -> int:
        """The port, which is `port` unless that is 0. Raises ConfigError where it is taken."""
        try:
            self._server = await asyncio.start_server(
                self._connected, HOST, port, limit=MAX_HEAD_BYTES
            )
        except OSError as error:
            raise ConfigError(
                f"foxglove: cannot listen on {HOST} port {port}: {error.strerror}; "
                "choose another with --port, or `foxglove: {port: …}` in the deployment file"
            ) from None
        return int(self._server.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Hang up on all."""
        if self._server:
            self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task
        self._tasks.add(task)
        try:
            if head := await self._let_in(reader, writer):
                await self._pass_on(head, reader, writer)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # gone, silent, slow or no HTTP: nobody waits for an answer
        except asyncio.CancelledError:
            pass  # by `close`; the streams of Python 3.11 would log it
        finally:
            writer.transport.abort()
            self._tasks.discard(task)

    async def _let_in(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> bytes | None:
        """The request of a viewer that may connect; the others are answered."""
        self._arriving.append(writer)
        if len(self._arriving) > MAX_ARRIVING:
            self._arriving.pop(0).transport.abort()
        try:
            async with asyncio.timeout(HEAD_S):
                head = await reader.readuntil(b"\r\n\r\n")
        finally:
            if writer in self._arriving:
                self._arriving.remove(writer)
        why = self.refusal(head)
        if not why and self._viewers >= MAX_VIEWERS:
            why = f"503 {MAX_VIEWERS} viewers are connected"
        if not why:
            return head
        if why not in self._told and len(self._told) < MAX_TOLD:
            self._told.add(why)
            log.warning("a viewer was refused: %s", why)
        writer.write(f"HTTP/1.1 {why}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode())
        async with asyncio.timeout(STALL_S):
            writer.close()
            await writer.wait_closed()
        return None

    def refusal(self, head: bytes) -> str:
        """Why a request is refused, as the status of HTTP; nothing for one that is let in."""
        lines = head.decode("latin-1").split("\r\n")[1:]
        fields = [(name.strip().lower(), value.strip().lower())
                  for name, _, value in (line.partition(":") for line in lines)]  # fmt: skip
        if ("upgrade", "websocket") not in fields:
            return "400 a WebSocket is expected"
        for origin in (value for name, value in fields if name == "origin"):
            if origin not in self._origins and not OWN_PAGE.fullmatch(origin):
                shown = re.sub(r"[^\x21-\x7e]", "?", origin)[:100]
                return f"403 pages of {shown} may not connect; allow it with --origin"
        return ""

    async def _pass_on(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Until one of the two hangs up, or the viewer reads nothing for too long."""
        self._viewers += 1
        try:
            to_reader, to_writer = await asyncio.open_connection(*self._behind)
            to_writer.write(head)
            ways = (
                asyncio.ensure_future(_pour(reader, to_writer)),
                asyncio.ensure_future(_pour(to_reader, writer)),
            )
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                to_writer.transport.abort()
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
        finally:
            self._viewers -= 1
            asyncio.get_running_loop().call_later(GONE_S, this_process.trim_heap)


async def _pour(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError, TimeoutError):
        while data := await reader.read(CHUNK_BYTES):
            writer.write(data)
            async with asyncio.timeout(STALL_S):
                await writer.drain()
