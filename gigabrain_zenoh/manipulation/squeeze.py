"""How hard a gripper squeezes: by how far it stays short of where it was sent."""

import math

from gigabrain_schemas.body import JointDescription

HELD = 0.01  # of a gripper's range, short of its target: something is between the fingers
MOVING = (0.0315, 0.035, 0.049)  # the same while the arm moves what it holds: least, set, and most
STILL = (0.018, 0.02, 0.0224)  # while it is still: servos hold on for hours and stay below 60 °C


def is_holding(gripper: JointDescription, measured: float, wanted: float) -> bool:
    """Return whether a gripper has stopped short of where it was sent."""
    return abs(measured - wanted) > HELD * (gripper.upper - gripper.lower)


def squeezing_place(
    gripper: JointDescription, measured: float, wanted: float, *, moving: bool
) -> float:
    """Return where a gripper goes that holds something, to squeeze as hard as it should.

    One whose greatest effort is not known stays.

    Args:
        gripper: Its joint.
        measured: Where it is [rad] or [m].
        wanted: Where it was sent [rad] or [m].
        moving: Whether the arm moves meanwhile.
    """
    span, lag = gripper.upper - gripper.lower, wanted - measured
    least, aim, most = (share * span for share in (MOVING if moving else STILL))
    if not gripper.max_effort or least <= abs(lag) <= most:
        return wanted
    return max(gripper.lower, min(gripper.upper, measured + math.copysign(aim, lag)))
