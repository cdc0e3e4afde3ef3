"""Joins the robot to viewers that speak Foxglove's WebSocket protocol. On loopback only.

The protocol knows no login: whoever connects may look. Of browsers only pages of this machine and
of known viewers may (`front`). To steer, a viewer has to publish on a topic that ends in a secret,
which the layout file holds that `gigabrain foxglove --layout` writes.
"""

import asyncio
import logging
from collections.abc import Callable

import foxglove
from foxglove.websocket import Capability, ServerListener, WebSocketServer

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import FoxgloveConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.ui.foxglove.front import HOST, Front, hidden_host
from gigabrain_zenoh.ui.foxglove.graph import connections
from gigabrain_zenoh.ui.foxglove.layout import topic_to_steer
from gigabrain_zenoh.ui.foxglove.sources import Sources
from gigabrain_zenoh.ui.foxglove.steering import Steering

log = logging.getLogger(__name__)

FRAME_NS = 100_000_000  # viewers see ten moments a second
GRAPH_NS = 2_000_000_000  # how often it is asked who talks to whom
BACKLOG = 64  # messages that wait for a slow viewer; the oldest give way
NAME = "gigabrain"


def start(host: str, context: foxglove.Context, listener: ServerListener) -> WebSocketServer:
    """The server, which has threads of its own. Raises ConfigError where it cannot listen."""
    try:
        return foxglove.start_server(
            name=NAME,
            host=host,
            port=0,
            capabilities=[Capability.ClientPublish, Capability.ConnectionGraph],
            server_listener=listener,
            supported_encodings=["json"],
            context=context,
            message_backlog_size=BACKLOG,
        )
    except RuntimeError as error:
        raise ConfigError(f"foxglove: cannot listen on loopback: {error}") from None


async def run(config: FoxgloveConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Serve until the process ends. Raises ConfigError."""
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # a stranger's noise is no news
    context = foxglove.Context()
    sources = Sources(bus, context)
    steering = Steering(sources, topic_to_steer(config))
    behind = hidden_host()
    server = start(behind, context, steering)
    front = Front(config.origins, (behind, server.port))
    try:
        port = await front.listen(config.port)
    except ConfigError:
        await asyncio.to_thread(server.stop)
        raise
    works = [
        asyncio.ensure_future(_show(bus, sources)),
        asyncio.ensure_future(_show_graph(bus, steering, server)),
    ]
    log.info("viewers connect to ws://%s:%d", HOST, port)
    ready()
    try:
        await asyncio.wait((*works, bus.failed), return_when=asyncio.FIRST_COMPLETED)
    finally:
        steering.close()
        for work in works:
            work.cancel()
        await front.close()
        await asyncio.to_thread(server.stop)
    for end in (*works, bus.failed):
        if end.done() and not end.cancelled():
            end.result()


async def _show(bus: Bus, sources: Sources) -> None:
    """Ten times a second, to whoever looks."""
    async for _ in bus.clock.every(FRAME_NS):
        sources.show()
        bus.counters["frames"] += 1


async def _show_graph(bus: Bus, steering: Steering, server: WebSocketServer) -> None:
    """Who talks to whom, while somebody looks at that."""
    async for _ in bus.clock.every(GRAPH_NS):
        if steering.graph_wanted:
            server.publish_connection_graph(await connections(bus))
