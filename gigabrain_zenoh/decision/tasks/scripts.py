"""Runs programs of the host for missions, from one folder only."""

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import cast

from gigabrain_zenoh.decision.tasks.mission import Script
from gigabrain_zenoh.errors import GigabrainError, Refused, unknown
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.files import expanded, file_problem

log = logging.getLogger(__name__)

MAX_OUTPUT = 200  # last bytes of a program's output, shown in its result
LINGER_S = 1.0  # wait for the rest of the output after a program ended
# becomes the program after reading a line; ends if its input is closed before that
LEASHED = 'read -r _ && exec "$@" </dev/null'
# kills a process group, also a stopped one, when its own input is closed
LEASH = 'read -r _; kill -s KILL -- "-$1"'


class Scripts:
    """Starts programs from the folder that the deployment file allows."""

    def __init__(self, folder: str) -> None:
        self._folder = expanded(folder).absolute() if folder else None

    def path(self, name: str) -> Path:
        """Return the path of a program. Raises Refused and UnknownName."""
        if self._folder is None:
            raise Refused(
                f"script {name!r}: this robot runs no scripts; name their folder in its "
                "deployment file, as in decision: {settings: {scripts: /home/robot/scripts}}"
            )
        try:
            known = sorted(p.name for p in self._folder.glob("*") if p.is_file())
        except OSError as error:
            text = f"script {name!r}: {self._folder} cannot be read: {error.strerror}"
            raise Refused(text) from None
        if name not in known:
            raise unknown("script", name, known or ("none",))
        path = self._folder / name
        if not os.access(path, os.X_OK):
            raise Refused(f"script {name!r} is not executable; chmod +x {path}")
        return path

    def start(self, script: Script) -> "Run":
        """Start a program; if it cannot be started, its result says so."""
        return Run(self, script)


class Run:
    """One running program, in its own process group."""

    def __init__(self, scripts: Scripts, script: Script) -> None:
        self.result: tuple[bool, str] | None = None  # success, and a text for users
        self._program: asyncio.SubprocessTransport | None = None
        self._limit: asyncio.Timeout | None = None  # time limit, while it runs
        self._left_s = script.seconds
        self._resumed = asyncio.Event()
        self._resumed.set()
        self._task = asyncio.ensure_future(self._run(scripts, script))

    def stop(self) -> None:
        """Kill the program and all its processes."""
        self._task.cancel()

    def pause(self) -> None:
        """Stop the program and all its processes until `resume`, and so its time limit."""
        self._resumed.clear()
        if self._limit and not self._limit.expired() and (end_s := self._limit.when()):
            self._left_s = end_s - asyncio.get_running_loop().time()
            self._limit.reschedule(None)
            self._signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Continue the program if it is paused."""
        self._resumed.set()
        if self._limit and self._limit.when() is None:
            self._limit.reschedule(asyncio.get_running_loop().time() + self._left_s)
            self._signal(signal.SIGCONT)

    async def _run(self, scripts: Scripts, script: Script) -> None:
        try:
            path = scripts.path(script.run)
            program, output = await asyncio.get_running_loop().subprocess_exec(
                _Output, "/bin/sh", "-c", LEASHED, "sh", path, *script.arguments,
                cwd=path.parent, start_new_session=True,
                env=this_process.environment_for_others(),
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.STDOUT,
            )  # fmt: skip
            self._program = program
            with contextlib.closing(program):
                async with _leash(program.get_pid()):
                    result = await self._outcome(program, output, script.seconds)
            self.result = result
        except OSError as error:
            self.result = False, f"cannot be run: {file_problem(error)}"
        except (GigabrainError, ValueError) as error:
            self.result = False, f"cannot be run: {error}"

    async def _outcome(
        self, program: asyncio.SubprocessTransport, output: "_Output", seconds: float
    ) -> tuple[bool, str]:
        """Let a program begin, wait for its end, kill its process group, and return its result."""
        try:
            await self._resumed.wait()
            cast("asyncio.WriteTransport", program.get_pipe_transport(0)).write(b"\n")
            async with asyncio.timeout(seconds) as self._limit:
                await output.ended.wait()
        except TimeoutError:
            return False, f"did not end within {seconds:g} s; killed"
        finally:
            self._limit = None
            self._signal(signal.SIGKILL)
            await output.ended.wait()
            with contextlib.suppress(
                TimeoutError
            ):  # a process outside the group may keep the output open
                await asyncio.wait_for(output.silent.wait(), LINGER_S)
        code = program.get_returncode()
        return code == 0, _describe_end(code, str(output))

    def _signal(self, number: signal.Signals) -> None:
        assert self._program
        try:
            os.killpg(self._program.get_pid(), number)
        except ProcessLookupError:
            pass
        except PermissionError as error:  # it runs as another user, for example by sudo
            log.warning("a script cannot be sent %s: %s", number.name, error)


StartScript = Callable[[Script], Run]


class RunningScripts:
    """The programs of all missions; all are paused except that of the active step."""

    def __init__(self, start: StartScript) -> None:
        self._start, self._running, self._active = start, set[Run](), set[Run]()

    def start(self, script: Script) -> Run:
        """Start a program."""
        run = self._start(script)
        self._running.add(run)
        return run

    def keep_running(self, run: Run) -> None:
        """Let a program run until the next `settle`."""
        self._active.add(run)

    def stop(self, run: Run) -> None:
        """Kill a program."""
        self._running.discard(run)
        run.stop()

    def settle(self) -> None:
        """Pause all programs except those passed to `keep_running`; called after each step."""
        for run in self._running:
            run.resume() if run in self._active else run.pause()
        self._active.clear()


@contextlib.asynccontextmanager
async def _leash(group: int) -> AsyncIterator[None]:
    """Ensure that a process group is killed if this process ends in the block, even by SIGKILL."""
    leash, output = await asyncio.get_running_loop().subprocess_exec(
        _Output, "/bin/sh", "-c", LEASH, "sh", str(group),
        start_new_session=True, stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    with contextlib.closing(leash):
        try:
            yield
        finally:
            leash.kill()
            await output.ended.wait()


class _Output(asyncio.SubprocessProtocol):
    """Collects the end of a program's output."""

    def __init__(self) -> None:
        self.ended, self.silent = asyncio.Event(), asyncio.Event()
        self._text = bytearray()

    def __str__(self) -> str:
        return " ".join(self._text.decode(errors="replace").split())

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        self._text += data
        del self._text[:-MAX_OUTPUT]

    def pipe_connection_lost(self, fd: int, exc: Exception | None) -> None:
        if fd == 1:
            self.silent.set()

    def process_exited(self) -> None:
        self.ended.set()


def _describe_end(code: int | None, output: str) -> str:
    ended = "ended well" if code == 0 else f"ended with exit code {code}"
    return f"{ended}: {output}" if output else ended
