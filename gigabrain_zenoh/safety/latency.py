"""Monitor of late data from the body and its lidar.

The latency follows from the device's time stamps, if the driver has them. Otherwise it is
estimated, by the delay of measured speeds behind commands and of scans behind the body's turns.
Both need speeds that change. If data are late by the reaction time, half speed needs no more room
than full speed with data in time. Later data stop the robot.
"""

import math
from functools import lru_cache
from typing import Self

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_MS, Cause
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.geometry.pose import PoseHistory, axes
from gigabrain_zenoh.safety.catalogue import cause, lasting, ticks_of

Speeds = tuple[float, float, float]

ROUND_MS = 10.0  # resolution in texts
DOUBT_TICKS = 250  # 5 s after a silence, unless the speeds show the delay sooner

MAX_UNEXPLAINED = 0.1  # share of the squared changes that the best delay may not explain
REFUTED_FACTOR = 4.0  # a delay with this many times the error of the best one is refuted
CONFIRMATIONS = 3  # estimates in a row that agree, before the delay is known
REST_TICKS = 50  # without motion commands, after which the delay is unknown

SPEED_TICKS, MIN_SPEED_TICKS = 40, 20  # measured speeds for an estimate
SPEED_DELAYS = 31  # candidates, one per tick: 0 to 0.6 s
MIN_SPEED_DELAYS = 15  # candidates while commands are few
SPEED_SCALE: Floats = np.array([[0.05], [0.05], [0.3]])  # [m/s], [m/s], [rad/s]
MIN_SPEED_CHANGE = 2.0  # in units of SPEED_SCALE; smaller changes are noise
SPEED_PERIOD_TICKS = 4  # between estimates

TURN_TICKS = 60  # 1.2 s of scans for an estimate
TURN_DELAYS = 26  # candidates, one per tick: 0 to 0.5 s
MAX_RANGE_M = 5.0  # longer ranges are clipped
MAX_RANGE_DIFFERENCE_M = 0.5  # larger ones are clipped: the beams hit different objects
MAX_TURN = math.radians(35.0)  # between two scans
MAX_MISMATCH = 0.5  # of the best turn, as a share of the median turn's
MIN_TURNS = 5
MIN_TURN_CHANGE = math.radians(3.0)
TURN_NOISE = math.radians(0.15)  # of a turn between two scans


class DelayEstimate(Struct, frozen=True, kw_only=True):
    """A delay that is known once several estimates in a row agree."""

    ticks: int | None = None  # None while unknown
    newest: int = 0  # estimate [ticks]
    agreeing: int = 0  # newest estimates that agree
    rest_ticks: int = 0  # without motion commands

    def _count_rest(self, state: RobotState, elapsed: int) -> Self:
        rest = self.rest_ticks + elapsed if state.sent == ZERO else 0
        now = replace(self, rest_ticks=rest)
        return replace(now, ticks=None, agreeing=0) if rest > REST_TICKS else now

    def _with_estimate(self, delay: int | None) -> Self:
        if delay is None:
            return self
        agreeing = self.agreeing + 1 if abs(delay - self.newest) <= 1 else 1
        known = delay if agreeing >= CONFIRMATIONS else self.ticks
        return replace(self, newest=delay, agreeing=agreeing, ticks=known)


def _refutes_shorter(errors: Floats, best: int) -> bool:
    """Return whether the errors (delays,) refute all delays clearly shorter than `best`."""
    refuted = errors > REFUTED_FACTOR * errors[best]
    return bool(refuted[: max(0, best - 2)].all())


class SpeedDelay(DelayEstimate, frozen=True, kw_only=True):
    """Delay of a body's measured speeds behind the commands, by cross-correlation.

    Each candidate predicts the measured speeds of the last 0.8 s with its own gain and offset. The
    best one counts if it predicts them well, and shorter ones do not.
    """

    commanded: tuple[Speeds, ...] = ()  # by tick, newest last
    measured: tuple[Speeds, ...] = ()

    def then(self, state: RobotState, elapsed: int) -> "SpeedDelay":
        """Return the estimate after one more state, `elapsed` ticks after the last."""
        if not elapsed:
            return self
        commanded = (*self.commanded, *(axes(state.sent),) * elapsed)
        now = replace(self, commanded=commanded[-SPEED_TICKS - SPEED_DELAYS + 1 :])
        if not state.link.connected:  # after a gap the delay may be longer
            rest = self.rest_ticks + elapsed if state.sent == ZERO else 0
            return replace(now, measured=(), rest_ticks=rest)
        measured = (*self.measured, *(axes(state.velocity),) * elapsed)[-SPEED_TICKS:]
        now = replace(now, measured=measured)._count_rest(state, elapsed)
        due = state.tick // SPEED_PERIOD_TICKS != (state.tick - elapsed) // SPEED_PERIOD_TICKS
        return now._with_estimate(now._delay()) if due and now.rest_ticks <= REST_TICKS else now

    def _delay(self) -> int | None:
        if len(self.measured) < MIN_SPEED_TICKS:
            return None
        if len(self.commanded) < len(self.measured) + MIN_SPEED_DELAYS - 1:
            return None
        measured = _by_axis(self.measured)
        if float((measured.max(axis=1) - measured.min(axis=1)).max()) < MIN_SPEED_CHANGE:
            return None
        errors, total = _squared_errors(_by_axis(self.commanded), measured)
        best = int(np.argmin(errors))
        sure = errors[best] <= MAX_UNEXPLAINED * total and _refutes_shorter(errors, best)
        return best if sure else None


def _by_axis(speeds: tuple[Speeds, ...]) -> Floats:
    """Return speeds in units of SPEED_SCALE, (axes, ticks)."""
    return np.array(tuple(zip(*speeds, strict=True))) / SPEED_SCALE


def _squared_errors(commanded: Floats, measured: Floats) -> tuple[Floats, float]:
    """Return the squared errors of delays (delays,), and the sum of the squared speed changes."""
    ticks = measured.shape[1]
    views = _windows(commanded, ticks)[::-1][:SPEED_DELAYS]
    models = views - views.mean(axis=2, keepdims=True)  # (delays, axes, ticks)
    changes = measured - measured.mean(axis=1, keepdims=True)  # (axes, ticks)
    products = np.einsum("dat,at->da", models, changes)
    norms = np.maximum(np.einsum("dat,dat->da", models, models), 1e-9)
    total = np.einsum("at,at->a", changes, changes)
    gains = np.clip(products / norms, 0.5, 1.5)
    errors = np.maximum(total - 2 * gains * products + gains * gains * norms, 0.0).sum(axis=1)
    return errors + 1e-3 * ticks, float(total.sum())


def _windows(values: Floats, length: int) -> Floats:
    """Return views of all windows of `length` along the last axis, (windows, ..., length).

    numpy's `sliding_window_view` does the same, but its checks take longer than the estimates.
    """
    shape = (values.shape[-1] - length + 1, *values.shape[:-1], length)
    strides = (values.itemsize, *values.strides)
    return np.ndarray(shape, values.dtype, values, strides=strides)


class TurnDelay(DelayEstimate, frozen=True, kw_only=True):
    """Delay of a lidar's scans behind the odometry, by the turns that both measure.

    Two scans of a room show the turn between them. Each candidate predicts it by the odometry. The
    one that fits the last 1.2 s best counts if it fits well, and shorter ones do not. This needs
    turns that begin or end, walls, and a lidar that covers the full circle.
    """

    scan: LaserScan | None = None  # the newest
    turns: tuple[tuple[int, int, float], ...] = ()  # from tick, to tick, angle [rad]

    def then(
        self, state: RobotState, scan: LaserScan | None, history: PoseHistory, elapsed: int
    ) -> "TurnDelay":
        """Return the estimate after one more state; it ignores a `scan` with a later tick."""
        now, last = self._count_rest(state, elapsed), self.scan
        if scan is None or scan.basis > state.tick or (last and scan.basis <= last.basis):
            return now
        turn = _turn(last, scan) if last else None
        now = replace(now, scan=scan)
        if last is None or turn is None:
            return replace(now, turns=())
        recent = (t for t in self.turns if t[0] > scan.basis - TURN_TICKS)
        now = replace(now, turns=(*recent, (last.basis, scan.basis, turn)))
        return now._with_estimate(_turn_delay(now.turns, history))


def _turn(before: LaserScan, now: LaserScan) -> float | None:
    """Return the lidar's turn between two scans [rad]; None if they do not show it."""
    if before.angle_increment != now.angle_increment or len(before.ranges) != len(now.ranges):
        return None
    older, newer = _profile(before.ranges), _profile(now.ranges)
    step, beams = abs(now.angle_increment), len(newer)
    if not math.isclose(step * beams, math.tau, rel_tol=0.01):
        return None
    max_shift = min(math.ceil(MAX_TURN / step), beams // 2 - 1)
    around = np.concatenate([older[beams - max_shift :], older, older[:max_shift]])
    differences = _windows(around, beams).copy()  # (shifts, beams)
    differences -= newer
    differences *= differences
    np.minimum(differences, MAX_RANGE_DIFFERENCE_M * MAX_RANGE_DIFFERENCE_M, out=differences)
    mismatch = np.add.reduce(differences, axis=1) / beams
    best = int(mismatch.argmin())
    # the number of turns is odd, so that the median is one of them
    if (
        best in (0, 2 * max_shift)
        or mismatch[best] > MAX_MISMATCH * np.partition(mismatch, max_shift)[max_shift]
    ):
        return None
    left, middle, right = mismatch[best - 1 : best + 2]
    curvature = left - 2 * middle + right
    fraction = 0.5 * (left - right) / curvature if curvature > 0 else 0.0
    return float((best - max_shift + fraction) * now.angle_increment)


@lru_cache(maxsize=2)  # each scan is compared with the one before and the one after
def _profile(ranges: bytes) -> Floats:
    """Return the ranges of a scan (n,) [m], clipped to MAX_RANGE_M; nan becomes MAX_RANGE_M."""
    values = np.frombuffer(ranges, "<f4").astype(np.float64)
    return np.maximum(np.fmin(values, MAX_RANGE_M), 0.0)


def _turn_delay(turns: tuple[tuple[int, int, float], ...], history: PoseHistory) -> int | None:
    if len(turns) < MIN_TURNS:
        return None
    begins, ends, seen = (np.array(part, dtype=np.float64) for part in zip(*turns, strict=True))
    if float(seen.max() - seen.min()) < MIN_TURN_CHANGE or not history.ticks:
        return None
    known = np.array(history.ticks, dtype=np.float64)
    if known[0] > begins[0] - TURN_DELAYS:
        return None
    yaws = np.unwrap(np.array([pose.yaw for pose in history.poses]))
    delays = np.arange(TURN_DELAYS, dtype=np.float64)[:, None]
    turned = np.interp(ends - delays, known, yaws) - np.interp(begins - delays, known, yaws)
    errors = ((turned - seen) ** 2).sum(axis=1) + len(turns) * TURN_NOISE * TURN_NOISE
    best = int(np.argmin(errors))
    sure = errors[best] <= MAX_UNEXPLAINED * float(((seen - seen.mean()) ** 2).sum()) + (
        len(turns) * TURN_NOISE * TURN_NOISE
    )
    return best if sure and _refutes_shorter(errors, best) else None


class DataLatency(Struct, frozen=True, kw_only=True):
    """Monitors the latency of the data from body and lidar."""

    speeds: SpeedDelay = SpeedDelay()
    turns: TurnDelay = TurnDelay()
    body_ms: float = 0.0
    lidar_ms: float = 0.0
    body_ticks: int = 0  # with late data
    lidar_ticks: int = 0
    doubt_ms: float = 0.0  # longest recent silence; data may be late by as much
    doubt_ticks: int = 0  # until this doubt ends

    def then(
        self,
        body: BodyDescription,
        state: RobotState,
        scan: LaserScan | None,
        history: PoseHistory,
        elapsed: int,
    ) -> "DataLatency":
        """Return the monitor after one more state, `elapsed` ticks after the last."""
        limits = body.thresholds
        late_ms = limits.late * 1e3
        now = self._doubtful(state, late_ms, elapsed)
        speeds = now.speeds.then(state, elapsed)
        beyond_ms = (speeds.ticks or 0) * TICK_MS - limits.response * 1e3
        body_ms = max(state.link.late_ms or 0.0, beyond_ms, 0.0)
        if speeds.ticks is not None and body_ms < late_ms:
            now = replace(now, doubt_ms=0.0, doubt_ticks=0)
        turns = self.turns.then(state, scan, history, elapsed)
        # a complete scan is half a turn old
        age_ms = 500.0 / body.lidar.rate_hz if body.lidar else 0.0
        behind_ms = (turns.ticks or 0) * TICK_MS - age_ms
        lidar_ms = max(scan.late_ms if scan else 0.0, behind_ms, 0.0)
        return replace(
            now,
            speeds=speeds,
            turns=turns,
            body_ms=body_ms,
            lidar_ms=lidar_ms,
            body_ticks=lasting(self.body_ticks, body_ms >= late_ms, elapsed),
            lidar_ticks=lasting(self.lidar_ticks, lidar_ms >= late_ms, elapsed),
        )

    def late_ticks(self, body: BodyDescription) -> int:
        """Return the latency of the body's data [ticks]; 0 until a cause reports it.

        A guess must not excuse a body that disobeys: one with a stuck wheel looks late as well.
        """
        reported = self.body_ticks >= ticks_of(body.thresholds.late_sustain)
        return math.ceil(self.body_ms / TICK_MS) if reported else 0

    def stop_causes(self, body: BodyDescription) -> tuple[Cause, ...]:
        """Return the causes that stop the body."""
        limit_ms = body.thresholds.reaction_time * 1e3
        return tuple(_cause(code, ms, "") for code, ms in self._late(body) if ms > limit_ms)

    def slow_causes(self, body: BodyDescription) -> tuple[Cause, ...]:
        """Return the causes that halve the speed."""
        limit_ms = body.thresholds.reaction_time * 1e3
        found = self._late(body)
        late = tuple(_cause(code, ms, "; half speed") for code, ms in found if ms <= limit_ms)
        if self.doubt_ticks and "body_late" not in dict(found):
            text = f"the body was silent for {self.doubt_ms:.0f} ms, and may be late; half speed"
            late = (cause("body_late", text), *late)
        return late

    def _doubtful(self, state: RobotState, late_ms: float, elapsed: int) -> "DataLatency":
        """Forget the known latency after a silence, unless the device's clock measures it.

        A line cannot become late without a silence of the same length. After it the body slows
        down, and this change of speed shows the latency.
        """
        silent_ms = state.link.age_ms
        if silent_ms >= late_ms and state.link.late_ms is None:
            longest_ms = max(silent_ms, self.doubt_ms)
            speeds = replace(self.speeds, measured=(), ticks=None, agreeing=0)
            return replace(self, speeds=speeds, doubt_ms=longest_ms, doubt_ticks=DOUBT_TICKS)
        remaining = max(0, self.doubt_ticks - elapsed)
        return replace(self, doubt_ms=self.doubt_ms if remaining else 0.0, doubt_ticks=remaining)

    def _late(self, body: BodyDescription) -> list[tuple[str, float]]:
        sustain = ticks_of(body.thresholds.late_sustain)
        each = (
            ("body_late", self.body_ticks, self.body_ms),
            ("lidar_late", self.lidar_ticks, self.lidar_ms),
        )
        return [(code, ms) for code, ticks, ms in each if ticks >= sustain]


def _cause(code: str, ms: float, suffix: str) -> Cause:
    rounded = ROUND_MS * round(ms / ROUND_MS)
    return cause(code, f"{cause(code).text}, by {rounded:.0f} ms{suffix}")
