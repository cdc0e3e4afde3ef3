"""A robot as people start it: `gigabrain` commands as processes, and their ends."""

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import msgspec

from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.qa.faults.waiting import PATIENCE_S as PATIENCE_S
from gigabrain_zenoh.qa.faults.waiting import until as until
from gigabrain_zenoh.runtime.running import Running

ROOT = Path(__file__).parent.parent
SOURCES = (ROOT, ROOT / "drivers", ROOT / "schemas")
AVOID = ("demo", "--behaviour", "avoid")  # the quickest demo to start
GIGABRAIN = (sys.executable, "-P", "-c", "from gigabrain_zenoh.cli.app import main; main()")


def free_port() -> int:
    """A TCP port of the loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listens(port: int) -> bool:
    """Whether somebody takes connections there; a process is heard before it does."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


class Command:
    """One `gigabrain` command in a process of its own, its output in files."""

    def __init__(
        self,
        out: Path,
        environment: dict[str, str],
        arguments: tuple[str, ...],
        stdout: int | None = None,
        inside: tuple[str, ...] = (),
    ) -> None:
        self._paths = out.with_suffix(".out"), out.with_suffix(".err")
        self._files: tuple[IO[bytes], ...] = tuple(path.open("wb") for path in self._paths)
        self._process = subprocess.Popen(
            (*inside, *GIGABRAIN, *arguments),
            stdin=subprocess.DEVNULL,
            stdout=self._files[0] if stdout is None else stdout,
            stderr=self._files[1],
            env=environment,
            start_new_session=True,
        )
        self.pid = self._process.pid

    @property
    def out(self) -> str:
        """What it has printed so far."""
        return self._paths[0].read_text()

    @property
    def err(self) -> str:
        """What it has complained of so far."""
        return self._paths[1].read_text()

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    def send(self, number: signal.Signals) -> None:
        """Send it a signal; Ctrl-C is SIGINT."""
        self._process.send_signal(number)

    async def ended(self, within_s: float = PATIENCE_S) -> int:
        """Wait for its end; the exit code."""
        await until(lambda: not self.running, f"the end of {self._process.args!r}", within_s)
        return int(self._process.returncode)

    def close(self) -> None:
        """End it, politely at first."""
        if self.running:
            self._process.terminate()
            try:
                self._process.wait(5.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.wait(5.0)
        for file in self._files:
            file.close()


class Home:
    """A user's own folders, what is started with them, and what is left of it.

    `inside` is a command that runs another one somewhere else, such as in a namespace.
    """

    def __init__(self, folder: Path, inside: tuple[str, ...] = ()) -> None:
        self.folder, self._inside = folder, inside
        folder.mkdir(exist_ok=True)
        self._commands: list[Command] = []
        self._numbers = itertools.count(1)

    @property
    def environment(self) -> dict[str, str]:
        """What a process needs in order to live in this home."""
        return os.environ | {
            "PYTHONPATH": os.pathsep.join(str(path) for path in SOURCES),
            "XDG_STATE_HOME": str(self.folder / "state"),
            "XDG_RUNTIME_DIR": str(self.folder / "run"),
            "NO_COLOR": "1",
            "COLUMNS": "100",
        }

    def start(self, *arguments: str, stdout: int | None = None) -> Command:
        """Start a `gigabrain` command; what it prints goes to `stdout`, or into `Command.out`."""
        out = self.folder / f"command-{next(self._numbers)}"
        self._commands.append(Command(out, self.environment, arguments, stdout, self._inside))
        return self._commands[-1]

    async def run(self, *arguments: str) -> Command:
        """Start a `gigabrain` command and wait for its end."""
        command = self.start(*arguments)
        await command.ended()
        return command

    def deployment(self, **values: object) -> Path:
        """Write a deployment file; the router gets a free port unless `values` names one."""
        path = self.folder / f"deployment-{next(self._numbers)}.yaml"
        router = f"tcp/127.0.0.1:{free_port()}"
        path.write_bytes(msgspec.json.encode({"router": router} | values))  # YAML as well
        return path

    def processes(self, name: str = "") -> list[int]:
        """The pids of all supervised processes that live here, or of those of this name."""
        mine = f'"run_dir":"{self.folder}', f'"name":"{name}"' if name else ""
        return [pid for pid, told in _processes() if all(part in told for part in mine)]

    def close(self) -> None:
        """End whatever is still there."""
        for command in self._commands:
            command.close()
        for pid in self.processes():
            os.kill(pid, signal.SIGKILL)


def _processes() -> Iterator[tuple[int, str]]:
    """Every process of this machine that has not ended, and its arguments."""
    if Path("/proc/self/cmdline").exists():
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):  # it has just ended
                yield int(folder.name), (folder / "cmdline").read_text(errors="replace")
        return
    told = subprocess.run(("ps", "-ww", "-A", "-o", "pid=,args="), capture_output=True, text=True)
    for line in told.stdout.splitlines():
        pid, _, arguments = line.strip().partition(" ")
        yield int(pid), arguments


def endpoint_of(deployment: Path) -> Endpoint:
    """Where to meet the robot of a deployment file that `Home.deployment` wrote."""
    values = msgspec.json.decode(deployment.read_bytes())
    return Endpoint(connect=(values["router"],), namespace=values.get("namespace", ""))


async def robot_of(home: Home, command: Command) -> Endpoint:
    """Where to meet the robot that a command has just started."""
    note = home.folder / "run" / "gigabrain" / f"{command.pid}.json"
    await until(note.exists, "the robot is announced")
    return msgspec.json.decode(note.read_bytes(), type=Running).endpoint
