"""Real Zenoh sessions for tests: free ports, and routers that may be killed or frozen."""

import asyncio
import contextlib
import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator

import zenoh

from gigabrain_zenoh.bus.zenoh.config import session_config
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint
from tests.bus_rig import until

PROGRAM = """
import json, signal, sys, zenoh
config = zenoh.Config()
for key, value in json.loads(sys.argv[1]).items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("up", flush=True)
    signal.pause()
"""


def free_endpoint() -> str:
    """An endpoint that nobody listens on just now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class RouterProcess:
    """A router in a process of its own."""

    def __init__(self, endpoint: str) -> None:
        config = json.dumps(session_config(Endpoint(listen=(endpoint,))))
        self._process = subprocess.Popen(
            (sys.executable, "-c", PROGRAM, config), stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout
        assert self._process.stdout.readline() == "up\n"

    def freeze(self) -> None:
        """SIGSTOP."""
        self._process.send_signal(signal.SIGSTOP)

    def kill(self) -> None:
        """SIGKILL. May be called twice."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdout
        self._process.stdout.close()


@contextlib.contextmanager
def router_process(endpoint: str) -> Iterator[RouterProcess]:
    """A router that does not outlive the test."""
    router = RouterProcess(endpoint)
    try:
        yield router
    finally:
        router.kill()


@contextlib.contextmanager
def raw_session(endpoint: str) -> Iterator[zenoh.Session]:
    """A client that knows nothing of this project."""
    config = zenoh.Config()
    for key, value in session_config(Endpoint(connect=(endpoint,))).items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


class Robot:
    """A router and its clients, in this process."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self._stack = contextlib.AsyncExitStack()

    async def router(self, namespace: str = "") -> ZenohTransport:
        """The router itself."""
        return await self._open(Endpoint(listen=(self.endpoint,), namespace=namespace))

    async def client(self, namespace: str = "") -> ZenohTransport:
        """One more client."""
        return await self._open(Endpoint(connect=(self.endpoint,), namespace=namespace))

    def raw(self) -> zenoh.Session:
        """One more client that knows nothing of this project."""
        return self._stack.enter_context(raw_session(self.endpoint))

    async def _open(self, endpoint: Endpoint) -> ZenohTransport:
        transport = await ZenohTransport.open(endpoint)
        self._stack.push_async_callback(transport.close)
        return transport

    async def close(self) -> None:
        """All of them."""
        await self._stack.aclose()


@contextlib.asynccontextmanager
async def robot() -> AsyncIterator[Robot]:
    """A robot's network that does not outlive the test."""
    made = Robot()
    try:
        yield made
    finally:
        await made.close()


def under_way() -> set[threading.Thread]:
    """The threads of this process in which a session is being opened or closed."""
    return {thread for thread in threading.enumerate() if thread.name == "zenoh-session"}


class Ear:
    """Hears one key, as the bus would."""

    def __init__(self, transport: ZenohTransport, key: str, depth: int = 256) -> None:
        self.heard: list[tuple[str, bytes]] = []
        self.close = transport.subscribe(key, self._take, depth)

    def _take(self, key: str, payload: bytes) -> None:
        self.heard.append((key, payload))

    @property
    def payloads(self) -> list[bytes]:
        """What came, without the keys."""
        return [payload for _, payload in self.heard]


async def repeat(send: Callable[[], object], heard: Callable[[], object]) -> None:
    """Send, and again every 50 ms, until it is heard.

    What listens is not known everywhere at once, and on a machine that starves a process for the
    400 ms of a lease a link is lost for a moment.
    """
    async with asyncio.timeout(30):
        while not heard():
            send()
            with contextlib.suppress(TimeoutError):
                await until(heard, 0.05)
