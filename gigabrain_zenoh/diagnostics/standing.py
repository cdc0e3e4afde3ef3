"""What counts as standing still, and what safety's caps leave of a motion."""

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.safety import SpeedCaps

SLOW_LINEAR, SLOW_ANGULAR = 0.01, 0.05  # [m/s], [rad/s]; what is below stands still


def stands(velocity: Velocity) -> bool:
    """Whether that is no motion to speak of."""
    linear = max(abs(velocity.linear_x), abs(velocity.linear_y))
    return linear < SLOW_LINEAR and abs(velocity.angular_z) < SLOW_ANGULAR


def leaves_nothing(wants: Velocity, caps: SpeedCaps) -> bool:
    """Whether the caps leave nothing of what is wanted."""
    sides = (
        (wants.linear_x, caps.forward, caps.backward),
        (wants.linear_y, caps.left, caps.right),
        (wants.angular_z, _least(caps.turn_left, caps), _least(caps.turn_right, caps)),
    )
    left = []
    for value, positive, negative in sides:
        cap = positive if value > 0 else negative
        left.append(value if cap is None else max(-cap, min(cap, value)))
    return not stands(wants) and stands(
        Velocity(linear_x=left[0], linear_y=left[1], angular_z=left[2])
    )


def _least(side: float | None, caps: SpeedCaps) -> float | None:
    given = [cap for cap in (side, caps.rotation) if cap is not None]
    return min(given) if given else None
