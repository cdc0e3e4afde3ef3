"""The supervisor's side of fork servers, and the processes that they have forked (Linux)."""

import asyncio
import contextlib
import ctypes
import functools
import itertools
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from gigabrain_zenoh.runtime.child import REAP_S, Child, supervised_environment
from gigabrain_zenoh.runtime.fork_server import MAX_REQUEST_BYTES, ForkRequest

COMMAND = (sys.executable, "-P", "-m", "gigabrain_zenoh.runtime.fork_server")
IMPORT_TIMEOUT_S = 15.0  # for the imports of a fork server
FORK_TIMEOUT_S = 5.0  # for the pid of a fork
STOPPED_CHECK_S = 0.5  # pause between checks that a signal has not stopped a fork server
PR_SET_CHILD_SUBREAPER = 36  # prctl(2)
FAILED = "the fork server {}; processes start without it, with more memory"


def works_here() -> bool:
    """Return whether this system has what fork servers need."""
    return sys.platform == "linux" and hasattr(os, "pidfd_open")


Server = tuple[subprocess.Popen[bytes], socket.socket]
_early: list[Server] = []


def start_early(*modules: str) -> None:
    """Start a fork server that the next supervisor takes over, and have it import `modules`.

    It imports while this process reads its configuration.
    """
    if works_here():
        with contextlib.suppress(OSError):  # the supervisor tries again, and reports it
            _early.append(_start(modules))


def end_early() -> None:
    """End the server of `start_early` if it is not needed."""
    while _early:
        server, connection = _early.pop()
        connection.close()
        _end(server)


def _start(modules: Sequence[str] = ()) -> Server:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs, contextlib.ExitStack() as closing:
        closing.callback(ours.close)
        server = subprocess.Popen(
            (*COMMAND, str(theirs.fileno()), *modules),
            stdin=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
            env=supervised_environment(),
            start_new_session=True,
        )
        closing.pop_all()
    return server, ours


def _end(server: subprocess.Popen[bytes]) -> None:
    server.kill()
    with contextlib.suppress(subprocess.TimeoutExpired):
        server.wait(REAP_S)


class ForkServers:
    """Fork each process of a supervisor once. Then the servers end, to free their memory.

    When one server fails, all of them end.
    """

    def __init__(self, forks: Mapping[str, ForkRequest], on_failure: Callable[[str], None]) -> None:
        """Take all requests by process; call `on_failure` with the reason if a server fails."""
        self._missing = {*forks}
        levels = itertools.zip_longest(*(fork.imports for fork in forks.values()), fillvalue=())
        self._levels = [tuple(dict.fromkeys(itertools.chain(*level))) for level in levels]
        self._on_failure = on_failure
        self._first: subprocess.Popen[bytes] | None = None
        self._connections: list[socket.socket] = []
        self._imported: list[asyncio.Task[int]] = []  # pids of the servers, by level

    def open(self) -> None:
        """Start the servers, in a running event loop."""
        try:
            self._open()
        except OSError as error:
            self._fail(f"cannot be started ({error})")

    def _open(self) -> None:
        self._first, first = _early.pop() if _early else _start()
        self._connections = [first]
        with contextlib.ExitStack() as closing:
            ends = []
            for _ in self._levels[1:]:
                ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                self._connections.append(ours)
                ends.append(closing.enter_context(theirs).fileno())
            socket.send_fds(first, [msgspec.json.encode(self._levels)], ends)
        self._imported = [
            asyncio.create_task(self._receive_pid(connection, IMPORT_TIMEOUT_S))
            for connection in self._connections
        ]

    def close(self) -> None:
        """End the servers. The forked processes continue."""
        if self._first:
            _end(self._first)  # the others die with it
        for task in self._imported:
            if not task.cancel() and not task.cancelled():
                task.exception()  # retrieved, so that asyncio does not log it
        for connection in self._connections:
            connection.close()
        self._first, self._connections, self._imported = None, [], []

    async def imported(self, request: ForkRequest) -> None:
        """Wait until the server for `request` has imported, or has failed."""
        if self._imported:
            await asyncio.wait([self._imported[len(request.imports) - 1]])

    async def start(
        self, name: str, request: ForkRequest, on_record: Callable[[dict[str, Any]], None]
    ) -> Child | None:
        """Start a process; return None if the servers have ended."""
        data = msgspec.json.encode(request)
        if not self._connections or len(data) > MAX_REQUEST_BYTES:
            return None
        level = len(request.imports) - 1
        connection = self._connections[level]
        with contextlib.ExitStack() as closing:
            out, err, go = (_pipe(closing) for _ in range(3))
            try:
                with _adoption:
                    await self._imported[level]
                    socket.send_fds(connection, [data], [out[1], err[1], go[0]])
                    child = ForkedChild(
                        name, on_record, await self._receive_pid(connection, FORK_TIMEOUT_S)
                    )
            except (OSError, TimeoutError) as error:
                self._fail(str(error) or "does not answer")
                return None
            await child.attend(os.dup(out[0]), os.dup(err[0]))
            os.write(go[1], b"1")
        self._missing.discard(name)
        if not self._missing:
            self.close()
        return child

    def _fail(self, why: str) -> None:
        self.close()
        self._on_failure(FAILED.format(why))

    async def _receive_pid(self, connection: socket.socket, within_s: float) -> int:
        """Return the pid of a server, or of a fork. Raises TimeoutError and ConnectionError."""
        loop, answered = asyncio.get_running_loop(), asyncio.Event()
        deadline_s = loop.time() + within_s
        loop.add_reader(connection, answered.set)
        try:
            while True:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(STOPPED_CHECK_S):
                        await answered.wait()
                if answered.is_set():
                    break
                if self._any_stopped() or loop.time() > deadline_s:
                    raise TimeoutError
        finally:
            loop.remove_reader(connection)
        pid = b""
        with contextlib.suppress(ConnectionResetError):  # it ended before it read the whole request
            pid = connection.recv(64)
        if not pid:
            raise ConnectionError("has ended")
        return int(pid)

    def _any_stopped(self) -> bool:
        """Return whether a signal has stopped a server."""
        import psutil  # takes 20 ms; most answers arrive before the first check

        assert self._first
        try:
            first = psutil.Process(self._first.pid)
            states = [server.status() for server in (first, *first.children())]
        except psutil.Error:  # a server ended; its connection reports that
            return False
        return psutil.STATUS_STOPPED in states


class ForkedChild(Child):
    """A process that a fork server forked, and that this process adopted as its child."""

    def __init__(self, name: str, on_record: Callable[[dict[str, Any]], None], pid: int) -> None:
        """Take the pid of a child. Raises OSError if it has ended."""
        super().__init__(name, on_record)
        self.pid, self._code = pid, 0
        self._pidfd = os.pidfd_open(pid)
        self._pipes: list[asyncio.ReadTransport] = []

    async def attend(self, out: int, err: int) -> None:
        """Read its output from these pipe ends, and reap it when it ends."""
        loop = asyncio.get_running_loop()
        for number, end in enumerate((out, err), 1):
            pipe, _ = await loop.connect_read_pipe(
                functools.partial(_Output, self, number), os.fdopen(end, "rb", 0)
            )
            self._pipes.append(pipe)
        loop.add_reader(self._pidfd, self._reap)

    def _reap(self) -> None:
        asyncio.get_running_loop().remove_reader(self._pidfd)
        self._wait()
        self.process_exited()

    def _wait(self) -> None:
        ended = os.waitid(os.P_PIDFD, self._pidfd, os.WEXITED | os.WNOHANG)
        os.close(self._pidfd)
        if ended:
            exited = ended.si_code == os.CLD_EXITED
            self._code = ended.si_status if exited else -ended.si_status

    def _close(self) -> int:
        for pipe in self._pipes:
            pipe.close()
        return self._code

    def abandon(self) -> None:
        """Kill and reap it without the event loop, which is being torn down."""
        if not self._ended.is_set():
            self.send_signal(signal.SIGKILL)
            select.select([self._pidfd], [], [], REAP_S)
            self._reap()
        self._close()


class _Output(asyncio.Protocol):
    """The output of a child on one of its pipes."""

    def __init__(self, child: Child, number: int) -> None:
        self._child, self._number = child, number

    def data_received(self, data: bytes) -> None:
        self._child.pipe_data_received(self._number, data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._child.pipe_connection_lost(self._number, exc)


def _pipe(closing: contextlib.ExitStack) -> tuple[int, int]:
    """Return the read end and the write end of a pipe; `closing` closes both."""
    ends = os.pipe()
    for end in ends:
        closing.callback(os.close, end)
    return ends


class _Adoption:
    """While it is entered, this process adopts descendants whose parent ends.

    Several supervisors in one process may enter it at the same time.
    """

    def __init__(self) -> None:
        self._entered = 0

    def __enter__(self) -> None:
        self._entered += 1
        self._set()

    def __exit__(self, *_: object) -> None:
        self._entered -= 1
        self._set()

    def _set(self) -> None:
        zero = ctypes.c_ulong(0)
        adopts = ctypes.c_ulong(int(self._entered > 0))
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, adopts, zero, zero, zero)


_adoption = _Adoption()
