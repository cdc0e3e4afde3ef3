"""How far ahead must be free, and how fast the body may go with the room that there is.

`L(v) = v T + v² / 2a + margin`, where T is the time from scan to brake and a the deceleration; for
turning the same with angles.
"""

import math
from functools import lru_cache

import msgspec

from gigabrain_schemas.body import BodyDescription


class Brake(msgspec.Struct, frozen=True, kw_only=True):
    """How a body comes to rest along one axis: in [m], or in [rad] for turning."""

    reaction_time: float  # [s]
    deceleration: float  # [m/s2]
    margin: float  # [m], kept free in front of the body at rest
    resume: float  # [m], more than the stop zone before it may go on
    fastest: float  # [m/s], its limit

    def distance(self, speed: float) -> float:
        """L(v): how far must be free at `speed`."""
        return speed * self.reaction_time + speed * speed / (2 * self.deceleration) + self.margin

    def speed(self, free: float) -> float:
        """The speed from which it stops within `free`: L(v) solved for v."""
        t, a = self.reaction_time, self.deceleration
        return -a * t + math.sqrt((a * t) ** 2 + 2 * a * max(0.0, free - self.margin))

    @property
    def reach(self) -> float:
        """As far as it is worth looking: beyond that nothing is slowed and any zone opens."""
        return self.distance(self.fastest) + self.resume

    def in_zone(self, free: float | None, speed: float, stopped: bool) -> bool:
        """Whether a body at `speed` towards what is `free` away must stop, or stay `stopped`.

        Once stopped, only a clear margin opens the zone again.
        """
        if free is None:
            return False
        resume = self.resume if stopped else 0.0
        return free < self.distance(max(0.0, speed)) + resume

    def cap(self, free: float | None, stopped: bool) -> float | None:
        """The speed allowed towards what is `free` away; None where nothing limits it."""
        if stopped:
            return 0.0
        if free is None:
            return None
        allowed = self.speed(free)
        return allowed if allowed < self.fastest else None


@lru_cache(maxsize=8)
def brakes(body: BodyDescription) -> dict[str, Brake]:
    """The brake for each direction of motion that the body has."""
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
        margin=0.0,  # the sweep keeps room round the footprint
        resume=limits.resume_margin / max(math.hypot(x, y) for x, y in body.footprint),
        fastest=body.max_angular_speed,
    )
    found = {"forward": along, "backward": along, "turn_left": turning, "turn_right": turning}
    if body.max_lateral_speed > 0:
        found.update(left=across, right=across)
    return found
