"""The bridge as a process: viewers connect by Foxglove's WebSocket protocol, on loopback only.

The protocol has no login, so any program of this machine may look. Of browsers only pages of this
machine and of known viewers may (`Front`). To steer, a viewer publishes on a secret topic, which
the layout file of `gigabrain foxglove --layout` contains.
"""

import asyncio
import logging
from collections.abc import Callable

import foxglove
from foxglove.websocket import Capability, ServerListener, WebSocketServer

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import FoxgloveConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.ui.foxglove.access import HOST, Front, hidden_host, topic_to_steer
from gigabrain_zenoh.ui.foxglove.steering import FoxgloveSteering
from gigabrain_zenoh.ui.foxglove.view import FoxgloveView, connection_graph

log = logging.getLogger(__name__)

FRAME_INTERVAL_NS = 100_000_000
GRAPH_INTERVAL_NS = 2_000_000_000
MAX_WAITING_MESSAGES = 64  # for a slow viewer; the oldest are dropped
NAME = "gigabrain"


def start(host: str, context: foxglove.Context, listener: ServerListener) -> WebSocketServer:
    """Start the server, in threads of its own. Raises ConfigError if it cannot listen."""
    try:
        return foxglove.start_server(
            name=NAME,
            host=host,
            port=0,
            capabilities=[Capability.ClientPublish, Capability.ConnectionGraph],
            server_listener=listener,
            supported_encodings=["json"],
            context=context,
            message_backlog_size=MAX_WAITING_MESSAGES,
        )
    except RuntimeError as error:
        raise ConfigError(f"foxglove: cannot listen on loopback: {error}") from None


async def run(config: FoxgloveConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Serve viewers until the process ends. Raises ConfigError."""
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # any client can cause its warnings
    context = foxglove.Context()
    view = FoxgloveView(bus, context)
    steering = FoxgloveSteering(view, topic_to_steer(config))
    server_host = hidden_host()
    server = start(server_host, context, steering)
    front = Front(config.origins, (server_host, server.port))
    try:
        port = await front.listen(config.port)
    except ConfigError:
        await asyncio.to_thread(server.stop)
        raise
    tasks = [
        asyncio.ensure_future(_draw(bus, view)),
        asyncio.ensure_future(_publish_graph(bus, steering, server)),
    ]
    log.info("viewers connect to ws://%s:%d", HOST, port)
    ready()
    try:
        await asyncio.wait((*tasks, bus.failed), return_when=asyncio.FIRST_COMPLETED)
    finally:
        steering.close()
        for task in tasks:
            task.cancel()
        await front.close()
        await asyncio.to_thread(server.stop)
    for end in (*tasks, bus.failed):
        if end.done() and not end.cancelled():
            end.result()


async def _draw(bus: Bus, view: FoxgloveView) -> None:
    async for _ in bus.clock.every(FRAME_INTERVAL_NS):
        view.draw_new()
        bus.counters["frames"] += 1


async def _publish_graph(bus: Bus, steering: FoxgloveSteering, server: WebSocketServer) -> None:
    async for _ in bus.clock.every(GRAPH_INTERVAL_NS):
        if steering.graph_wanted:
            server.publish_connection_graph(await connection_graph(bus))
