"""Programs of the host that missions may run: those of one folder, and no others."""

import asyncio
import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

from gigabrain_zenoh.decision.tasks.mission import Script
from gigabrain_zenoh.errors import ConfigError, GigabrainError, Refused, unknown

LAST = 200  # bytes of what it wrote that are told
LINGER_S = 1.0  # for the rest of its words, once it has ended
# becomes a program; ends all of its group, itself included, once nobody holds its input open
LEASHED = """exec 3<&0 </dev/null
{ read -r _ <&3; kill -s KILL 0; } >/dev/null 2>&1 &
exec "$@" 3<&-"""


def check_folder(folder: str) -> None:
    """Whether the folder that `scripts` names is there, where it names one. Raises ConfigError."""
    if folder and not Path(folder).expanduser().is_dir():
        raise ConfigError(
            f"no folder {folder!r}; scripts: expected that of the programs that missions may run"
        )


class Scripts:
    """Starts what the deployment file allows."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder).expanduser() if folder else None

    def path(self, name: str) -> Path:
        """Where a program is. Raises Refused, which says what to change, and UnknownName."""
        if self._folder is None:
            raise Refused(
                f"script {name!r}: this robot runs no scripts; name their folder in its "
                "deployment file, as in decision: {settings: {scripts: /home/robot/scripts}}"
            )
        there = sorted(p.name for p in self._folder.glob("*") if p.is_file())
        if name not in there:
            raise unknown("script", name, there or ("none",))
        path = self._folder / name
        if not os.access(path, os.X_OK):
            raise Refused(f"script {name!r} is not executable; chmod +x {path}")
        return path

    def start(self, script: Script) -> "Run":
        """Run a program. What keeps it from running is its result."""
        return Run(self, script)


class Run:
    """One program while it runs, in a process group of its own."""

    def __init__(self, scripts: Scripts, script: Script) -> None:
        self.result: tuple[bool, str] | None = None
        self._task = asyncio.ensure_future(self._run(scripts, script))

    def stop(self) -> None:
        """End it, and whatever it has started."""
        self._task.cancel()

    async def _run(self, scripts: Scripts, script: Script) -> None:
        try:
            path = scripts.path(script.run)
            with _leash() as end:
                program, words = await asyncio.get_running_loop().subprocess_exec(
                    _Words, "/bin/sh", "-c", LEASHED, "sh", path, *script.arguments,
                    cwd=path.parent, start_new_session=True, stdin=end,
                    stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
                )  # fmt: skip
                with contextlib.closing(program):
                    self.result = await _outcome(program, words, script.seconds)
        except (GigabrainError, OSError, ValueError) as error:
            self.result = False, f"cannot be run: {error}"


@contextlib.contextmanager
def _leash() -> Iterator[int]:
    """What can be read, and is at its end once this process is, even with SIGKILL."""
    end, ours = os.pipe()
    try:
        yield end
    finally:
        os.close(end)
        os.close(ours)


class _Words(asyncio.SubprocessProtocol):
    """The end of what a program writes, and whether more may come."""

    def __init__(self) -> None:
        self.ended, self.silent = asyncio.Event(), asyncio.Event()
        self._said = bytearray()

    def __str__(self) -> str:
        return " ".join(self._said.decode(errors="replace").split())

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        """It writes."""
        self._said += data
        del self._said[:-LAST]

    def pipe_connection_lost(self, fd: int, exc: Exception | None) -> None:
        """Nobody holds its output any more."""
        self.silent.set()

    def process_exited(self) -> None:
        """It has ended; others may write on."""
        self.ended.set()


async def _outcome(
    program: asyncio.SubprocessTransport, words: _Words, seconds: float
) -> tuple[bool, str]:
    """Whether a program ended well, and what it said; nothing of its group is left then."""
    try:
        async with asyncio.timeout(seconds):
            await words.ended.wait()
    except TimeoutError:
        return False, f"did not end within {seconds:g} s; killed"
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(program.get_pid(), signal.SIGKILL)
        await words.ended.wait()
        with contextlib.suppress(TimeoutError):  # who has left the group may hold its output on
            await asyncio.wait_for(words.silent.wait(), LINGER_S)
    code = program.get_returncode()
    return code == 0, _in_words(code, str(words))


def _in_words(code: int | None, said: str) -> str:
    ended = "ended well" if code == 0 else f"ended with exit code {code}"
    return f"{ended}: {said}" if said else ended
