"""Operators' streams, accepted only while they are clearly live."""

from collections.abc import Callable
from typing import Generic, TypeVar

from gigabrain_schemas.base import TICK_NS, Message, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Twist
from gigabrain_zenoh.geometry.pose import velocity_of

M = TypeVar("M", bound=Message)
GAP_NS = 200_000_000  # after a longer gap the stream has ended
SETTLE_NS = 500_000_000  # how long a stream without an echo is ignored after a gap


class OperatorStream(Generic[M]):
    """An operator's stream, accepted only while it is clearly live.

    After an outage, a network delivers the messages it had buffered. A client may echo the robot's
    newest tick in its messages, so its live messages are recognized immediately. A stream without
    an echo is ignored for half a second after a gap, and always on a real body.

    When the gate is enabled, the body gets a new commander. Messages sent before that do not count,
    even if they arrive later: their tick is older than that of the first state after the enable. A
    stream without an echo is ignored for half a second, as after a gap.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._newest: M | None = None
        self._arrived_ns = 0
        self._trusted_from_ns = 0
        self._handed_over = (0, -1)  # boot, and the gate's count of enables
        self._handed_over_tick = 0

    def receive(self, message: M) -> None:
        """Store a message of the operator's stream."""
        now = self._now_ns()
        if self._newest is None or now - self._arrived_ns > GAP_NS:
            self._trusted_from_ns = now + SETTLE_NS
        self._newest, self._arrived_ns = message, now

    def live(self, state: RobotState, echo_wanted: bool) -> M | None:
        """Return the newest message, or None if no live stream exists.

        With `echo_wanted`, as on a real body, a stream without an echo is never accepted.
        """
        now, message = self._now_ns(), self._newest
        self._note_hand_over(state, now)
        if message is None or now - self._arrived_ns > GAP_NS:
            return None
        off_ns = abs(state.tick - message.tick) * TICK_NS  # a future tick is as wrong as an old one
        if echo_wanted or message.boot:
            if message.boot != state.boot or off_ns > GAP_NS:
                return None
            if message.tick < self._handed_over_tick:
                return None
        elif now < self._trusted_from_ns:
            return None
        return message

    def _note_hand_over(self, state: RobotState, now: int) -> None:
        handed_over = state.boot, state.gate.enables
        if handed_over != self._handed_over:
            self._handed_over, self._handed_over_tick = handed_over, state.tick
            self._trusted_from_ns = max(self._trusted_from_ns, now + SETTLE_NS)


class Teleop(OperatorStream[Twist]):
    """The operator's stream of velocities of the base."""

    def velocity(self, state: RobotState, echo_wanted: bool) -> Velocity | None:
        """Return the operator's velocity, or None if no live stream exists."""
        twist = self.live(state, echo_wanted)
        return velocity_of(twist) if twist else None
