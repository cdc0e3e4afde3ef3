"""An operator's stream of velocities, and the check whether it is live."""

from collections.abc import Callable

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Twist

GAP_NS = 200_000_000  # after a longer gap the stream has ended
DEAF_NS = 500_000_000  # how long a stream without an echo is ignored after a gap


class Teleop:
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
        self._newest: Twist | None = None
        self._arrived_ns = 0
        self._trusted_from_ns = 0
        self._handed_over = (0, -1)  # boot, and the gate's count of enables
        self._handed_over_tick = 0

    def receive(self, twist: Twist) -> None:
        """Store a message of the operator's stream."""
        now = self._now_ns()
        if self._newest is None or now - self._arrived_ns > GAP_NS:
            self._trusted_from_ns = now + DEAF_NS
        self._newest, self._arrived_ns = twist, now

    def velocity(self, state: RobotState, echo_wanted: bool) -> Velocity | None:
        """Return the operator's velocity, or None if no live stream exists.

        With `echo_wanted`, as on a real body, a stream without an echo is never accepted.
        """
        now, twist = self._now_ns(), self._newest
        self._see_hand_over(state, now)
        if twist is None or now - self._arrived_ns > GAP_NS:
            return None
        off_ns = abs(state.tick - twist.tick) * TICK_NS  # a future tick is as wrong as an old one
        if echo_wanted or twist.boot:
            if twist.boot != state.boot or off_ns > GAP_NS:
                return None
            if twist.tick < self._handed_over_tick:
                return None
        elif now < self._trusted_from_ns:
            return None
        return Velocity(linear_x=twist.linear_x, linear_y=twist.linear_y, angular_z=twist.angular_z)

    def _see_hand_over(self, state: RobotState, now: int) -> None:
        handed_over = state.boot, state.gate.enables
        if handed_over != self._handed_over:
            self._handed_over, self._handed_over_tick = handed_over, state.tick
            self._trusted_from_ns = max(self._trusted_from_ns, now + DEAF_NS)
