"""Parts shared by the operator page and the Foxglove bridge: what they show, and steering."""

import functools
from collections import Counter
from typing import Any, TypeVar

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.topics import LOG, MAP, STATE, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import Latest
from gigabrain_zenoh.bus.listening import Sampled
from gigabrain_zenoh.client.requests import steer
from gigabrain_zenoh.diagnostics.robot_view import RobotView
from gigabrain_zenoh.geometry.limits import ZERO, clamp, limits_of

M = TypeVar("M", bound=Message)

LEASE_S = 0.5  # after this time without a command, another viewer may steer
STREAM_GAP_S = 0.2  # after a longer gap, commands count as a new stream
MAX_RECEIVED_HZ = 120  # messages of one viewer that are processed; held keys take 25
SETTLE_S = 0.1  # start of a new stream that is ignored: commands the network had buffered


class ViewerScene(RobotView):
    """Messages for viewers: also map and log. Busy topics are decoded when read."""

    def __init__(self, bus: Bus) -> None:
        self.sampled: dict[Topic[Any], Sampled[Any]] = {}
        super().__init__(bus)
        bus.latest(MAP, functools.partial(self.on_rare, MAP))
        bus.subscribe(LOG, lambda _key, record: self.on_rare(LOG, record))

    def newest_of(self, topic: Topic[M]) -> Latest[M]:
        """Subscribe to a busy topic; decode only the messages that are read."""
        sampled = self.sampled[topic] = Sampled(self.bus, topic)
        return sampled

    @property
    def enables(self) -> int | None:
        """Return how often the gate was enabled; None while the robot sends nothing."""
        state = self.state.fresh()
        return state.gate.enables if state else None

    def steer(self, wanted: Velocity) -> None:
        """Publish the operator's wanted velocity with the newest tick."""
        self.sampled[STATE].poll()
        steer(self.bus, wanted)


class RateLimiter:
    """Counts the messages of each viewer in the present second."""

    def __init__(self) -> None:
        self._second_s = 0.0
        self._received: Counter[int] = Counter()

    def is_exceeded(self, viewer: int, now_s: float) -> bool:
        """Count a message; return whether there are too many of this viewer."""
        if now_s - self._second_s >= 1.0:
            self._second_s = now_s
            self._received.clear()
        self._received[viewer] += 1
        return self._received[viewer] > MAX_RECEIVED_HZ


class TeleopArbiter:
    """Lets one viewer steer at a time, while its commands arrive. Commands are never repeated."""

    def __init__(self, scene: ViewerScene) -> None:
        self._scene = scene
        self._viewer = 0
        self._lease_end_s = self._last_command_s = self._obey_from_s = 0.0
        self._enables: int | None = None  # the gate's count when a viewer last steered

    def driving(self, now_s: float) -> int:
        """Return the number of the viewer that steers, or 0."""
        return self._viewer if now_s < self._lease_end_s else 0

    def drive(self, viewer: int, wanted: Velocity, now_s: float) -> bool:
        """Pass on the velocity that a viewer (1, 2, …) wants; return False if another one steers.

        A zero velocity from another viewer is ignored, and returns True.
        """
        if self.driving(now_s) not in (0, viewer):
            return wanted == ZERO
        body = self._scene.body
        if body is None or (wanted == ZERO and viewer != self._viewer):
            return True
        if viewer != self._viewer or now_s - self._last_command_s > STREAM_GAP_S:
            self._obey_from_s = now_s + SETTLE_S
        self._viewer, self._last_command_s, self._lease_end_s = viewer, now_s, now_s + LEASE_S
        if wanted == ZERO:
            self._end()
        elif now_s >= self._obey_from_s:
            self._enables = self._scene.enables
            self._scene.steer(clamp(wanted, limits_of(body.description)))
        return True

    def leave(self, viewer: int) -> None:
        """Stop the robot if the viewer that leaves was steering it."""
        if viewer == self._viewer:
            self._end()

    def clear(self) -> None:
        """End steering by any viewer, because an e-stop was pressed."""
        if self._viewer:
            self._end()

    def _end(self) -> None:
        """Publish a zero velocity, unless the gate was enabled again since the last command.

        In that case a zero would take the body back from its new commander.
        """
        self._viewer = 0
        if self._scene.enables in (None, self._enables):
            self._scene.steer(ZERO)
