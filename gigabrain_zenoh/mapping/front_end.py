"""SLAM front end: places each scan in the map of the last few keyframes.

It closes no loops. Its own frame is smooth and drifts, and a correction never moves it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import (
    between,
    compose,
    inverse_of,
    turned,
    wrapped,
)
from gigabrain_zenoh.mapping.keyframes import KeyframePolicy, Scan, seen_through, thinned
from gigabrain_zenoh.mapping.local_map import LocalMap, build, image_buffer
from gigabrain_zenoh.mapping.scan_matching import IcpResult, SearchResult, Window, icp, search

CELL_M, SIGMA_M = 0.05, 0.08  # of the likelihood image
GATE_M = 0.3  # of ICP
ICP_POINTS = 360  # of a scan, for ICP
MIN_INLIERS = 0.35  # share of the points; with fewer ICP has failed
MAX_SLIDE_M = 0.4  # from the start of ICP; if it moves farther, it has slid away
MIN_SEARCH_SCORE = 0.35  # of a search that counts without ICP
MIN_ICP_SCORE = 0.2  # of a search from which ICP may start
MIN_WIDE_SCORE, MIN_WIDE_INLIERS = 0.55, 0.6  # of a wide search, to be believed
WIDE_WINDOW = Window(1.0, 0.6)  # searched if the scan fits nowhere near the guess
WIDE_POINTS = 45  # of a scan, for a wide search; few, as ICP and the view confirm it
CLEAR_SCORE = 0.85  # better matches are not doubted
MAX_SEEN_THROUGH = 0.2  # share of the map's points in view; more of them contradict the pose
MIN_SEEN_DECREASE = 0.1  # of that share, by a wide search
MIN_SCORE_GAIN = 0.1  # for a place that odometry does not lead to
MAX_OFF_GUESS_M = 0.3  # a match farther from the guess may have slid over known area
MIN_INLIER_RATIO = 0.5  # of the match at the guess to one that may have slid
MIN_GUESS_INLIERS = 0.15  # share of the points, for a match at the guess
START_TURNS = (-1.5, -0.75, 0.75, 1.5)  # of ICP, in standard deviations of odometry's turn
MIN_TURNED_INLIERS = 0.05  # share of the points, for a match after such a turn
MIN_POINTS = 20  # scans of fewer points are not matched
MAX_SQUARED_DEVIATION = 0.6  # of a match from odometry whose noise is known
MAX_SETTLE_SHIFT, MIN_SETTLE_INLIERS = (0.1, 0.03), 0.8  # [m], [rad]; share of the points
MAX_SETTLE_RMS_M = 0.06
NO_NOISE = np.zeros((3, 3))  # covariance of odometry at a match

Kind = Literal["matched", "searched", "recovered", "odometry", "broken"]

BREAK_MISSES, FAR_M, FAR_RAD = 3, 0.5, 0.5  # misses that break a sequence after this motion,
BREAK_MISSES_NEAR = 30  # and without motion
UNKNOWN_COVARIANCE = np.diag((10.0, 10.0, np.pi)) ** 2  # of odometry over a break


@dataclass(frozen=True, slots=True)
class ScanMatch:
    """Pose of a scan, and how it was found.

    matched: by ICP. searched: by search alone. recovered: far from odometry, by a wide search.
    odometry: by odometry alone. broken: not linked to the scans before.
    """

    pose: Floats  # in the front end's own frame
    covariance: Floats  # (3, 3), of x, y and yaw in that frame, against the local map
    kind: Kind
    score: float  # 0 to 1, of the search
    inliers: float  # share of the points that ICP matched to lines
    guided: bool = False  # by odometry of known covariance that agrees


@dataclass(frozen=True, slots=True)
class DriftSinceMatch:
    """Motion by odometry since a scan was matched."""

    misses: int = 0  # scans in a row that fit one another, but not the map
    travel: float = 0.0  # [m]
    turn: float = 0.0  # [rad]
    blind: bool = False  # some scans showed too little to match, so odometry may be right

    def moved(self, delta: Floats, blind: bool) -> "DriftSinceMatch":
        """Return the state after another step `delta` (3,) of odometry."""
        travel = self.travel + float(np.hypot(delta[0], delta[1]))
        turn = self.turn + abs(float(delta[2]))
        return DriftSinceMatch(self.misses, travel, turn, self.blind or blind)

    def missed(self, fits_last: bool) -> "DriftSinceMatch":
        """Return the state after an unmatched scan; `fits_last`: it fits the last unmatched one."""
        return replace(self, misses=self.misses + 1 if fits_last else 1)

    @property
    def covariance(self) -> Floats:
        """The covariance (3, 3) of odometry since then; large, as wheels slip."""
        away, turn = 0.1 + 0.2 * self.travel, 0.1 + 0.3 * self.turn
        return np.diag((away**2, away**2, turn**2))

    @property
    def information(self) -> Floats:
        """The inverse of the covariance."""
        return inverse_of(self.covariance)

    @property
    def broken(self) -> bool:
        """Return whether the robot was carried off, so that nothing links the two parts.

        Scans that fit neither the map nor one another prove nothing: leaves in the wind, a slope.
        """
        return (self.misses >= BREAK_MISSES and self.far) or self.misses >= BREAK_MISSES_NEAR

    @property
    def far(self) -> bool:
        """Return whether the last matched scan may be out of sight by now."""
        return self.travel > FAR_M or self.turn > FAR_RAD

    def after_break(self) -> Floats:
        """Return the covariance of the link over a break."""
        return self.covariance if self.blind else UNKNOWN_COVARIANCE

    @property
    def window(self) -> Window:
        """The search window, which grows with the distance driven by odometry."""
        effort = min(1.0, self.travel / 0.5 + self.turn / 0.3)
        return Window(0.15 + 0.2 * effort, 0.12 + 0.23 * effort)


class FrontEnd:
    """Tracks the robot from scan to scan. The first scan lies at `pose`."""

    def __init__(self, spacing: KeyframePolicy, pose: Floats) -> None:
        self._spacing = spacing
        self._scans: list[Scan] = []
        self._poses: list[Floats] = []
        self._local: LocalMap | None = None
        self._buffer, self._spare_buffer = image_buffer(CELL_M), image_buffer(CELL_M)
        self._drift = DriftSinceMatch()
        self._missed: tuple[Scan, Floats] | None = None  # the last unmatched scan, and its pose
        self._noise: Floats | None = NO_NOISE  # of odometry since the last match; None if unknown
        self.pose = pose

    def add(self, scan: Scan, delta: Floats, noise: Floats | None = None) -> tuple[ScanMatch, bool]:
        """Match a scan after a step `delta` (3,) of odometry; return also whether to keep it.

        `noise` (3, 3) is the covariance of `delta` in its own frame, if it is known.
        """
        guess = compose(self.pose, delta)
        self._drift = self._drift.moved(delta, len(scan.points) < MIN_POINTS)
        self._noise = self._accumulated(noise, delta)
        if self._local is None:
            match = ScanMatch(guess, self._drift.covariance, "matched", 1.0, 1.0)
        else:
            match = self._match(self._local, scan, guess)
        self.pose = match.pose
        far = match.kind == "broken" or self._needs_keyframe()
        if match.kind == "odometry":
            return match, self._drift.far and far
        self._drift, self._noise, self._missed = DriftSinceMatch(), NO_NOISE, None
        return match, far

    def place(self, pose: Floats) -> None:
        """Move the robot to about `pose`, and forget the odometry until now."""
        self.pose, self._noise = pose, None

    def keep(self, scan: Scan, alone: bool) -> None:
        """Add the newest scan to the local map; if `alone`, it replaces the map."""
        scans, poses = ([], []) if alone else (self._scans, self._poses)
        self.restart([*scans, scan], [*poses, self.pose])

    def restart(self, scans: Sequence[Scan], poses: Sequence[Floats]) -> None:
        """Replace the local map by these scans, the nearest last."""
        first = self._spacing.first(np.array(poses))
        self._scans, self._poses = list(scans[first:]), list(poses[first:])
        placed = np.array(self._poses)
        self._local = build(self._scans, placed, self.pose, CELL_M, SIGMA_M, self._buffer)

    def settle(
        self, scan: Scan, scans: Sequence[Scan], poses: Sequence[Floats], expected: ScanMatch
    ) -> ScanMatch | None:
        """Replace the local map by these scans if the newest scan fits them.

        `expected` is the expected match, with its covariance. None if the scan does not fit.
        """
        local = build(scans, np.array(poses), expected.pose, CELL_M, SIGMA_M, self._spare_buffer)
        prior = inverse_of(expected.covariance)
        fit = _fit(local, scan, expected.pose, expected.pose, prior)
        x, y, yaw = wrapped(fit.pose - expected.pose).tolist()
        if np.hypot(x, y) > MAX_SETTLE_SHIFT[0] or abs(yaw) > MAX_SETTLE_SHIFT[1]:
            return None
        if fit.inliers < MIN_SETTLE_INLIERS or fit.rms > MAX_SETTLE_RMS_M:
            return None
        self._scans, self._poses, self._local = list(scans), list(poses), local
        self._buffer, self._spare_buffer = self._spare_buffer, self._buffer
        self.pose = wrapped(fit.pose)
        covariance = inverse_of(fit.information + prior)
        return replace(expected, pose=self.pose, covariance=covariance, inliers=fit.inliers)

    @property
    def held(self) -> tuple[list[Scan], list[Floats]]:
        """The scans of the local map, and their poses in the front end's frame."""
        return self._scans, self._poses

    def _match(self, local: LocalMap, scan: Scan, guess: Floats) -> ScanMatch:
        if len(scan.points) < MIN_POINTS:
            return ScanMatch(guess, self._drift.covariance, "odometry", 0.0, 0.0)
        found = search(local.image, scan.points, guess, self._drift.window)
        if self._noise is not None:
            prior = inverse_of(turned(self._noise, float(guess[2])))
            fit = _fit(local, scan, found.pose, guess, prior)
            if fit.inliers >= MIN_INLIERS and _agrees(fit.pose - guess, prior):
                return _icp_match(fit, found, prior, "matched", guided=True)
        prior = self._drift.information
        fit = _fit(local, scan, found.pose, guess, prior)
        match = _combined(fit, found, prior, self._drift.covariance)
        if match and match.score > CLEAR_SCORE:
            return match
        return self._match_doubtful(local, scan, guess, found, match)

    def _match_doubtful(
        self,
        local: LocalMap,
        scan: Scan,
        guess: Floats,
        found: SearchResult,
        match: ScanMatch | None,
    ) -> ScanMatch:
        """Match a scan that fits badly, by the share of the map that it looks through.

        A scan of mostly new area fits better if it slides back over known area: a good fit proves
        nothing. Odometry is kept until the scan contradicts it.
        """
        through = seen_through(
            local.buckets.points, scan.points, match.pose if match else wrapped(guess)
        )
        believed = match is not None and not through > MAX_SEEN_THROUGH
        if match and believed and _distance(match.pose, guess) <= MAX_OFF_GUESS_M:
            return match
        led = self._match_guess(local, scan, guess, found)
        if match and believed:
            return led if led and led.inliers > MIN_INLIER_RATIO * match.inliers else match
        if led:
            return led
        if not match:
            led, through = self._match_turned(local, scan, guess, found, through)
            if led:
                return led
        if not through < MAX_SEEN_THROUGH:
            min_score = match.score + MIN_SCORE_GAIN if match else 0.0
            match = self._recover(local, scan, guess, min_score, through) or match
        return match or self._miss(scan, guess, found)

    def _match_turned(
        self, local: LocalMap, scan: Scan, guess: Floats, found: SearchResult, unturned: float
    ) -> tuple[ScanMatch | None, float]:
        """Match with other turns of odometry; return also the smallest share looked through,
        which is `unturned` without these turns.

        A small error of yaw puts distant points out of ICP's reach, and beams through walls.
        """
        prior = self._drift.information
        turn = float(np.sqrt(self._drift.covariance[2, 2]))
        starts = (found.pose, *(np.add(guess, (0.0, 0.0, share * turn)) for share in START_TURNS))
        best, smallest = None, unturned
        for start in starts:
            fit = _fit(local, scan, start, guess, prior)
            through = seen_through(local.buckets.points, scan.points, fit.pose)
            if not through < MAX_SEEN_THROUGH or _distance(fit.pose, guess) > MAX_SLIDE_M:
                continue
            smallest = min(through, smallest)
            if fit.inliers >= max(best.inliers if best else 0.0, MIN_TURNED_INLIERS):
                best = fit
        return (_icp_match(best, found, prior, "matched") if best else None), smallest

    def _match_guess(
        self, local: LocalMap, scan: Scan, guess: Floats, found: SearchResult
    ) -> ScanMatch | None:
        """Match at odometry's guess; None if the scan contradicts it or shows little known area."""
        prior = self._drift.information
        fit = _fit(local, scan, guess, guess, prior)
        if fit.inliers < MIN_GUESS_INLIERS or _distance(fit.pose, guess) > MAX_SLIDE_M:
            return None
        if not seen_through(local.buckets.points, scan.points, fit.pose) < MAX_SEEN_THROUGH:
            return None
        return _icp_match(fit, found, prior, "matched")

    def _recover(
        self, local: LocalMap, scan: Scan, guess: Floats, min_score: float, through: float
    ) -> ScanMatch | None:
        """Search widely around the guess and the last pose for a clear match.

        It must score `min_score`, and look through less than the share `through` (NaN: unknown).
        """
        min_score = max(min_score, MIN_WIDE_SCORE)
        points = thinned(scan.points, WIDE_POINTS)
        results = [
            search(local.image, points, at, WIDE_WINDOW, min_score) for at in (guess, self.pose)
        ]
        found = max(results, key=lambda place: place.score)
        if found.score < min_score:
            return None
        prior = inverse_of(UNKNOWN_COVARIANCE)
        fit = _fit(local, scan, found.pose, found.pose, prior)
        if fit.inliers < MIN_WIDE_INLIERS or _distance(fit.pose, found.pose) > MAX_SLIDE_M:
            return None
        if seen_through(local.buckets.points, scan.points, fit.pose) > through - MIN_SEEN_DECREASE:
            return None
        return _icp_match(fit, found, prior, "recovered")

    def _miss(self, scan: Scan, guess: Floats, found: SearchResult) -> ScanMatch:
        """Continue by odometry alone until the sequence is broken."""
        self._drift = self._drift.missed(self._fits_last_miss(scan, guess))
        self._missed = scan, guess
        if self._drift.broken:
            return ScanMatch(guess, self._drift.after_break(), "broken", found.score, 0.0)
        return ScanMatch(guess, self._drift.covariance, "odometry", found.score, 0.0)

    def _fits_last_miss(self, scan: Scan, guess: Floats) -> bool:
        """Return whether the scan fits the last unmatched one."""
        if self._missed is None:
            return False
        before, pose = self._missed
        local = build([before], pose[None], pose, CELL_M, SIGMA_M)
        found = search(local.image, scan.points, guess, self._drift.window)
        fit = _fit(local, scan, found.pose, guess, self._drift.information)
        return fit.inliers >= MIN_WIDE_INLIERS

    def _accumulated(self, noise: Floats | None, delta: Floats) -> Floats | None:
        """Return the covariance of odometry since the last match, in the axes of the new pose."""
        if noise is None or self._noise is None:
            return None
        if self._noise is not NO_NOISE:
            lever = np.eye(3)
            lever[0, 2], lever[1, 2] = -delta[1], delta[0]
            noise = lever @ self._noise @ lever.T + noise
        return turned(noise, -float(delta[2]))

    def _needs_keyframe(self) -> bool:
        if not self._poses:
            return True
        x, y, yaw = between(self._poses[-1], self.pose).tolist()
        return math.hypot(x, y) > self._spacing.travel or abs(yaw) > self._spacing.turn


def _agrees(off: Floats, prior: Floats) -> bool:
    """Return whether a match that is `off` (3,) agrees with odometry of information `prior`."""
    off = wrapped(off)
    return bool(off @ prior @ off < MAX_SQUARED_DEVIATION)


def _fit(local: LocalMap, scan: Scan, start: Floats, guess: Floats, prior: Floats) -> IcpResult:
    return icp(local.buckets, thinned(scan.points, ICP_POINTS), start, GATE_M, prior, guess)


def _combined(
    fit: IcpResult, found: SearchResult, prior: Floats, covariance: Floats
) -> ScanMatch | None:
    """Return the match by ICP, else that by search; None if both fail."""
    held = found.score > MIN_ICP_SCORE and _distance(fit.pose, found.pose) <= MAX_SLIDE_M
    if held and fit.inliers >= MIN_INLIERS:
        return _icp_match(fit, found, prior, "matched")
    if found.score > MIN_SEARCH_SCORE:
        return ScanMatch(wrapped(found.pose), covariance, "searched", found.score, fit.inliers)
    return None


def _icp_match(
    fit: IcpResult, found: SearchResult, prior: Floats, kind: Kind, *, guided: bool = False
) -> ScanMatch:
    covariance = inverse_of(fit.information + prior)
    return ScanMatch(wrapped(fit.pose), covariance, kind, found.score, fit.inliers, guided)


def _distance(one: Floats, other: Floats) -> float:
    return float(np.hypot(*(one - other)[:2]))
