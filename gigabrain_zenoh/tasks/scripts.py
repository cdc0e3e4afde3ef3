"""Programs of the host that missions may run: those of one folder, and no others."""

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError, GigabrainError, Refused, unknown
from gigabrain_zenoh.tasks.mission import Script

LAST = 200  # characters of what it wrote that are told
# ends a process group, whose number it reads, once nobody holds the other end of its input
LEASH = 'read -r group; read -r _; kill -s KILL -- "-$group"'


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
                f"script {name!r}: this robot runs none; name their folder in its deployment "
                "file, as in decision: {scripts: /home/robot/scripts}"
            )
        there = sorted(p.name for p in self._folder.glob("*") if p.is_file())
        if name not in there:
            raise unknown("script", name, there or ("none",))
        path = self._folder / name
        if not os.access(path, os.X_OK):
            raise Refused(f"script {name!r} may not be run; chmod +x {path}")
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
            async with _leash() as hold:
                process = await asyncio.create_subprocess_exec(
                    path, *script.arguments, cwd=path.parent, start_new_session=True,
                    stdin=asyncio.subprocess.DEVNULL,
                    stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
                )  # fmt: skip
                hold(process.pid)
                self.result = await _outcome(process, script.seconds)
        except (GigabrainError, OSError, ValueError) as error:
            self.result = False, f"cannot be run: {error}"


@contextlib.asynccontextmanager
async def _leash() -> AsyncIterator[Callable[[int], object]]:
    """Have a process group, once it is told, end with this process, even with SIGKILL."""
    end, ours = os.pipe()
    try:
        guard = await asyncio.create_subprocess_exec(
            "/bin/sh", "-c", LEASH, start_new_session=True, stdin=end,
            stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        try:
            yield lambda group: os.write(ours, f"{group}\n".encode())
        finally:
            guard.kill()
            await asyncio.shield(guard.wait())
    finally:
        os.close(end)
        os.close(ours)


async def _outcome(process: asyncio.subprocess.Process, seconds: float) -> tuple[bool, str]:
    """Whether a program ended well, and what it said; nothing of it is left then."""
    try:
        async with asyncio.timeout(seconds):
            said = await _last_words(process)
            code = await process.wait()
        return code == 0, _in_words(code, said)
    except TimeoutError:
        return False, f"did not end within {seconds:g} s and was ended"
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        await asyncio.shield(process.communicate())


async def _last_words(process: asyncio.subprocess.Process) -> str:
    """The end of what a program writes, once it has ended."""
    assert process.stdout
    said = b""
    while chunk := await process.stdout.read(4096):
        said = (said + chunk)[-LAST:]
    return " ".join(said.decode(errors="replace").split())


def _in_words(code: int, said: str) -> str:
    ended = "ended well" if code == 0 else f"ended with exit code {code}"
    return f"{ended}: {said}" if said else ended
