"""Programs of the host that missions may run: those of one folder, and no others."""

import asyncio
import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError, GigabrainError, Refused, unknown
from gigabrain_zenoh.tasks.mission import Script

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
            with _leash() as end:
                process = await asyncio.create_subprocess_exec(
                    "/bin/sh", "-c", LEASHED, "sh", path, *script.arguments,
                    cwd=path.parent, start_new_session=True, stdin=end,
                    stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
                )  # fmt: skip
                self.result = await _outcome(process, script.seconds)
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


async def _outcome(process: asyncio.subprocess.Process, seconds: float) -> tuple[bool, str]:
    """Whether a program ended well, and what it said; nothing of its group is left then."""
    said = bytearray()
    listening = asyncio.ensure_future(_listen(process, said))
    try:
        async with asyncio.timeout(seconds):
            code = await process.wait()
    except TimeoutError:
        return False, f"did not end within {seconds:g} s and was ended"
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        # whoever has left the group may hold its output open for ever
        await asyncio.wait([listening, asyncio.ensure_future(process.wait())], timeout=LINGER_S)
        listening.cancel()
    return code == 0, _in_words(code, " ".join(said.decode(errors="replace").split()))


async def _listen(process: asyncio.subprocess.Process, said: bytearray) -> None:
    """Keep the end of what a program writes."""
    assert process.stdout
    while chunk := await process.stdout.read(4096):
        said += chunk
        del said[:-LAST]


def _in_words(code: int, said: str) -> str:
    ended = "ended well" if code == 0 else f"ended with exit code {code}"
    return f"{ended}: {said}" if said else ended
