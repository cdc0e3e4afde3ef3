"""How far ahead must be free: stopping distances, and what the lidar says of the room there is.

`L(v) = v T + v² / 2a + margin`, where T is the time from scan to brake and a the deceleration.
"""

import math

from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.perception import hits

SIDE_MARGIN = 0.03  # [m], kept free beside the body as it moves on
RESUME_MARGIN = 0.10  # [m], more than the stop zone before the body may go on
NEAREST = 0.1  # [m], nearer hits are the lidar's own housing


def stopping_distance(body: BodyDescription, speed: float) -> float:
    """L(v) = v T + v² / 2a + margin [m]: how far ahead must be free at `speed` [m/s]."""
    t, a = body.thresholds.reaction_time, body.max_linear_deceleration
    return speed * t + speed * speed / (2 * a) + body.thresholds.stop_margin


def speed_within(body: BodyDescription, free: float) -> float:
    """The speed [m/s] from which the body stops within `free` [m]: L(v) solved for v."""
    t, a = body.thresholds.reaction_time, body.max_linear_deceleration
    room = max(0.0, free - body.thresholds.stop_margin)
    return -a * t + math.sqrt((a * t) ** 2 + 2 * a * room)


def free_distances(body: BodyDescription, scan: LaserScan) -> tuple[float | None, float | None]:
    """How far the footprint can go forwards and backwards until it touches a hit of `scan` [m].

    None stands for nothing in the way.
    """
    if body.lidar is None:
        return None, None
    x, y = hits(body.lidar, scan, NEAREST)
    half_width = max(abs(corner) for _, corner in body.footprint) + SIDE_MARGIN
    front = max(corner for corner, _ in body.footprint)
    rear = min(corner for corner, _ in body.footprint)
    x = x[abs(y) <= half_width]
    ahead, behind = x[x > 0], x[x < 0]
    return (
        max(0.0, float(ahead.min()) - front) if ahead.size else None,
        max(0.0, rear - float(behind.max())) if behind.size else None,
    )


def in_zone(body: BodyDescription, free: float | None, speed: float, stopped: bool) -> bool:
    """Whether a body at `speed` towards what is `free` [m] away must stop, or stay `stopped`.

    Once stopped, only a clear margin opens the zone again.
    """
    if free is None:
        return False
    margin = RESUME_MARGIN if stopped else 0.0
    return free < stopping_distance(body, max(0.0, speed)) + margin


def cap(body: BodyDescription, free: float | None, stopped: bool) -> float | None:
    """The speed allowed towards what is `free` [m] away; None where nothing limits it [m/s]."""
    if stopped:
        return 0.0
    if free is None:
        return None
    allowed = speed_within(body, free)
    return allowed if allowed < body.max_linear_speed else None
