"""Programs of the host that missions may run, from one folder only."""

import asyncio
import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

from gigabrain_zenoh.decision.tasks.mission import Script
from gigabrain_zenoh.errors import GigabrainError, Refused, unknown
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.files import expanded

MAX_OUTPUT = 200  # bytes of a program's output that its result shows, the last ones
LINGER_S = 1.0  # for the rest of its output, once it has ended
# becomes the program; kills its process group, itself included, once its input is closed
LEASHED = """exec 3<&0 </dev/null
{ read -r _ <&3; kill -s KILL 0; } >/dev/null 2>&1 &
exec "$@" 3<&-"""


class Scripts:
    """Starts programs of the folder that the deployment file allows."""

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
            there = sorted(p.name for p in self._folder.glob("*") if p.is_file())
        except OSError as error:
            text = f"script {name!r}: {self._folder} cannot be read: {error.strerror}"
            raise Refused(text) from None
        if name not in there:
            raise unknown("script", name, there or ("none",))
        path = self._folder / name
        if not os.access(path, os.X_OK):
            raise Refused(f"script {name!r} is not executable; chmod +x {path}")
        return path

    def start(self, script: Script) -> "Run":
        """Start a program; if it cannot be started, its result says so."""
        return Run(self, script)


class Run:
    """One program while it runs, in a process group of its own."""

    def __init__(self, scripts: Scripts, script: Script) -> None:
        self.result: tuple[bool, str] | None = None  # success, and a text for people
        self._task = asyncio.ensure_future(self._run(scripts, script))

    def stop(self) -> None:
        """Kill it and all that it has started."""
        self._task.cancel()

    async def _run(self, scripts: Scripts, script: Script) -> None:
        try:
            path = scripts.path(script.run)
            with _leash() as end:
                program, output = await asyncio.get_running_loop().subprocess_exec(
                    _Output, "/bin/sh", "-c", LEASHED, "sh", path, *script.arguments,
                    cwd=path.parent, start_new_session=True, stdin=end,
                    env=this_process.environment_for_others(),
                    stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
                )  # fmt: skip
                with contextlib.closing(program):
                    self.result = await _outcome(program, output, script.seconds)
        except (GigabrainError, OSError, ValueError) as error:
            self.result = False, f"cannot be run: {error}"


@contextlib.contextmanager
def _leash() -> Iterator[int]:
    """Yield a pipe that closes when this process ends, even by SIGKILL."""
    end, ours = os.pipe()
    try:
        yield end
    finally:
        os.close(end)
        os.close(ours)


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
        self.silent.set()

    def process_exited(self) -> None:
        self.ended.set()


async def _outcome(
    program: asyncio.SubprocessTransport, output: _Output, seconds: float
) -> tuple[bool, str]:
    """Wait for a program's end, kill its process group, and return its success and a text."""
    try:
        async with asyncio.timeout(seconds):
            await output.ended.wait()
    except TimeoutError:
        return False, f"did not end within {seconds:g} s; killed"
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(program.get_pid(), signal.SIGKILL)
        await output.ended.wait()
        with contextlib.suppress(
            TimeoutError
        ):  # a process outside the group may keep the output open
            await asyncio.wait_for(output.silent.wait(), LINGER_S)
    code = program.get_returncode()
    return code == 0, _in_words(code, str(output))


def _in_words(code: int | None, output: str) -> str:
    ended = "ended well" if code == 0 else f"ended with exit code {code}"
    return f"{ended}: {output}" if output else ended
