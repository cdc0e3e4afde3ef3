"""How late a lidar's scans follow the odometry, by how both turn.

Two scans of a room show by how much the body has turned between them. Each delay of a grid says by
how much it had turned by its odometry; the one that fits the last 1.2 s best counts, if it fits
well and shorter ones do not. This needs no stamps, but turns that begin or end, walls, and a lidar
that looks all round.
"""

import math

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.arrays import ranges
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.geometry.pose import PoseHistory

Floats = NDArray[np.float64]

LOOK_TICKS = 60  # of scans that are explained
DELAYS = 26  # candidates, a tick apart: 0 to 0.5 s
FARTHEST = 5.0  # [m], what is beyond counts as there
FAR_OFF = 0.5  # [m], two beams that differ by more show different things
WIDEST = math.radians(35.0)  # by which the body may turn between two scans
DISTINCT = 0.5  # of what a usual turn leaves unlike, the right one may leave
LEAST_SCANS = 5
LEAST_CHANGE = math.radians(3.0)  # of the turn from one scan to the next
UNEXPLAINED = 0.1  # share of the squared changes that the best delay may leave
NOISE = math.radians(0.15)  # of a turn between two scans, at least
WORSE = 4.0  # times as much is left by a delay that is refuted
SURE = 3  # scans in a row that say the same, until it is believed
REST_TICKS = 50  # without being told to move: then nothing is known any more


class ScanLag(msgspec.Struct, frozen=True, kw_only=True):
    """What is remembered of turns."""

    scan: LaserScan | None = None  # the newest
    turns: tuple[tuple[int, int, float], ...] = ()  # from tick, to tick, by so much [rad]
    ticks: int | None = None  # how late scans follow; None while that is not known
    guess: int = 0  # the newest delay that explains them,
    guesses: int = 0  # and for how many scans in a row it was about that
    rest_ticks: int = 0


def look(
    before: ScanLag, state: RobotState, scan: LaserScan | None, history: PoseHistory, elapsed: int
) -> ScanLag:
    """One state more, and the newest scan once its tick has come."""
    rest = before.rest_ticks + elapsed if state.sent == ZERO else 0
    now = replace(before, rest_ticks=rest)
    if rest > REST_TICKS:
        now = replace(now, ticks=None, guesses=0)
    last = before.scan
    if scan is None or scan.basis > state.tick or (last and scan.basis <= last.basis):
        return now
    turn = _turn(last, scan) if last else None
    now = replace(now, scan=scan)
    if last is None or turn is None:
        return replace(now, turns=())
    recent = (t for t in before.turns if t[0] > scan.basis - LOOK_TICKS)
    now = replace(now, turns=(*recent, (last.basis, scan.basis, turn)))
    delay = _delay(now.turns, history)
    if delay is None:
        return now
    guesses = now.guesses + 1 if abs(delay - now.guess) <= 1 else 1
    known = delay if guesses >= SURE else now.ticks
    return replace(now, guess=delay, guesses=guesses, ticks=known)


def _turn(before: LaserScan, now: LaserScan) -> float | None:
    """By how much the lidar has turned between two scans [rad]; None where they do not show it."""
    if before.angle_increment != now.angle_increment or len(before.ranges) != len(now.ranges):
        return None
    then, newest = _profile(before), _profile(now)
    step, beams = abs(now.angle_increment), len(newest)
    if not math.isclose(step * beams, math.tau, rel_tol=0.01):
        return None
    most = min(math.ceil(WIDEST / step), beams // 2 - 1)
    around = np.concatenate([then[beams - most :], then, then[:most]])
    apart = np.lib.stride_tricks.sliding_window_view(around, beams) - newest  # (shifts, beams)
    unlike = np.minimum(apart * apart, FAR_OFF * FAR_OFF).mean(axis=1)
    best = int(np.argmin(unlike))
    if best in (0, 2 * most) or unlike[best] > DISTINCT * float(np.median(unlike)):
        return None
    left, middle, right = unlike[best - 1 : best + 2]
    bend = left - 2 * middle + right
    between = 0.5 * (left - right) / bend if bend > 0 else 0.0
    return float((best - most + between) * now.angle_increment)


def _profile(scan: LaserScan) -> Floats:
    """The ranges (n,) [m], none of them farther than FARTHEST."""
    values = ranges(scan).astype(np.float64)
    return np.clip(np.nan_to_num(values, nan=FARTHEST, posinf=FARTHEST), 0.0, FARTHEST)


def _delay(turns: tuple[tuple[int, int, float], ...], history: PoseHistory) -> int | None:
    """The delay of the scans that explains their turns, unless shorter ones do so as well."""
    if len(turns) < LEAST_SCANS:
        return None
    begins, ends, seen = (np.array(part, dtype=np.float64) for part in zip(*turns, strict=True))
    if float(np.ptp(seen)) < LEAST_CHANGE or not history.ticks:
        return None
    known = np.array(history.ticks, dtype=np.float64)
    if known[0] > begins[0] - DELAYS:
        return None
    yaws = np.unwrap(np.array([pose.yaw for pose in history.poses]))
    back = np.arange(DELAYS, dtype=np.float64)[:, None]
    told = np.interp(ends - back, known, yaws) - np.interp(begins - back, known, yaws)
    left = ((told - seen) ** 2).sum(axis=1) + len(turns) * NOISE * NOISE
    best = int(np.argmin(left))
    sure = left[best] <= UNEXPLAINED * float(((seen - seen.mean()) ** 2).sum()) + (
        len(turns) * NOISE * NOISE
    )
    refuted = left > WORSE * left[best]
    return best if sure and bool(refuted[: max(0, best - 2)].all()) else None
