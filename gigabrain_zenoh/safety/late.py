"""Whether what the body and its lidar report is older than it seems.

By the stamps of the device's own clock where the driver has them; else by how late the body's
measured speeds follow what it was told, and the lidar's scans the body's turns. At half speed a
robot needs no more way for data that are late by its reaction time than it needs at full speed for
data that are not; later ones stop it.
"""

import math

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Cause
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.safety import lag, scan_lag
from gigabrain_zenoh.safety.lag import Lag
from gigabrain_zenoh.safety.scan_lag import ScanLag
from gigabrain_zenoh.safety.sustain import held, ticks_of
from gigabrain_zenoh.safety.words import say

TICK_MS = TICK_NS / 1e6
ROUND_MS = 10.0
DOUBT_TICKS = 250  # after a silence, unless the speeds show sooner whether data are late


class Late(msgspec.Struct, frozen=True, kw_only=True):
    """What is remembered of how late data come."""

    lag: Lag = Lag()
    scan_lag: ScanLag = ScanLag()
    body_ms: float = 0.0
    lidar_ms: float = 0.0
    body_ticks: int = 0  # for which the body's data have been late
    lidar_ticks: int = 0
    doubt_ms: float = 0.0  # the longest silence of late, by which data may have become late
    doubt_ticks: int = 0  # for which that is still open


def look(
    body: BodyDescription,
    before: Late,
    state: RobotState,
    scan: LaserScan | None,
    history: PoseHistory,
    elapsed: int,
) -> Late:
    """One state more, `elapsed` ticks after the last."""
    limits = body.thresholds
    late_ms = limits.late * 1e3
    now = _doubt(before, state, late_ms, elapsed)
    lagging = lag.look(now.lag, state, elapsed)
    beyond_ms = (lagging.ticks or 0) * TICK_MS - limits.response * 1e3
    body_ms = max(state.link.late_ms or 0.0, beyond_ms, 0.0)
    if lagging.ticks is not None and body_ms < late_ms:
        now = replace(now, doubt_ms=0.0, doubt_ticks=0)
    turning = scan_lag.look(before.scan_lag, state, scan, history, elapsed)
    # a scan is as old as half a turn when it is whole
    behind_ms = (turning.ticks or 0) * TICK_MS - (500.0 / body.lidar.rate_hz if body.lidar else 0.0)
    lidar_ms = max(scan.late_ms if scan else 0.0, behind_ms, 0.0)
    return replace(
        now,
        lag=lagging,
        scan_lag=turning,
        body_ms=body_ms,
        lidar_ms=lidar_ms,
        body_ticks=held(before.body_ticks, body_ms >= late_ms, elapsed),
        lidar_ticks=held(before.lidar_ticks, lidar_ms >= late_ms, elapsed),
    )


def _doubt(before: Late, state: RobotState, late_ms: float, elapsed: int) -> Late:
    """A line cannot become late without falling silent for as long.

    Where it did, and the device has no clock that tells, what was known of it counts no more. The
    body slows down, and its change of speed shows whether the line is late.
    """
    silent_ms = state.link.age_ms
    if silent_ms >= late_ms and state.link.late_ms is None:
        longest_ms = max(silent_ms, before.doubt_ms)
        lag_of = replace(before.lag, measured=(), ticks=None, guesses=0)
        return replace(before, lag=lag_of, doubt_ms=longest_ms, doubt_ticks=DOUBT_TICKS)
    left = max(0, before.doubt_ticks - elapsed)
    return replace(before, doubt_ms=before.doubt_ms if left else 0.0, doubt_ticks=left)


def ticks_of_body(body: BodyDescription, now: Late) -> int:
    """Return by how many ticks the body's data are late, once that is named as a cause.

    A guess must not excuse a body that disobeys: one whose wheel is stuck looks late as well.
    """
    named = now.body_ticks >= ticks_of(body.thresholds.late_sustain)
    return math.ceil(now.body_ms / TICK_MS) if named else 0


def stops(body: BodyDescription, now: Late) -> tuple[Cause, ...]:
    """Why the body must stop."""
    most_ms = body.thresholds.reaction_time * 1e3
    return tuple(_say(code, ms, "") for code, ms in _found(body, now) if ms > most_ms)


def slows(body: BodyDescription, now: Late) -> tuple[Cause, ...]:
    """Why the body must go at half speed."""
    most_ms = body.thresholds.reaction_time * 1e3
    found = _found(body, now)
    late = tuple(_say(code, ms, "; half speed") for code, ms in found if ms <= most_ms)
    if now.doubt_ticks and "body_late" not in dict(found):
        silent = f"the body was silent for {now.doubt_ms:.0f} ms, and may be late; half speed"
        late = (say("body_late", silent), *late)
    return late


def _found(body: BodyDescription, now: Late) -> list[tuple[str, float]]:
    sustain = ticks_of(body.thresholds.late_sustain)
    each = (
        ("body_late", now.body_ticks, now.body_ms),
        ("lidar_late", now.lidar_ticks, now.lidar_ms),
    )
    return [(code, ms) for code, ticks, ms in each if ticks >= sustain]


def _say(code: str, ms: float, more: str) -> Cause:
    rounded = ROUND_MS * round(ms / ROUND_MS)
    return say(code, f"{say(code).text}, by {rounded:.0f} ms{more}")
