"""A running process: its output as log records, its signals and its end."""

import asyncio
import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import msgspec

from gigabrain_zenoh.errors import without_logins
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.terminal import LineSplitter
from gigabrain_zenoh.logs import is_time, level_named

# The last output of a dead child arrives at once, but another process may keep its pipe open.
_DRAIN_TIMEOUT_S = 0.2
REAP_S = 0.2  # a killed process ends at once, unless the kernel waits for a device


def supervised_environment() -> dict[str, str]:
    """Return the environment of a process that this one starts and supervises."""
    ours = {this_process.SUPERVISOR_VARIABLE: str(os.getpid()), "PYTHONUNBUFFERED": "1"}
    return this_process.environment_for_others() | ours


def as_record(line: bytes, process: str) -> dict[str, Any]:
    """Return the log record in a line of output; other lines become the text of a record.

    Libraries name levels differently, and `gigabrain log` shows only ours. They may also print an
    address with its password.
    """
    known = {"t": time.time_ns(), "level": "info", "process": process, "event": "output"}
    with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        found = msgspec.json.decode(line)
        if isinstance(found, dict) and isinstance(found.get("event"), str):
            valid = {k: v for k, v in found.items() if type(v) is type(known.get(k, v))}
            record = known | valid
            t = record["t"] if is_time(record["t"]) else known["t"]
            return record | {"t": t, "level": level_named(record["level"])}
    text = without_logins(line.decode(errors="replace").rstrip())
    return known | {"level": "error", "text": text}


class Child(asyncio.SubprocessProtocol):
    """A running process. Its pipes are always drained, so that it never waits to write."""

    def __init__(self, name: str, on_record: Callable[[dict[str, Any]], None]) -> None:
        self._name, self._on_record = name, on_record
        self._lines = {1: LineSplitter(), 2: LineSplitter()}
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
        text: str = "",
    ) -> "Child":
        """Start a process with `text` on its standard input. Raises OSError."""
        transport, child = await asyncio.get_running_loop().subprocess_exec(
            lambda: cls(name, on_record),
            *argv,
            stdin=subprocess.PIPE if text else subprocess.DEVNULL,
            env=dict(env),
            start_new_session=True,  # a terminal's Ctrl-C is for the supervisor alone
        )
        if text:
            pipe = cast(asyncio.WriteTransport, transport.get_pipe_transport(0))
            pipe.write(text.encode())
            pipe.close()  # once all is written
        return child

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Note that the process runs and its pipes are open (asyncio calls this)."""
        self._transport = cast(asyncio.SubprocessTransport, transport)
        self.pid = self._transport.get_pid()

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        """Split output into records (asyncio calls this)."""
        for line in self._lines[fd].feed(data):
            self._on_record(as_record(line, self._name))

    def pipe_connection_lost(self, fd: int, exc: Exception | None) -> None:
        """Handle the end of output on `fd` (asyncio calls this)."""
        if fd not in self._lines:  # its standard input
            return
        if rest := self._lines.pop(fd).end():
            self._on_record(as_record(rest, self._name))
        if not self._lines:
            self._drained.set()

    def process_exited(self) -> None:
        """Kill the descendants of the process, once it is reaped (asyncio calls this)."""
        self._signal_group(signal.SIGKILL)
        self._ended.set()

    def send_signal(self, number: int) -> None:
        """Send a signal to the process and its descendants, unless it has ended."""
        if not self._ended.is_set():
            self._signal_group(number)

    def show_stack(self) -> None:
        """Make the process print its stack; see `this_process.show_stack_on_request`."""
        if this_process.STACK_SIGNAL and not self._ended.is_set():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(self.pid, this_process.STACK_SIGNAL)

    def _signal_group(self, number: int) -> None:
        # for a group that has ended, macOS returns EPERM and Linux ESRCH
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, number)

    async def wait(self) -> int:
        """Wait for its end and last output; return the exit code, or minus the signal's number."""
        await self._ended.wait()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_DRAIN_TIMEOUT_S):
                await self._drained.wait()
        return self._close()

    def _close(self) -> int:
        """Close the pipes; return the exit code, or minus the signal's number."""
        transport = cast(asyncio.SubprocessTransport, self._transport)
        transport.close()
        return cast(int, transport.get_returncode())

    def abandon(self) -> None:
        """Kill and reap it without the event loop, which is being torn down."""
        self.send_signal(signal.SIGKILL)
        if self._transport:
            if process := self._transport.get_extra_info("subprocess"):  # uvloop has none
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(REAP_S)
            self._transport.close()
