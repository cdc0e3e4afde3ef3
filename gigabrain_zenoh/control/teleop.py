"""Operators' streams, accepted only while they are clearly live."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import JointSpeeds, Twist
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.geometry.pose import velocity_of

M = TypeVar("M", Twist, JointSpeeds)
GAP_NS = 200_000_000  # after a longer gap the stream has ended
SETTLE_NS = 500_000_000  # after a gap, a stream without an echo is ignored for this long
MAX_STREAMS = 16  # one per source; the newest are kept


def at_rest(message: Twist | JointSpeeds) -> bool:
    """Return whether a message asks for no motion."""
    if isinstance(message, Twist):
        return velocity_of(message) == ZERO
    return not any(message.velocity)


@dataclass(frozen=True)
class _Stream(Generic[M]):
    """State of one source's stream."""

    newest: M
    arrived_ns: int
    trusted_from_ns: int  # used without an echo


class OperatorStream(Generic[M]):
    """The operators' streams, accepted only while they are clearly live.

    Among several sources, such as two pages, the one that moves the robot is followed until it
    asks for rest or is silent.

    After an outage, a network delivers the messages it had buffered. A client may echo the robot's
    newest tick in its messages, so its live messages are recognized immediately. A stream without
    an echo is ignored for half a second after a gap, and always on a real body.

    When the gate is enabled, the body gets a new commander. Messages sent before that do not count,
    even if they arrive later: their tick is older than that of the first state after the enable. A
    stream without an echo is ignored for half a second, as after a gap.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self.streams: dict[str, _Stream[M]] = {}  # by source, the newest last
        self._source = ""  # the followed one
        self._trusted_from_ns = 0  # after a hand-over; used without an echo
        self._handed_over = (0, -1)  # boot, gate's count of enables
        self._handed_over_tick = 0

    def receive(self, message: M) -> None:
        """Store a message of an operator's stream."""
        now, before = self._now_ns(), self.streams.pop(message.source, None)
        continues = before is not None and now - before.arrived_ns <= GAP_NS
        trusted_from_ns = before.trusted_from_ns if before and continues else now + SETTLE_NS
        self.streams[message.source] = _Stream(message, now, trusted_from_ns)
        if len(self.streams) > MAX_STREAMS:
            del self.streams[next(iter(self.streams))]

    def live(self, state: RobotState, echo_wanted: bool) -> M | None:
        """Return the newest message of the stream to follow, or None if no live stream exists."""
        self._update_hand_over(state, self._now_ns())
        streams = self.streams.values()
        live = [stream for stream in streams if self._is_live(stream, state, echo_wanted)]
        if not live:
            return None
        moving = [stream for stream in live if not at_rest(stream.newest)]
        follow = min(
            moving or live,
            key=lambda stream: (stream.newest.source != self._source, stream.trusted_from_ns),
        )
        self._source = follow.newest.source
        return follow.newest

    def _is_live(self, stream: _Stream[M], state: RobotState, echo_wanted: bool) -> bool:
        now, message = self._now_ns(), stream.newest
        if now - stream.arrived_ns > GAP_NS:
            return False
        if not echo_wanted and not message.boot:
            return now >= max(stream.trusted_from_ns, self._trusted_from_ns)
        # a future tick is as wrong as an old one
        difference_ns = abs(state.tick - message.tick) * TICK_NS
        echoes = message.boot == state.boot and difference_ns <= GAP_NS
        return echoes and message.tick >= self._handed_over_tick

    def _update_hand_over(self, state: RobotState, now: int) -> None:
        handed_over = state.boot, state.gate.enables
        if handed_over != self._handed_over:
            self._handed_over, self._handed_over_tick = handed_over, state.tick
            self._trusted_from_ns = max(self._trusted_from_ns, now + SETTLE_NS)


class Teleop(OperatorStream[Twist]):
    """The operators' streams of velocities of the base."""

    def velocity(self, state: RobotState, echo_wanted: bool) -> Velocity | None:
        """Return the velocity of the operator to follow, or None if no live stream exists."""
        twist = self.live(state, echo_wanted)
        return velocity_of(twist) if twist else None
