"""Access to the bridge: viewers that may connect, and the secret topic for steering.

The server's library checks no Origin, so a page of any site in a browser of this machine could
connect. It also stores all data that a viewer does not read. So the server listens on a random port
of a random loopback address (on Linux; elsewhere of 127.0.0.1). `Front` forwards the bytes of
viewers that may connect.
"""

import asyncio
import contextlib
import logging
import os
import re
import secrets
import sys
from collections.abc import Collection
from importlib.resources import files
from pathlib import Path

from gigabrain_zenoh.config.settings import FoxgloveConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.files import cannot_write
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.security.identity_files import made_once

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
# origins of this machine's pages, and of known viewers; desktop programs send file://
OWN_PAGE = re.compile(r"https?://(localhost|127(\.\d{1,3}){3}|\[::1\])(:\d{1,5})?")
VIEWERS = ("https://app.foxglove.dev", "https://studio.foxglove.dev", "file://")
MAX_VIEWERS = 16
MAX_ARRIVING = 64  # connections without a request; a new one replaces the oldest
MAX_HEAD_BYTES = 16 * 1024
REQUEST_TIMEOUT_S = 5.0
STALL_TIMEOUT_S = 5.0  # a viewer that reads nothing for so long is disconnected
MAX_LOGGED_REASONS = 20  # each is logged once
TRIM_DELAY_S = 1.0  # time for the server to notice that a viewer left
SECRET_BYTES = 24
TOPIC_PLACEHOLDER = "TOPIC_TO_STEER"  # in layout.json
CHUNK_BYTES = 64 * 1024


def hidden_host() -> str:
    """Return a random loopback address, if the system has more than one."""
    if sys.platform != "linux":
        return HOST
    return ".".join(("127", *(str(1 + secrets.randbelow(254)) for _ in range(3))))


class Front:
    """Listens for viewers, and forwards bytes between them and the server."""

    def __init__(self, origins: Collection[str], server_address: tuple[str, int]) -> None:
        self._origins = {origin.lower() for origin in (*VIEWERS, *origins)}
        self._server_address = server_address
        self._arriving: list[asyncio.StreamWriter] = []
        self.viewers = 0
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._logged: set[str] = set()  # reasons for refusals that were logged

    async def listen(self, port: int) -> int:
        """Listen on `port`, or any port if 0; return it. Raises ConfigError if it is taken."""
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
        """Close all connections."""
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
            if head := await self._admit(reader, writer):
                await self._forward(head, reader, writer)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # disconnected, silent, slow, or not HTTP: no answer is expected
        except asyncio.CancelledError:
            pass  # by `close`; the streams of Python 3.11 would log it
        finally:
            writer.transport.abort()
            self._tasks.discard(task)

    async def _admit(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> bytes | None:
        """Return the request of a viewer that may connect; refuse others, and return None."""
        self._arriving.append(writer)
        if len(self._arriving) > MAX_ARRIVING:
            self._arriving.pop(0).transport.abort()
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                head = await reader.readuntil(b"\r\n\r\n")
        finally:
            if writer in self._arriving:
                self._arriving.remove(writer)
        reason = self.refusal(head)
        if not reason and self.viewers >= MAX_VIEWERS:
            reason = f"503 {MAX_VIEWERS} viewers are connected already"
        if not reason:
            return head
        if reason not in self._logged and len(self._logged) < MAX_LOGGED_REASONS:
            self._logged.add(reason)
            log.warning("refused a viewer: %s", reason)
        writer.write(
            f"HTTP/1.1 {reason}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode()
        )
        async with asyncio.timeout(STALL_TIMEOUT_S):
            writer.close()
            await writer.wait_closed()
        return None

    def refusal(self, head: bytes) -> str:
        """Return the HTTP status that refuses a request; an empty text if it is admitted."""
        lines = head.decode("latin-1").split("\r\n")[1:]
        fields = [(name.strip().lower(), value.strip().lower())
                  for name, _, value in (line.partition(":") for line in lines)]  # fmt: skip
        if ("upgrade", "websocket") not in fields:
            return "400 expected a WebSocket"
        for origin in (value for name, value in fields if name == "origin"):
            if origin not in self._origins and not OWN_PAGE.fullmatch(origin):
                shown = re.sub(r"[^\x21-\x7e]", "?", origin)[:100]
                return f"403 pages of {shown} may not connect; allow them with --origin"
        return ""

    async def _forward(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Forward bytes until either side closes, or the viewer reads nothing for too long."""
        self.viewers += 1
        try:
            to_reader, to_writer = await asyncio.open_connection(*self._server_address)
            to_writer.write(head)
            copying = (
                asyncio.ensure_future(_copy(reader, to_writer)),
                asyncio.ensure_future(_copy(to_reader, writer)),
            )
            try:
                await asyncio.wait(copying, return_when=asyncio.FIRST_COMPLETED)
            finally:
                to_writer.transport.abort()
                for task in copying:
                    task.cancel()
                await asyncio.gather(*copying, return_exceptions=True)
        finally:
            self.viewers -= 1
            asyncio.get_running_loop().call_later(TRIM_DELAY_S, this_process.trim_heap)


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError, TimeoutError):
        while data := await reader.read(CHUNK_BYTES):
            writer.write(data)
            async with asyncio.timeout(STALL_TIMEOUT_S):
                await writer.drain()


def topic_to_steer(config: FoxgloveConfig) -> str:
    """Return the topic on which a viewer may publish velocities. Raises ConfigError.

    The secret has no other use: people share layouts, and the page's tokens allow more.
    """
    path = Path(config.secret) if config.secret else state_dir() / "foxglove" / "secret"
    secret, _ = made_once(path, secrets.token_urlsafe(SECRET_BYTES).encode())
    if not re.fullmatch(rb"[\w-]{16,200}", secret):
        raise ConfigError(
            f"{path}: expected a secret of 16 letters or more; remove the file for a new one"
        )
    return f"/teleop/{secret.decode()}"


def write_layout(config: FoxgloveConfig, path: Path) -> None:
    """Write the layout with the secret topic into a private file. Raises ConfigError."""
    layout = files("gigabrain_zenoh.ui.foxglove").joinpath("layout.json").read_text("utf-8")
    try:
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            os.fchmod(file.fileno(), 0o600)
            file.write(layout.replace(TOPIC_PLACEHOLDER, topic_to_steer(config)))
    except OSError as error:
        raise cannot_write(path, error) from None
