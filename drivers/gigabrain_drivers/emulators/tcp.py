"""A TCP server that serves one client, and can be unplugged."""

import asyncio
import contextlib
import os
import socket
from collections.abc import Callable
from pathlib import Path

from gigabrain_zenoh.clock import Clock

READ_BYTES = 4096
HOST = "127.0.0.1"  # an emulated body is nobody else's to drive
SILENT_NS = 1_000_000_000  # a client that says nothing for so long makes way for another


class TcpPort:
    """The device's end. `path` says where it is: a file that holds HOST:PORT.

    The usual `port` where it is free, and any other where it is not.
    """

    def __init__(self, path: Path, port: int) -> None:
        self.path = path
        self.on_bytes: Callable[[bytes], None] = lambda data: None
        self.refused = 0  # clients who came while another was there
        self._usual, self._clock = port, Clock()
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self._heard_ns = 0

    @property
    def address(self) -> tuple[str, int] | None:
        """(host, port) where it listens, or None while it is unplugged."""
        if self._server is None:
            return None
        host, port = self._server.getsockname()
        return host, port

    def plug(self) -> None:
        """Listen. Nothing if it does."""
        if self._server is not None:
            return
        self._server = _listening(self._usual)
        asyncio.get_running_loop().add_reader(self._server, self._accept)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.write_text("{}:{}\n".format(*self._server.getsockname()), encoding="ascii")
        os.replace(fresh, self.path)

    def unplug(self) -> None:
        """Drop the client and listen no more. Nothing if it is unplugged."""
        self._drop()
        server, self._server = self._server, None
        if server:
            asyncio.get_running_loop().remove_reader(server)
            server.close()
            self.path.unlink(missing_ok=True)

    def write(self, data: bytes) -> bool:
        """To the client; False when there is none. One who does not read is dropped."""
        if self._client is None:
            return False
        sent = 0
        with contextlib.suppress(BlockingIOError, OSError):
            sent = self._client.send(data)
        if sent < len(data):
            self._drop()
            return False
        return True

    def _accept(self) -> None:
        if self._server is None:
            return
        try:
            client, _ = self._server.accept()
        except OSError:
            return
        now_ns = self._clock.now_ns()
        if self._client and now_ns - self._heard_ns < SILENT_NS:
            self.refused += 1
            client.close()
            return
        self._drop()
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client, self._heard_ns = client, now_ns
        asyncio.get_running_loop().add_reader(client, self._readable)

    def _readable(self) -> None:
        if self._client is None:
            return
        try:
            data = self._client.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop()
            return
        self._heard_ns = self._clock.now_ns()
        self.on_bytes(data)

    def _drop(self) -> None:
        client, self._client = self._client, None
        if client:
            asyncio.get_running_loop().remove_reader(client)
            client.close()


def _listening(port: int) -> socket.socket:
    """A server on `port`, or on any free one."""
    server = socket.socket()
    try:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            server.bind((HOST, port))
        except OSError:
            server.bind((HOST, 0))
        server.listen(4)
        server.setblocking(False)
    except BaseException:
        server.close()
        raise
    return server
