"""Robots of real processes, started by `gigabrain` commands in folders of their own."""

import asyncio
import contextlib
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import IO

import msgspec
import zenoh

import gigabrain_drivers
import gigabrain_schemas
import gigabrain_zenoh
from gigabrain_zenoh.bus.zenoh.config import session_config
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.runtime.running import Running
from gigabrain_zenoh.testing.waiting import PATIENCE_S, until

PACKAGES = (gigabrain_zenoh, gigabrain_drivers, gigabrain_schemas)
SOURCES = dict.fromkeys(str(Path(str(package.__file__)).parents[1]) for package in PACKAGES)
AVOID = ("demo", "--behaviour", "avoid")  # the quickest demo to start
GIGABRAIN = (sys.executable, "-P", "-c", "from gigabrain_zenoh.cli.app import main; main()")


ROUTER_PROGRAM = """
import json, signal, sys, zenoh
config = zenoh.Config()
for key, value in json.loads(sys.argv[1]).items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("up", flush=True)
    signal.pause()
"""


def free_port() -> int:
    """Return a free TCP port of the loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listens(port: int) -> bool:
    """Return whether a server accepts connections at a port of the loopback."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


class CommandProcess:
    """A `gigabrain` command in a process of its own, with its output in files."""

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
        """Its standard output so far."""
        return self._paths[0].read_text()

    @property
    def err(self) -> str:
        """Its standard error so far."""
        return self._paths[1].read_text()

    @property
    def running(self) -> bool:
        """True until it has ended."""
        return self._process.poll() is None

    def send(self, number: signal.Signals) -> None:
        """Send it a signal; Ctrl-C is SIGINT."""
        self._process.send_signal(number)

    async def ended(self, within_s: float = PATIENCE_S) -> int:
        """Wait for its end, and return the exit code."""
        await until(lambda: not self.running, f"the end of {self._process.args!r}", within_s)
        return int(self._process.returncode)

    def close(self) -> None:
        """End it by SIGTERM, after 5 s by SIGKILL."""
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
    """A user's folders, and the processes that are started with them.

    `inside` is a prefix that runs a command somewhere else, such as in a network namespace.
    """

    def __init__(self, folder: Path, inside: tuple[str, ...] = ()) -> None:
        self.folder, self._inside = folder, inside
        folder.mkdir(exist_ok=True)
        self._commands: list[CommandProcess] = []
        self._numbers = itertools.count(1)

    @property
    def environment(self) -> dict[str, str]:
        """The environment of the processes, with their folders."""
        return os.environ | {
            "PYTHONPATH": os.pathsep.join(SOURCES),
            "XDG_STATE_HOME": str(self.folder / "state"),
            "XDG_RUNTIME_DIR": str(self.folder / "run"),
            "NO_COLOR": "1",
            "COLUMNS": "100",
        }

    def start(self, *arguments: str, stdout: int | None = None) -> CommandProcess:
        """Start a `gigabrain` command; its output goes to `stdout`, or a file."""
        out = self.folder / f"command-{next(self._numbers)}"
        self._commands.append(
            CommandProcess(out, self.environment, arguments, stdout, self._inside)
        )
        return self._commands[-1]

    async def run(self, *arguments: str) -> CommandProcess:
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
        """Return the pids of the supervised processes of this home, or of those called `name`."""
        marks = f'"run_dir":"{self.folder}', f'"name":"{name}"' if name else ""
        return [pid for pid, arguments in _processes() if all(mark in arguments for mark in marks)]

    def close(self) -> None:
        """End all remaining processes."""
        for command in self._commands:
            command.close()
        for pid in self.processes():
            os.kill(pid, signal.SIGKILL)


def _processes() -> Iterator[tuple[int, str]]:
    """Yield the pid and the arguments of each process of this machine."""
    if Path("/proc/self/cmdline").exists():
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):  # the process has ended
                yield int(folder.name), (folder / "cmdline").read_text(errors="replace")
        return
    listed = subprocess.run(("ps", "-ww", "-A", "-o", "pid=,args="), capture_output=True, text=True)
    for line in listed.stdout.splitlines():
        pid, _, arguments = line.strip().partition(" ")
        yield int(pid), arguments


def endpoint_of(deployment: Path) -> Endpoint:
    """Return the endpoint of a deployment file that `Home.deployment` wrote."""
    values = msgspec.json.decode(deployment.read_bytes())
    return Endpoint(connect=(values["router"],), namespace=values.get("namespace", ""))


async def robot_of(home: Home, command: CommandProcess) -> Endpoint:
    """Wait until a command has announced its robot, and return the robot's endpoint."""
    note = home.folder / "run" / "gigabrain" / f"{command.pid}.json"
    await until(note.exists, "the robot is announced")
    return msgspec.json.decode(note.read_bytes(), type=Running).endpoint


def free_endpoint() -> str:
    """Return an endpoint of the loopback with a free port."""
    return f"tcp/127.0.0.1:{free_port()}"


class ServiceManager:
    """The other end of `$NOTIFY_SOCKET`: receives what sd_notify sends."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.setblocking(False)
        self._received: list[str] = []

    @property
    def received(self) -> list[str]:
        """All messages so far."""
        while True:
            try:
                self._received.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return list(self._received)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class RouterProcess:
    """A router in a process of its own."""

    def __init__(self, endpoint: str) -> None:
        config = json.dumps(session_config(Endpoint(listen=(endpoint,))))
        self._process = subprocess.Popen(
            (sys.executable, "-c", ROUTER_PROGRAM, config), stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout
        assert self._process.stdout.readline() == "up\n"

    def freeze(self) -> None:
        """Stop it with SIGSTOP."""
        self._process.send_signal(signal.SIGSTOP)

    def kill(self) -> None:
        """End it with SIGKILL. May be called twice."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdout
        self._process.stdout.close()


@contextlib.contextmanager
def router_process(endpoint: str) -> Iterator[RouterProcess]:
    """Run a router for as long as the context lasts."""
    router = RouterProcess(endpoint)
    try:
        yield router
    finally:
        router.kill()


@contextlib.contextmanager
def raw_session(endpoint: str) -> Iterator[zenoh.Session]:
    """Open a bare Zenoh client."""
    config = zenoh.Config()
    for key, value in session_config(Endpoint(connect=(endpoint,))).items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


class ZenohNetwork:
    """A router and its clients, in this process."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self._stack = contextlib.AsyncExitStack()

    async def router(self, namespace: str = "") -> ZenohTransport:
        """Open the router."""
        return await self._open(Endpoint(listen=(self.endpoint,), namespace=namespace))

    async def client(self, namespace: str = "") -> ZenohTransport:
        """Open one more client."""
        return await self._open(Endpoint(connect=(self.endpoint,), namespace=namespace))

    def raw(self) -> zenoh.Session:
        """Open one more client, a bare Zenoh session."""
        return self._stack.enter_context(raw_session(self.endpoint))

    async def _open(self, endpoint: Endpoint) -> ZenohTransport:
        transport = await ZenohTransport.open(endpoint)
        self._stack.push_async_callback(transport.close)
        return transport

    async def close(self) -> None:
        """Close the router and all clients."""
        await self._stack.aclose()


@contextlib.asynccontextmanager
async def robot() -> AsyncIterator[ZenohNetwork]:
    """Yield a network; close all its sessions at the end of the context."""
    network = ZenohNetwork()
    try:
        yield network
    finally:
        await network.close()


def session_threads() -> set[threading.Thread]:
    """Return the threads of this process that open or close a session."""
    return {thread for thread in threading.enumerate() if thread.name.startswith("zenoh-")}


class SampleCollector:
    """Collects the samples (key, payload) of one key."""

    def __init__(self, transport: ZenohTransport, key: str, depth: int = 256) -> None:
        self.samples: list[tuple[str, bytes]] = []
        self.close = transport.subscribe(key, self._append, depth)

    def _append(self, key: str, payload: bytes) -> None:
        self.samples.append((key, payload))

    @property
    def payloads(self) -> list[bytes]:
        """The payloads that arrived."""
        return [payload for _, payload in self.samples]


async def repeat(send: Callable[[], object], received: Callable[[], object]) -> None:
    """Send every 50 ms until it is received.

    Other processes learn of a new subscription only after a while. A process that a busy machine
    stops for the 400 ms of a lease loses its link for a moment.
    """
    async with asyncio.timeout(30):
        while not received():
            send()
            with contextlib.suppress(TimeoutError):
                await until(received, within_s=0.05)
