"""Bridge to viewers of Foxglove's WebSocket protocol, on loopback only.

The protocol has no login, so any program of this machine may connect. Browsers may connect only
from pages of this machine and of known viewers (`Front`). To steer, a viewer publishes on a secret
topic, which the layout file of `gigabrain foxglove --layout` contains.
"""

import asyncio
import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import foxglove
import msgspec
from foxglove import Channel, ConnectionGraph, Context
from foxglove.websocket import (
    Capability,
    ChannelView,
    Client,
    ClientChannel,
    Parameter,
    ServerListener,
    WebSocketServer,
)
from msgspec import Struct

from gigabrain_schemas.base import Finite, Message, Velocity
from gigabrain_schemas.body import ArmModel
from gigabrain_schemas.topics import (
    ARM_MODEL,
    CAMERA,
    DEPTH,
    DETECTIONS,
    HEALTH,
    IMAGE,
    LOG,
    OBJECT_MAP,
    PERCEIVED,
    STATE,
    Topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.config.settings import FoxgloveConfig
from gigabrain_zenoh.diagnostics.discovery import chain_flows, discover, flows
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded import put_newest
from gigabrain_zenoh.recording.drawing import Drawer
from gigabrain_zenoh.recording.drawn import Drawn
from gigabrain_zenoh.ui.camera_feed import CameraFeed
from gigabrain_zenoh.ui.foxglove.access import HOST, Front, hidden_host, topic_to_steer
from gigabrain_zenoh.ui.foxglove.requests import REFRESH_NS, FoxgloveRequests
from gigabrain_zenoh.ui.steering import RateLimiter, TeleopArbiter, ViewerScene

log = logging.getLogger(__name__)

FRAME_INTERVAL_NS = 100_000_000
GRAPH_INTERVAL_NS = 2_000_000_000
MAX_WAITING_MESSAGES = 64  # for a slow viewer; the oldest are dropped
NAME = "gigabrain"
MAX_MESSAGE_BYTES = 1024
MAX_CHANNELS = 64  # of all viewers
MAX_REFUSED = 64  # newest refused viewers, each logged once
FEED_TOPICS = (IMAGE, DEPTH, PERCEIVED, DETECTIONS)


def _key(topic: Topic[Any], name: str) -> str:
    """Return the key of a drawn message; detections have one for each camera as well."""
    return f"{topic.key}/{name}" if name else topic.key


class FoxgloveView(ViewerScene):
    """Draws messages with the recorder's table."""

    def __init__(self, bus: Bus, context: Context) -> None:
        self._context, self._drawer = context, Drawer()
        self._kept: dict[str, tuple[Topic[Any], Message, str]] = {}  # by key
        self._channels: dict[str, Channel] = {}
        self._channel_names: dict[str, set[str]] = {}  # by the key of the drawn message
        super().__init__(bus)
        self._feed = CameraFeed(bus, *FEED_TOPICS)
        bus.subscribe(CAMERA, lambda key, info: self._keep(CAMERA, info, key.rpartition("/")[2]))
        bus.latest(OBJECT_MAP, lambda stored: self._keep(OBJECT_MAP, stored))
        bus.latest(ARM_MODEL, self._on_arm_model)

    def draw_new(self, viewers: int) -> None:
        """Draw the messages since the last call; receive pictures only while there are viewers."""
        for topic, sampled in self.sampled.items():
            if self._has_viewers(topic.key) and (message := sampled.poll()):
                self._draw(topic, message)
        self._feed.watch(viewers > 0)
        for topic in FEED_TOPICS:
            for name in self._feed.names(topic):
                if self._has_viewers(_key(topic, name)) and (new := self._feed.poll(topic, name)):
                    self._draw(topic, new, name)
        for found in self._feed.new_detections():
            self._draw(DETECTIONS, found, found.camera)

    def draw_kept(self, channel: str) -> None:
        """Draw rare messages again for a new subscriber of a channel."""
        for key, kept in self._kept.items():
            if channel in self._channel_names.get(key, ()):
                self._draw(*kept)

    def on_rare(self, topic: Topic[Any], message: Message) -> None:
        """Draw a rare message at once, and keep it for later subscribers."""
        if topic is LOG:
            self._draw(topic, message)
        elif topic is not HEALTH:
            self._keep(topic, message)

    def _on_arm_model(self, model: ArmModel) -> None:
        """Draw the arm, and states once even without viewers: the arm adds channels to them."""
        for topic in (ARM_MODEL, STATE):
            self._channel_names.pop(topic.key, None)
        self._keep(ARM_MODEL, model)

    def _keep(self, topic: Topic[Any], message: Message, name: str = "") -> None:
        put_newest(self._kept, _key(topic, name), (topic, message, name), MAX_CHANNELS)
        self._draw(topic, message, name)

    def _has_viewers(self, key: str) -> bool:
        """Return whether a viewer subscribes, or no channel exists yet to subscribe to."""
        names: Iterable[str] = self._channel_names.get(key, ())
        return not names or any(self._channels[name].base.has_sinks() for name in names)

    def _draw(self, topic: Topic[Any], message: Message, name: str = "") -> None:
        key = _key(topic, name)
        if not self._has_viewers(key):
            return
        for drawn in self._drawer.draw(topic, message, name):
            self._channel_names.setdefault(key, set()).add(drawn.topic)
            self._channel(drawn).log(drawn.data, log_time=message.stamp_ns or None)

    def _channel(self, drawn: Drawn) -> Channel:
        if drawn.topic not in self._channels:
            self._channels[drawn.topic] = Channel(
                drawn.topic,
                message_encoding=drawn.encoding,
                schema=drawn.schema(),
                context=self._context,
            )
        return self._channels[drawn.topic]


async def connection_graph(bus: Bus) -> ConnectionGraph:
    """Return the graph of the robot's processes and the topics between them."""
    senders, receivers = defaultdict[str, set[str]](set), defaultdict[str, set[str]](set)
    processes = await discover(bus)
    for flow in chain_flows(flows(processes.values(), {})):
        senders[flow.key].add(flow.sender)
        receivers[flow.key].add(flow.receiver)
    graph = ConnectionGraph()
    for key in senders:
        graph.set_published_topic(key, sorted(senders[key]))
        graph.set_subscribed_topic(key, sorted(receivers[key]))
    return graph


class _Vector(Struct, frozen=True, forbid_unknown_fields=True):
    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0


class _Twist(Struct, frozen=True, forbid_unknown_fields=True):
    """A ROS Twist, as the Teleop panel sends it."""

    linear: _Vector
    angular: _Vector


def velocity_of(data: bytes) -> Velocity:
    """Decode a velocity in JSON: a ROS Twist, or a Velocity. Raises ValueError."""
    try:
        if b'"linear"' not in data:
            return msgspec.json.decode(data, type=Velocity)
        twist = msgspec.json.decode(data, type=_Twist)
    except DECODE_ERRORS as error:
        raise ValueError(str(error)) from None
    if twist.linear.z or twist.angular.x or twist.angular.y:
        raise ValueError("a ground robot moves in x and y and turns about z")
    return Velocity(linear_x=twist.linear.x, linear_y=twist.linear.y, angular_z=twist.angular.z)


class FoxgloveSteering(ServerListener):
    """Receives commands in the server's threads, and carries them out in the event loop."""

    def __init__(self, view: FoxgloveView, topic: str) -> None:
        self._view, self._arbiter, self._topic = view, TeleopArbiter(view), topic
        self._loop = asyncio.get_running_loop()
        self._rates = RateLimiter()
        self._channels: set[tuple[int, int]] = set()  # viewer and channel that may steer
        self._refused: dict[int, None] = {}  # viewers whose refusal was logged
        self.graph_wanted = self.parameters_wanted = False
        self.requests = FoxgloveRequests(
            view.bus, view.state.fresh, view.health.keys, self.may_steer
        )

    def may_steer(self, viewer: int) -> bool:
        """Return whether a viewer publishes on the secret topic. Called in any thread."""
        return any(viewer == steering for steering, _ in tuple(self._channels))

    def close(self) -> None:
        """End steering."""
        self._arbiter.clear()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Repeat the newest message of a topic for a new subscriber."""
        self._in_loop(self._view.draw_kept, channel.topic)

    def on_connection_graph_subscribe(self) -> None:
        """Begin to publish the graph of processes."""
        self.graph_wanted = True

    def on_connection_graph_unsubscribe(self) -> None:
        """Stop publishing the graph of processes."""
        self.graph_wanted = False

    def on_get_parameters(
        self, client: Client, param_names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        """Return the parameters with these names, or all parameters without names."""
        return self.requests.get(param_names)

    def on_set_parameters(
        self, client: Client, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        """Set parameters for a viewer that may steer."""
        return self.requests.set(client.id, parameters)

    def on_parameters_subscribe(self, param_names: list[str]) -> None:
        """Begin to publish changes of parameters."""
        self.parameters_wanted = True

    def on_parameters_unsubscribe(self, param_names: list[str]) -> None:
        """Do nothing: other viewers may still subscribe to changes."""

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        """Admit a viewer that advertises the secret topic."""
        allowed = channel.topic == self._topic and channel.encoding == "json"
        self._in_loop(self._open_channel, client.id, channel.id, allowed)

    def on_client_unadvertise(self, client: Client, client_channel_id: int) -> None:
        """Forget a viewer that left or stopped publishing."""
        self._in_loop(self._close_channel, client.id, client_channel_id)

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        """Process a message from a viewer."""
        if self._rates.is_exceeded(client.id, time.monotonic()):
            return
        if len(data) <= MAX_MESSAGE_BYTES:
            self._in_loop(self._process, client.id, client_channel_id, data)

    def _in_loop(self, act: Callable[..., None], *arguments: object) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(act, *arguments)

    def _open_channel(self, viewer: int, channel: int, allowed: bool) -> None:
        if allowed and len(self._channels) < MAX_CHANNELS:
            self._channels.add((viewer, channel))
        else:
            self._refuse(viewer, "it does not publish on the topic of the layout file")

    def _close_channel(self, viewer: int, channel: int) -> None:
        if (viewer, channel) in self._channels:
            self._channels.discard((viewer, channel))
            self._refused.pop(viewer, None)
            self._arbiter.leave(viewer)

    def _process(self, viewer: int, channel: int, data: bytes) -> None:
        if (viewer, channel) not in self._channels:
            return
        try:
            wanted = velocity_of(data)
        except ValueError as error:
            self._arbiter.leave(viewer)
            self._refuse(viewer, str(error)[:200])
            return
        if not self._arbiter.drive(viewer, wanted, self._loop.time()):
            self._refuse(viewer, "another viewer steers the robot")

    def _refuse(self, viewer: int, reason: str) -> None:
        """Log a refusal, once for each viewer."""
        if viewer not in self._refused:
            put_newest(self._refused, viewer, None, MAX_REFUSED)
            log.warning("viewer %d may not steer: %s", viewer, reason)


def start(host: str, context: foxglove.Context, listener: FoxgloveSteering) -> WebSocketServer:
    """Start the server, in threads of its own. Raises ConfigError if it cannot listen."""
    try:
        return foxglove.start_server(
            name=NAME,
            host=host,
            port=0,
            capabilities=[
                Capability.ClientPublish,
                Capability.ConnectionGraph,
                Capability.Parameters,
                Capability.Services,
            ],
            services=listener.requests.services(),
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
        asyncio.ensure_future(_draw(bus, view, front)),
        asyncio.ensure_future(_publish_graph(bus, steering, server)),
        asyncio.ensure_future(_publish_parameters(bus, steering, server)),
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


async def _draw(bus: Bus, view: FoxgloveView, front: Front) -> None:
    async for _ in bus.clock.every(FRAME_INTERVAL_NS):
        view.draw_new(front.viewers)
        bus.counters["frames"] += 1


async def _publish_graph(bus: Bus, steering: FoxgloveSteering, server: WebSocketServer) -> None:
    async for _ in bus.clock.every(GRAPH_INTERVAL_NS):
        if steering.graph_wanted:
            server.publish_connection_graph(await connection_graph(bus))


async def _publish_parameters(
    bus: Bus, steering: FoxgloveSteering, server: WebSocketServer
) -> None:
    async for _ in bus.clock.every(REFRESH_NS):
        if steering.parameters_wanted and (changed := await steering.requests.refresh()):
            server.publish_parameter_values(changed)
