"""Stopping distance, the highest speed for a free distance, and the allowed age of scans.

The distance is `L(v) = v T + v² / 2a + margin`: T is the time from scan to brake, a the
deceleration. For turning, the same formula applies to angles.
"""

import math
from functools import lru_cache

import msgspec

from gigabrain_schemas.body import BodyDescription

REPEAT_TICKS = 2  # safety's verdict is repeated every 40 ms, and at once when it changes


def scan_limit_ns(body: BodyDescription) -> int:
    """Return the allowed age of sensor data: `scan_age`, or 1.5 scan periods if longer [ns]."""
    period_ns = 1e9 / body.lidar.rate_hz if body.lidar else 0.0
    return round(max(body.thresholds.scan_age * 1e9, 1.5 * period_ns))


class Brake(msgspec.Struct, frozen=True, kw_only=True):
    """Braking of a body along one direction of motion: in [m], or in [rad] for turning."""

    reaction_time: float  # [s]
    deceleration: float  # [m/s2]
    margin: float  # [m], free space that remains in front of the stopped body
    resume: float  # [m], free space beyond the stop zone before it may move again
    fastest: float  # [m/s], the body's limit

    def distance(self, speed: float) -> float:
        """Return L(v), the distance that must be free at `speed`."""
        return speed * self.reaction_time + speed * speed / (2 * self.deceleration) + self.margin

    def speed(self, free: float) -> float:
        """Return the speed from which the body stops within `free`: L(v) solved for v."""
        t, a = self.reaction_time, self.deceleration
        return -a * t + math.sqrt((a * t) ** 2 + 2 * a * max(0.0, free - self.margin))

    @property
    def reach(self) -> float:
        """Return the distance beyond which obstacles do not limit or stop the body."""
        return self.distance(self.fastest) + self.resume

    def in_zone(self, free: float | None, speed: float, stopped: bool) -> bool:
        """Return whether a body moving at `speed` must stop, or stay `stopped`, with `free` ahead.

        Once stopped, the body may move again only with `resume` more free space. None means no
        obstacle.
        """
        if free is None:
            return False
        resume = self.resume if stopped else 0.0
        return free < self.distance(max(0.0, speed)) + resume

    def cap(self, free: float | None, stopped: bool) -> float | None:
        """Return the highest speed allowed with `free` ahead; None without a limit."""
        if stopped:
            return 0.0
        if free is None:
            return None
        allowed = self.speed(free)
        return allowed if allowed < self.fastest else None


@lru_cache(maxsize=8)
def brakes(body: BodyDescription) -> dict[str, Brake]:
    """Return the brake for each direction in which the body can move."""
    limits = body.thresholds
    along = Brake(
        reaction_time=limits.reaction_time,
        deceleration=body.max_linear_deceleration,
        margin=limits.stop_margin,
        resume=limits.resume_margin,
        fastest=body.max_linear_speed,
    )
    across = msgspec.structs.replace(along, fastest=body.max_lateral_speed)
    turning = Brake(
        reaction_time=limits.reaction_time,
        deceleration=body.max_angular_acceleration,
        margin=0.0,  # the sweep keeps a margin around the footprint
        resume=limits.resume_margin / max(math.hypot(x, y) for x, y in body.footprint),
        fastest=body.max_angular_speed,
    )
    found = {"forward": along, "backward": along, "turn_left": turning, "turn_right": turning}
    if body.max_lateral_speed > 0:
        found.update(left=across, right=across)
    return found
