"""What a viewer may say: a velocity, on the topic that only its layout file names."""

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
from gigabrain_zenoh.ui.foxglove.sources import Sources
from gigabrain_zenoh.ui.seat import Seat

log = logging.getLogger(__name__)

SAYS_HZ = 120  # messages of one viewer that are looked at in a second
MOST_BYTES = 1024
MOST_CHANNELS = 64  # of all viewers


class _Vector(Struct, frozen=True, forbid_unknown_fields=True):
    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0


class _Twist(Struct, frozen=True, forbid_unknown_fields=True):
    """As in ROS; so the Teleop panel sends it."""

    linear: _Vector
    angular: _Vector


def velocity_of(data: bytes) -> Velocity:
    """A velocity in JSON, as the Teleop panel sends it or as a Velocity. Raises ValueError."""
    try:
        if b'"linear"' not in data:
            return msgspec.json.decode(data, type=Velocity)
        twist = msgspec.json.decode(data, type=_Twist)
    except DECODE_ERRORS as error:
        raise ValueError(str(error)) from None
    if twist.linear.z or twist.angular.x or twist.angular.y:
        raise ValueError("a robot on the ground moves in x and y and turns about z")
    return Velocity(linear_x=twist.linear.x, linear_y=twist.linear.y, angular_z=twist.angular.z)


class Steering(ServerListener):
    """Hears viewers, in the server's threads, and hands on what counts to the event loop."""

    def __init__(self, robot: Sources, topic: str) -> None:
        self._robot, self._seat, self._topic = robot, Seat(robot), topic
        self._loop = asyncio.get_running_loop()
        self._said: Counter[int] = Counter()  # by viewer, in this second
        self._second = 0.0
        self._channels: set[tuple[int, int]] = set()  # viewer and channel, of those who may steer
        self._refused: set[int] = set()  # viewers of whom that was logged
        self.graph_wanted = False

    def close(self) -> None:
        """Nobody steers from here any more."""
        self._seat.clear()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Somebody begins to look at a topic."""
        self._hand_on(self._robot.show_again, channel.topic)

    def on_connection_graph_subscribe(self) -> None:
        """Somebody looks at who talks to whom."""
        self.graph_wanted = True

    def on_connection_graph_unsubscribe(self) -> None:
        """Nobody does any more."""
        self.graph_wanted = False

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        """A viewer wants to publish."""
        may = channel.topic == self._topic and channel.encoding == "json"
        self._hand_on(self._open, client.id, channel.id, may)

    def on_client_unadvertise(self, client: Client, client_channel_id: int) -> None:
        """A viewer publishes no more, or is gone."""
        self._hand_on(self._close, client.id, client_channel_id)

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        """A viewer has published something."""
        if len(data) <= MOST_BYTES and not self._floods(client.id):
            self._hand_on(self._take, client.id, client_channel_id, data)

    def _hand_on(self, act: Callable[..., None], *arguments: object) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(act, *arguments)

    def _floods(self, viewer: int) -> bool:
        now_s = time.monotonic()
        if now_s - self._second >= 1.0:
            self._second = now_s
            self._said.clear()
        self._said[viewer] += 1
        return self._said[viewer] > SAYS_HZ

    def _open(self, viewer: int, channel: int, may: bool) -> None:
        if may and len(self._channels) < MOST_CHANNELS:
            self._channels.add((viewer, channel))
        else:
            self._refuse(viewer, "only its layout file knows the topic that steers")

    def _close(self, viewer: int, channel: int) -> None:
        if (viewer, channel) in self._channels:
            self._channels.discard((viewer, channel))
            self._refused.discard(viewer)
            self._seat.leave(viewer)

    def _take(self, viewer: int, channel: int, data: bytes) -> None:
        if (viewer, channel) not in self._channels:
            return
        try:
            wanted = velocity_of(data)
        except ValueError as error:
            self._seat.leave(viewer)
            self._refuse(viewer, str(error)[:200])
            return
        if not self._seat.drive(viewer, wanted, self._loop.time()):
            self._refuse(viewer, "somebody else steers from another viewer")

    def _refuse(self, viewer: int, why: str) -> None:
        """Once for each viewer: who floods the bridge does not flood the log."""
        if viewer not in self._refused and len(self._refused) < MOST_CHANNELS:
            self._refused.add(viewer)
            log.warning("viewer %d may not steer: %s", viewer, why)
