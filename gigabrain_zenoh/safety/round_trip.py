"""How long commands take: from the tick that they echo until they are heard."""

import msgspec

from gigabrain_schemas.base import TICK_NS, Cause
from gigabrain_schemas.body import BodyDescription, Thresholds
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.safety.sustain import held, ticks_of
from gigabrain_zenoh.safety.words import say

COMMANDS = 100  # the newest, two seconds of them
SHARE = 0.99
SLOWED = 0.5  # of the body's speeds


class RoundTrip(msgspec.Struct, frozen=True, kw_only=True):
    """What is remembered of commands and their echoes."""

    ages: tuple[int, ...] = ()  # of the newest commands when they were heard [ticks]
    late_ticks: int = 0


def look(limits: Thresholds, before: RoundTrip, ages: tuple[int, ...], elapsed: int) -> RoundTrip:
    """One state more, and the `ages` [ticks] of the commands that came since the last."""
    newest = (*before.ages, *ages)[-COMMANDS:]
    slowest = percentile(sorted(newest), SHARE) or 0
    late = slowest * TICK_NS > limits.round_trip * 1e9
    return RoundTrip(ages=newest, late_ticks=held(before.late_ticks, late, elapsed))


def is_late(limits: Thresholds, now: RoundTrip) -> bool:
    """Whether the body must go at half speed."""
    return now.late_ticks >= ticks_of(limits.round_trip_sustain)


def causes(limits: Thresholds, now: RoundTrip) -> tuple[Cause, ...]:
    """Why the body is slow; no reason to stop."""
    if not is_late(limits, now):
        return ()
    return (say("round_trip", f"commands take more than {limits.round_trip * 1e3:.0f} ms"),)


def halved(body: BodyDescription, caps: SpeedCaps) -> SpeedCaps:
    """`caps`, and half the body's speed at most in every direction."""

    def least(cap: float | None, most: float) -> float:
        return SLOWED * most if cap is None else min(cap, SLOWED * most)

    return SpeedCaps(
        forward=least(caps.forward, body.max_linear_speed),
        backward=least(caps.backward, body.max_linear_speed),
        left=least(caps.left, body.max_lateral_speed),
        right=least(caps.right, body.max_lateral_speed),
        rotation=least(caps.rotation, body.max_angular_speed),
        turn_left=caps.turn_left,
        turn_right=caps.turn_right,
    )
