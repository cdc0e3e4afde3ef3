"""Commands of Foxglove viewers: velocities, on the secret topic that only the layout file names."""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable

import msgspec
from foxglove.websocket import ChannelView, Client, ClientChannel, ServerListener
from msgspec import Struct

from gigabrain_schemas.base import Finite, Velocity
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.ui.foxglove.view import FoxgloveView
from gigabrain_zenoh.ui.robot_view import TeleopArbiter

log = logging.getLogger(__name__)

MAX_RECEIVED_HZ = 120  # messages of one viewer that are processed
MAX_MESSAGE_BYTES = 1024
MAX_CHANNELS = 64  # of all viewers


class _Vector(Struct, frozen=True, forbid_unknown_fields=True):
    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0


class _Twist(Struct, frozen=True, forbid_unknown_fields=True):
    """Twist of ROS, as the Teleop panel sends it."""

    linear: _Vector
    angular: _Vector


def velocity_of(data: bytes) -> Velocity:
    """Decode a velocity in JSON: a Twist of ROS, or a Velocity. Raises ValueError."""
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
    """Receives from viewers in the server's threads, and acts in the event loop."""

    def __init__(self, view: FoxgloveView, topic: str) -> None:
        self._view, self._arbiter, self._topic = view, TeleopArbiter(view), topic
        self._loop = asyncio.get_running_loop()
        self._received: Counter[int] = Counter()  # by viewer, in this second
        self._second_s = 0.0
        self._channels: set[tuple[int, int]] = set()  # viewer and channel that may steer
        self._refused: set[int] = set()  # viewers whose refusal was logged
        self.graph_wanted = False

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

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        """Admit a viewer that advertises the secret topic."""
        may = channel.topic == self._topic and channel.encoding == "json"
        self._in_loop(self._open, client.id, channel.id, may)

    def on_client_unadvertise(self, client: Client, client_channel_id: int) -> None:
        """Forget a viewer that has left or publishes no longer."""
        self._in_loop(self._close, client.id, client_channel_id)

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        """Process a message from a viewer."""
        if len(data) <= MAX_MESSAGE_BYTES and not self._floods(client.id):
            self._in_loop(self._take, client.id, client_channel_id, data)

    def _in_loop(self, act: Callable[..., None], *arguments: object) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(act, *arguments)

    def _floods(self, viewer: int) -> bool:
        now_s = time.monotonic()
        if now_s - self._second_s >= 1.0:
            self._second_s = now_s
            self._received.clear()
        self._received[viewer] += 1
        return self._received[viewer] > MAX_RECEIVED_HZ

    def _open(self, viewer: int, channel: int, may: bool) -> None:
        if may and len(self._channels) < MAX_CHANNELS:
            self._channels.add((viewer, channel))
        else:
            self._refuse(viewer, "only the layout file knows the topic for steering")

    def _close(self, viewer: int, channel: int) -> None:
        if (viewer, channel) in self._channels:
            self._channels.discard((viewer, channel))
            self._refused.discard(viewer)
            self._arbiter.leave(viewer)

    def _take(self, viewer: int, channel: int, data: bytes) -> None:
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
        if viewer not in self._refused and len(self._refused) < MAX_CHANNELS:
            self._refused.add(viewer)
            log.warning("viewer %d may not steer: %s", viewer, reason)
