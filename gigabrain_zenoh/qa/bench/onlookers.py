"""Who looks on while the chain is timed: a viewer of the page, one of the bridge, an echo."""

import asyncio
import contextlib
import json
import sys
from asyncio.subprocess import DEVNULL, Process
from collections.abc import AsyncIterator
from typing import NamedTuple

from websockets.asyncio.client import connect
from websockets.typing import Origin, Subprotocol

from gigabrain_zenoh.qa.bench.group import cpu_s
from gigabrain_zenoh.ui.page import frames
from gigabrain_zenoh.ui.page.node import HOST, free_port

ECHO = "topic echo"
ECHOED = "state"  # 50 a second
COMMAND = (sys.executable, "-P", "-c", "from gigabrain_zenoh.cli.app import main; main()")
PROTOCOL = Subprotocol("foxglove.sdk.v1")


class Ports(NamedTuple):
    """Where the router and the tools listen, on loopback."""

    router: int
    page: int
    foxglove: int

    @property
    def endpoint(self) -> str:
        """The router's Zenoh endpoint."""
        return f"tcp/{HOST}:{self.router}"

    @classmethod
    def free(cls) -> "Ports":
        """Some that nobody listens on."""
        return cls(free_port(0), free_port(0), free_port(0))


class Echo:
    """`gigabrain topic echo` in a process of its own."""

    def __init__(self, process: Process) -> None:
        self._process = process

    def cpu_s(self) -> float:
        """CPU time that it has used so far."""
        return cpu_s(self._process.pid)


@contextlib.asynccontextmanager
async def looking_on(ports: Ports) -> AsyncIterator[Echo]:
    """All three, while the block lasts. The viewers read what they are sent, and draw nothing."""
    process = await asyncio.create_subprocess_exec(
        *COMMAND, "topic", "echo", ECHOED, "--connect", ports.endpoint, stdout=DEVNULL
    )
    viewers = [
        asyncio.ensure_future(_view_page(ports.page)),
        asyncio.ensure_future(_view_foxglove(ports.foxglove)),
    ]
    try:
        yield Echo(process)
        for viewer in viewers:
            if viewer.done():
                viewer.result()
    finally:
        for viewer in viewers:
            viewer.cancel()
        await asyncio.gather(*viewers, return_exceptions=True)
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


async def _view_page(port: int) -> None:
    place = f"{HOST}:{port}"
    async with connect(f"ws://{place}/ws", origin=Origin(f"http://{place}")) as socket:
        await socket.send(frames.as_json(frames.LOGIN, frames.Login()))
        async for _ in socket:
            pass


async def _view_foxglove(port: int) -> None:
    """Subscribes to every channel as it is announced."""
    async with connect(f"ws://{HOST}:{port}", subprotocols=[PROTOCOL]) as socket:
        async for frame in socket:
            if isinstance(frame, bytes) or (told := json.loads(frame))["op"] != "advertise":
                continue
            numbers = [channel["id"] for channel in told["channels"]]
            wanted = [{"id": number, "channelId": number} for number in numbers]
            await socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
