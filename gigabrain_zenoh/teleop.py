"""An operator's stream of velocities, and when it can be trusted."""

from collections.abc import Callable

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Twist

GAP_NS = 200_000_000  # a stream with a longer gap has ended
DEAF_NS = 500_000_000  # how long a stream without an echo is not believed after a gap


class Teleop:
    """An operator's stream, trusted only while it is plainly live.

    A network that was cut hands over what it had stored when it heals. Whoever echoes the newest
    tick is told from that at once; of anybody else nothing is believed for half a second after a
    gap, and on a real body nothing at all.

    An enable of the gate hands the body over. What an operator sent before it does not count, even
    where it arrives later: its tick is older than that of the first state after the enable. Without
    an echo nothing is believed for half a second, as after a gap.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._newest: Twist | None = None
        self._arrived_ns = 0
        self._trusted_from_ns = 0
        self._handed_over = (0, -1)  # the boot and the gate's count of enables
        self._handed_over_tick = 0

    def receive(self, twist: Twist) -> None:
        """Take one message."""
        now = self._now_ns()
        if self._newest is None or now - self._arrived_ns > GAP_NS:
            self._trusted_from_ns = now + DEAF_NS
        self._newest, self._arrived_ns = twist, now

    def velocity(self, state: RobotState, echo_wanted: bool) -> Velocity | None:
        """What the operator wants now, or None when nobody steers."""
        now, twist = self._now_ns(), self._newest
        self._see_hand_over(state, now)
        if twist is None or now - self._arrived_ns > GAP_NS:
            return None
        off_ns = abs(state.tick - twist.tick) * TICK_NS  # of the future is as wrong as of the past
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
