"""Shows Foxglove viewers the newest of each topic, drawn only while one of them subscribes."""

from collections import defaultdict
from collections.abc import Iterable
from typing import Any

from foxglove import Channel, ConnectionGraph, Context

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import Body
from gigabrain_schemas.topics import (
    CMD_VEL,
    HEALTH,
    IMAGE,
    INTENT,
    LOG,
    POSE,
    SAFETY,
    SCAN,
    STATE,
    WORLD,
    Topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import Sampled
from gigabrain_zenoh.diagnostics.discovery import discover, flows
from gigabrain_zenoh.diagnostics.graph import chain
from gigabrain_zenoh.recording.drawing import Drawer, Drawn
from gigabrain_zenoh.ui.robot_view import RobotView


class FoxgloveView(RobotView):
    """Draws messages with the recorder's table."""

    def __init__(self, bus: Bus, context: Context) -> None:
        self._context, self._drawer = context, Drawer()
        self._kept: dict[Topic[Any], Message] = {}
        self._channels: dict[str, Channel] = {}
        self._channel_names: dict[str, set[str]] = {}  # by the key that they are drawn from
        super().__init__(bus)
        self._busy: tuple[tuple[Topic[Any], Sampled[Any]], ...] = (
            (STATE, self.state),
            (SCAN, self.scan),
            (WORLD, self.world),
            (INTENT, self.intent),
            (POSE, self.pose),
            (SAFETY, self.safety),
            (CMD_VEL, self.command),
        )

    def draw_new(self) -> None:
        """Draw everything received since the last call."""
        for topic, sampled in self._busy:
            if self._has_viewers(topic.key) and (message := sampled.look()):
                self._draw(topic, message)
        for camera, sampled in list(self.images.items()):
            if self._has_viewers(IMAGE.at(camera)) and (image := sampled.look()):
                self._draw(IMAGE, image, camera)

    def draw_kept(self, channel: str) -> None:
        """Draw rare messages again for a new subscriber of a channel."""
        for topic, message in self._kept.items():
            if channel in self._channel_names.get(topic.key, ()):
                self._draw(topic, message)

    def show(self, topic: Topic[Any], message: Message) -> None:
        """Draw a rare message at once, and keep it for later subscribers."""
        if isinstance(message, Body):
            self.body = message
        if topic is HEALTH:
            return
        if topic is not LOG:
            self._kept[topic] = message
        self._draw(topic, message)

    def _has_viewers(self, key: str) -> bool:
        """Return whether a viewer subscribes, or cannot yet because nothing has been drawn."""
        names: Iterable[str] = self._channel_names.get(key, ())
        return not names or any(self._channels[name].base.has_sinks() for name in names)

    def _draw(self, topic: Topic[Any], message: Message, name: str = "") -> None:
        key = topic.at(name)
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
    for flow in chain(flows(processes.values(), {})):
        senders[flow.key].add(flow.sender)
        receivers[flow.key].add(flow.receiver)
    graph = ConnectionGraph()
    for key in senders:
        graph.set_published_topic(key, sorted(senders[key]))
        graph.set_subscribed_topic(key, sorted(receivers[key]))
    return graph
