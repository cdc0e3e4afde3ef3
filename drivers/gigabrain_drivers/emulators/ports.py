"""Serial ports and TCP servers for emulated bodies. They can be unplugged."""

import asyncio
import contextlib
import errno
import os
import socket
from collections.abc import Callable
from pathlib import Path

from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.host.posix import tty

BITS_PER_BYTE = 10  # 8N1: start, eight, stop
READ_BYTES = 4096
HOST = "127.0.0.1"  # an emulated body is for this machine only
CLIENT_TIMEOUT_NS = 1_000_000_000  # another client may replace one that is silent for longer


class Pty:
    """The device's end of a pty, as slow as a line of `baud`; None for no delay."""

    def __init__(self, path: Path, baud: int | None = None) -> None:
        self.path = path  # that the host opens
        self.on_bytes: Callable[[bytes], None] = lambda data: None
        self.lost_bytes = 0  # not read by the host in time; a UART loses them too
        self._byte_s = BITS_PER_BYTE / baud if baud else 0.0
        self._out_free = self._in_free = 0.0  # when the wire is free again [loop time]
        self._plug_count = 0  # bytes that were on the wire at an earlier count are lost
        self._master: int | None = None
        self._slave: int | None = None

    @property
    def plugged(self) -> bool:
        """True while the port exists."""
        return self._master is not None

    def plug(self) -> None:
        """Create the port, with empty buffers. Does nothing if it exists."""
        if self._master is not None:
            return
        self._plug_count += 1
        self._master, self._slave = os.openpty()  # the slave stays open: no EIO between clients
        for end in (self._master, self._slave):
            tty.setraw(end)
        os.set_blocking(self._master, False)
        asyncio.get_running_loop().add_reader(self._master, self._readable)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists() and not self.path.is_symlink():
            raise OSError(
                errno.EEXIST, f"{self.path.name} exists and does not belong to an emulator"
            )
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(_path_of_terminal(self._slave))
        os.replace(fresh, self.path)

    def unplug(self) -> None:
        """Remove the port, even while it is open. Does nothing if it is gone."""
        if self._master is None or self._slave is None:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        if self.path.is_symlink() and os.readlink(self.path) == _path_of_terminal(self._slave):
            self.path.unlink(missing_ok=True)  # not if another process owns it now
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = None
        self._out_free = self._in_free = 0.0

    def write(self, data: bytes) -> bool:
        """Send to the host. Return False when the port is unplugged."""
        if self._master is None:
            return False
        self._out_free = self._after(self._out_free, self._send, data)
        return True

    def _after(self, free: float, act: Callable[[int, bytes], None], data: bytes) -> float:
        """Call `act` after the time of the bytes on the wire; return when it is free again."""
        if not self._byte_s:
            act(self._plug_count, data)
            return free
        loop = asyncio.get_running_loop()
        free = max(free, loop.time()) + len(data) * self._byte_s
        loop.call_at(free, act, self._plug_count, data)
        return free

    def _send(self, plug_count: int, data: bytes) -> None:
        if plug_count != self._plug_count or self._master is None:  # unplugged meanwhile
            return
        sent = 0
        with contextlib.suppress(BlockingIOError, OSError):
            sent = os.write(self._master, data)
        self.lost_bytes += len(data) - sent

    def _readable(self) -> None:
        if self._master is None:
            return
        try:
            data = os.read(self._master, READ_BYTES)
        except (BlockingIOError, OSError):
            return
        self._in_free = self._after(self._in_free, self._deliver, data)

    def _deliver(self, plug_count: int, data: bytes) -> None:
        if plug_count == self._plug_count and self._master is not None:
            self.on_bytes(data)


def _path_of_terminal(terminal: int) -> str:
    """Return a path of the terminal; on Linux, one that becomes invalid with this process.

    Names of terminals are reused: a driver must not write to another user's shell.
    """
    of_process = f"/proc/{os.getpid()}/fd/{terminal}"  # Linux
    return of_process if os.path.exists(of_process) else os.ttyname(terminal)


class TcpPort:
    """The device's end of a TCP connection; the file `path` holds its HOST:PORT.

    It listens on the usual `port` if that is free, else on any other.
    """

    def __init__(self, path: Path, port: int) -> None:
        self.path = path
        self.on_bytes: Callable[[bytes], None] = lambda data: None
        self.refused = 0  # connections refused because another client was connected
        self._usual, self._clock = port, Clock()
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self._received_ns = 0

    @property
    def address(self) -> tuple[str, int] | None:
        """(host, port) on which it listens, or None while it is unplugged."""
        if self._server is None:
            return None
        host, port = self._server.getsockname()
        return host, port

    def plug(self) -> None:
        """Listen. Does nothing if it already does."""
        if self._server is not None:
            return
        self._server = _listening(self._usual)
        asyncio.get_running_loop().add_reader(self._server, self._accept)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.write_text("{}:{}\n".format(*self._server.getsockname()), encoding="ascii")
        os.replace(fresh, self.path)

    def unplug(self) -> None:
        """Drop the client and stop listening. Does nothing if it is unplugged."""
        self._drop()
        server, self._server = self._server, None
        if server:
            asyncio.get_running_loop().remove_reader(server)
            server.close()
            self.path.unlink(missing_ok=True)

    def write(self, data: bytes) -> bool:
        """Send to the client; return False without one. Drops a client that does not read."""
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
        if self._client and now_ns - self._received_ns < CLIENT_TIMEOUT_NS:
            self.refused += 1
            client.close()
            return
        self._drop()
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client, self._received_ns = client, now_ns
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
        self._received_ns = self._clock.now_ns()
        self.on_bytes(data)

    def _drop(self) -> None:
        client, self._client = self._client, None
        if client:
            asyncio.get_running_loop().remove_reader(client)
            client.close()


def _listening(port: int) -> socket.socket:
    """Return a server on `port`, or on any free port."""
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
