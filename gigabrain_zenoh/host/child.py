"""One child process: a group of its own, its output as records, its end."""

import asyncio
import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import msgspec

_LONGEST_LINE = 256 * 1024  # bytes; a longer line comes in pieces
_DRAIN_S = 0.2  # what a dead child has written arrives at once; someone else may hold its pipe


class Lines:
    """Cuts a stream of bytes into lines of any length."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that `data` completes, without their newlines; empty ones are left out."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LONGEST_LINE:
            lines.append(self.end())
        return [line for line in lines if line.strip()]

    def end(self) -> bytes:
        """What came after the last newline."""
        rest, self._rest = self._rest, b""
        return rest


def as_record(line: bytes, process: str) -> dict[str, Any]:
    """The log record in a line of output; what is no log record is itself the text of one."""
    known = {"t": time.time_ns(), "level": "info", "process": process, "event": "output"}
    with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        said = msgspec.json.decode(line)
        if isinstance(said, dict) and isinstance(said.get("event"), str):
            fit = {k: v for k, v in said.items() if type(v) is type(known.get(k, v))}
            return known | fit
    return known | {"level": "error", "text": line.decode(errors="replace").rstrip()}


class Child(asyncio.SubprocessProtocol):
    """A running process. Its pipes are always drained, whatever comes out of them."""

    def __init__(self, name: str, on_record: Callable[[dict[str, Any]], None]) -> None:
        self._name, self._on_record = name, on_record
        self._lines = {1: Lines(), 2: Lines()}
        self._ended, self._drained = asyncio.Event(), asyncio.Event()
        self._transport: asyncio.SubprocessTransport | None = None
        self.pid = 0

    @classmethod
    async def start(
        cls,
        name: str,
        argv: Sequence[str],
        env: Mapping[str, str],
        on_record: Callable[[dict[str, Any]], None],
    ) -> "Child":
        """Start a process; raises OSError when that cannot be done."""
        _, child = await asyncio.get_running_loop().subprocess_exec(
            lambda: cls(name, on_record),
            *argv,
            stdin=subprocess.DEVNULL,
            env=dict(env),
            start_new_session=True,  # a terminal's Ctrl-C is for the supervisor alone
        )
        return child

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The process runs and its pipes are joined (asyncio calls this)."""
        self._transport = cast(asyncio.SubprocessTransport, transport)
        self.pid = self._transport.get_pid()

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        """Output has come (asyncio calls this)."""
        for line in self._lines[fd].feed(data):
            self._on_record(as_record(line, self._name))

    def pipe_connection_lost(self, fd: int, exc: Exception | None) -> None:
        """There will be no more output on `fd` (asyncio calls this)."""
        if rest := self._lines.pop(fd).end():
            self._on_record(as_record(rest, self._name))
        if not self._lines:
            self._drained.set()

    def process_exited(self) -> None:
        """The process has ended and is reaped (asyncio calls this)."""
        self._signal_group(signal.SIGKILL)  # whatever it has started goes with it
        self._ended.set()

    def send_signal(self, number: int) -> None:
        """Send a signal to the process and all that it has started; nothing if it has ended."""
        if not self._ended.is_set():
            self._signal_group(number)

    def _signal_group(self, number: int) -> None:
        # macOS answers EPERM where Linux answers ESRCH for a group that is gone
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, number)

    async def wait(self) -> int:
        """Wait for its end and its last words; the exit code, or minus the signal's number."""
        await self._ended.wait()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_DRAIN_S):
                await self._drained.wait()
        transport = cast(asyncio.SubprocessTransport, self._transport)
        transport.close()
        return cast(int, transport.get_returncode())

    def abandon(self) -> None:
        """Kill it without waiting for its end; for a loop that is being torn down."""
        self.send_signal(signal.SIGKILL)
        if self._transport:
            self._transport.close()
