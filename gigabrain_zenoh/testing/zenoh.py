"""Real Zenoh sessions: free ports, and routers that may be killed or frozen."""

import asyncio
import contextlib
import json
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator

import zenoh

from gigabrain_zenoh.bus.zenoh.config import session_config
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.testing.processes import free_port
from gigabrain_zenoh.testing.waiting import until

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
    """Return an endpoint of the loopback with a free port."""
    return f"tcp/127.0.0.1:{free_port()}"


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
        """Close all of them."""
        await self._stack.aclose()


@contextlib.asynccontextmanager
async def robot() -> AsyncIterator[ZenohNetwork]:
    """Close all sessions of a network at the end of the context."""
    made = ZenohNetwork()
    try:
        yield made
    finally:
        await made.close()


def under_way() -> set[threading.Thread]:
    """Return the threads of this process that open or close a session."""
    return {thread for thread in threading.enumerate() if thread.name == "zenoh-session"}


class Ear:
    """Keeps what arrives on one key."""

    def __init__(self, transport: ZenohTransport, key: str, depth: int = 256) -> None:
        self.heard: list[tuple[str, bytes]] = []
        self.close = transport.subscribe(key, self._take, depth)

    def _take(self, key: str, payload: bytes) -> None:
        self.heard.append((key, payload))

    @property
    def payloads(self) -> list[bytes]:
        """The payloads that arrived."""
        return [payload for _, payload in self.heard]


async def repeat(send: Callable[[], object], heard: Callable[[], object]) -> None:
    """Send every 50 ms until it is received.

    Subscriptions take a while to spread. On a machine that starves a process for the 400 ms of a
    lease, a link is lost for a moment.
    """
    async with asyncio.timeout(30):
        while not heard():
            send()
            with contextlib.suppress(TimeoutError):
                await until(heard, within_s=0.05)
