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

CELL, SIGMA = 0.05, 0.08  # [m], of the likelihood image
GATE = 0.3  # [m]
POINTS = 360  # of a scan are enough for ICP
INLIERS = 0.35  # share of the points, below it ICP has failed
MOVED = 0.4  # [m], ICP that went farther from where it began has slid away
SCORE = 0.35  # a search below it has failed
MIN_SCORE = 0.2  # of a search that ICP may begin from
WIDE_SCORE, WIDE_INLIERS = 0.55, 0.6  # what it takes to believe a wide search
WIDE = Window(1.0, 0.6)  # where to look when the scan does not fit where it should
WIDELY = 45  # points of a scan are enough for that, as ICP and what is seen have to agree
CLEAR = 0.85  # score, from here on nothing is doubted
WRONG = 0.2  # share of what should be in view that is looked through: not the place
CLEARER = 0.1  # so much less of it
BETTER = 0.1  # score: so much more, for a place that odometry does not lead to
SLID = 0.3  # [m], a match so far from where odometry leads may have slid over what is known
ENOUGH_INLIERS = 0.5  # of its inliers, for what odometry leads to instead
MIN_INLIERS = 0.15  # share of the points, to go by odometry and them
TURNS = (-1.5, -0.75, 0.75, 1.5)  # standard deviations of odometry's turn, to begin ICP from
MIN_TURNED_INLIERS = 0.05  # share of the points, of the same after a turn
MIN_POINTS = 20  # points, with fewer there is nothing to match
CONTRADICTED = 0.6  # squared deviations: a match that pulls odometry farther speaks against it
SETTLED, SETTLED_INLIERS = (0.1, 0.03), 0.8  # [m] and [rad]; share of the points
SETTLED_RMS = 0.06  # [m]
UNMOVED = np.zeros((3, 3))

Kind = Literal["matched", "searched", "recovered", "odometry", "broken"]

MISSES, MISSED_TRAVEL, MISSED_TURN = 3, 0.5, 0.5  # scans, [m], [rad]: after these it is broken,
MISSES_STANDING = 30  # or after so many scans
UNKNOWN = np.diag((10.0, 10.0, np.pi)) ** 2  # covariance of a link that nothing is known of


@dataclass(frozen=True, slots=True)
class ScanMatch:
    """Pose of a scan, and how it was found.

    matched: by ICP. searched: by search alone. recovered: far from where odometry had it.
    odometry: by odometry alone. broken: no longer joined to what was before.
    """

    pose: Floats  # in the front end's own frame
    covariance: Floats  # (3, 3), of x, y and yaw in that frame, against the local map
    kind: Kind
    score: float  # 0 to 1, of the search
    inliers: float  # share of the points that ICP laid onto lines
    guided: bool = False  # by odometry whose covariance is known, and does not speak against it


@dataclass(frozen=True, slots=True)
class DriftSinceMatch:
    """Motion by odometry since a scan was matched."""

    misses: int = 0  # scans in a row that fit one another, but not the map
    travel: float = 0.0  # [m]
    turn: float = 0.0  # [rad]
    blind: bool = False  # there was nothing to match for a while, so odometry may be right

    def moved(self, delta: Floats, blind: bool) -> "DriftSinceMatch":
        """After odometry has moved by `delta` (3,) once more."""
        travel = self.travel + float(np.hypot(delta[0], delta[1]))
        turn = self.turn + abs(float(delta[2]))
        return DriftSinceMatch(self.misses, travel, turn, self.blind or blind)

    def missed(self, fits: bool) -> "DriftSinceMatch":
        """Return the state after a scan that was not matched; `fits` the one missed before it."""
        return replace(self, misses=self.misses + 1 if fits else 1)

    @property
    def covariance(self) -> Floats:
        """The covariance of odometry since then; generous, as wheels slip."""
        away, turn = 0.1 + 0.2 * self.travel, 0.1 + 0.3 * self.turn
        return np.diag((away**2, away**2, turn**2))

    @property
    def information(self) -> Floats:
        """The inverse of the covariance."""
        return inverse_of(self.covariance)

    @property
    def broken(self) -> bool:
        """Return whether the robot was carried off, so that nothing joins the two parts.

        Scans that fit neither the map nor one another prove nothing, such as leaves in the wind or
        a slope.
        """
        return (self.misses >= MISSES and self.far) or self.misses >= MISSES_STANDING

    @property
    def far(self) -> bool:
        """Return whether the last matched scan may be out of sight by now."""
        return self.travel > MISSED_TRAVEL or self.turn > MISSED_TURN

    def after_break(self) -> Floats:
        """Return the covariance of the link over a break."""
        return self.covariance if self.blind else UNKNOWN

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
        self._room, self._spare = image_buffer(CELL), image_buffer(CELL)
        self._adrift = DriftSinceMatch()
        self._missed: tuple[Scan, Floats] | None = None  # the last scan not matched, and where
        self._noise: Floats | None = UNMOVED  # of odometry since a scan was matched
        self.pose = pose

    def add(self, scan: Scan, delta: Floats, noise: Floats | None = None) -> tuple[ScanMatch, bool]:
        """Match a scan after odometry has moved by `delta`; return also whether to keep it.

        `noise` is the covariance of `delta` in its own frame, if it is known.
        """
        guess = compose(self.pose, delta)
        self._adrift = self._adrift.moved(delta, len(scan.points) < MIN_POINTS)
        self._noise = self._summed(noise, delta)
        if self._local is None:
            match = ScanMatch(guess, self._adrift.covariance, "matched", 1.0, 1.0)
        else:
            match = self._match(self._local, scan, guess)
        self.pose = match.pose
        far = match.kind == "broken" or self._far_enough()
        if match.kind == "odometry":
            return match, self._adrift.far and far
        self._adrift, self._noise, self._missed = DriftSinceMatch(), UNMOVED, None
        return match, far

    def place(self, pose: Floats) -> None:
        """Move the robot to about `pose`; odometry until now no longer counts."""
        self.pose, self._noise = pose, None

    def keep(self, scan: Scan, alone: bool) -> None:
        """Make the scan that was added last part of the local map, or all of it."""
        scans, poses = ([], []) if alone else (self._scans, self._poses)
        self.restart([*scans, scan], [*poses, self.pose])

    def restart(self, scans: Sequence[Scan], poses: Sequence[Floats]) -> None:
        """Match to these scans from now on, the nearest of them last."""
        first = self._spacing.first(np.array(poses))
        self._scans, self._poses = list(scans[first:]), list(poses[first:])
        placed = np.array(self._poses)
        self._local = build(self._scans, placed, self.pose, CELL, SIGMA, self._room)

    def settle(
        self, scan: Scan, scans: Sequence[Scan], poses: Sequence[Floats], about: ScanMatch
    ) -> ScanMatch | None:
        """Match to these scans from now on, if the scan that was added last fits them.

        `about` is where the scan lies among them, and how uncertain that is.
        """
        local = build(scans, np.array(poses), about.pose, CELL, SIGMA, self._spare)
        prior = inverse_of(about.covariance)
        fit = _fit(local, scan, about.pose, about.pose, prior)
        x, y, yaw = wrapped(fit.pose - about.pose).tolist()
        if np.hypot(x, y) > SETTLED[0] or abs(yaw) > SETTLED[1]:
            return None
        if fit.inliers < SETTLED_INLIERS or fit.rms > SETTLED_RMS:
            return None
        self._scans, self._poses, self._local = list(scans), list(poses), local
        self._room, self._spare = self._spare, self._room
        self.pose = wrapped(fit.pose)
        covariance = inverse_of(fit.information + prior)
        return replace(about, pose=self.pose, covariance=covariance, inliers=fit.inliers)

    @property
    def held(self) -> tuple[list[Scan], list[Floats]]:
        """The scans of the local map, and their poses in the front end's frame."""
        return self._scans, self._poses

    def _match(self, local: LocalMap, scan: Scan, guess: Floats) -> ScanMatch:
        if len(scan.points) < MIN_POINTS:
            return ScanMatch(guess, self._adrift.covariance, "odometry", 0.0, 0.0)
        found = search(local.image, scan.points, guess, self._adrift.window)
        if self._noise is not None:
            prior = inverse_of(turned(self._noise, float(guess[2])))
            fit = _fit(local, scan, found.pose, guess, prior)
            if fit.inliers >= INLIERS and _likely(fit.pose - guess, prior):
                return _matched(fit, found, prior, "matched", guided=True)
        prior = self._adrift.information
        fit = _fit(local, scan, found.pose, guess, prior)
        match = _plain(fit, found, prior, self._adrift.covariance)
        if match and match.score > CLEAR:
            return match
        return self._doubted(local, scan, guess, found, match)

    def _doubted(
        self,
        local: LocalMap,
        scan: Scan,
        guess: Floats,
        found: SearchResult,
        match: ScanMatch | None,
    ) -> ScanMatch:
        """Match a scan of which little fits, by the share of the map that it looks through.

        A scan that shows mostly new area fits better the further it slides back over known area, so
        a good fit proves nothing. Odometry is kept until it is contradicted.
        """
        wrong = seen_through(
            local.buckets.points, scan.points, match.pose if match else wrapped(guess)
        )
        believed = match is not None and not wrong > WRONG
        if match and believed and _apart(match.pose, guess) <= SLID:
            return match
        near = self._led(local, scan, guess, found)
        if match and believed:
            return near if near and near.inliers > ENOUGH_INLIERS * match.inliers else match
        if near:
            return near
        if not match:
            near, wrong = self._turned(local, scan, guess, found, wrong)
            if near:
                return near
        if not wrong < WRONG:
            least = match.score + BETTER if match else 0.0
            match = self._recover(local, scan, guess, least, wrong) or match
        return match or self._lost(scan, guess, found)

    def _turned(
        self, local: LocalMap, scan: Scan, guess: Floats, found: SearchResult, wrong: float
    ) -> tuple[ScanMatch | None, float]:
        """Match with other turns of odometry; return also the least share looked through.

        A small turn puts distant points out of ICP's reach, and makes beams pass through walls.
        """
        prior = self._adrift.information
        turn = float(np.sqrt(self._adrift.covariance[2, 2]))
        starts = (found.pose, *(np.add(guess, (0.0, 0.0, share * turn)) for share in TURNS))
        best, least = None, wrong
        for start in starts:
            fit = _fit(local, scan, start, guess, prior)
            through = seen_through(local.buckets.points, scan.points, fit.pose)
            if not through < WRONG or _apart(fit.pose, guess) > MOVED:
                continue
            least = min(through, least)
            if fit.inliers >= max(best.inliers if best else 0.0, MIN_TURNED_INLIERS):
                best = fit
        return (_matched(best, found, prior, "matched") if best else None), least

    def _led(
        self, local: LocalMap, scan: Scan, guess: Floats, found: SearchResult
    ) -> ScanMatch | None:
        """Match where odometry leads; None if the scan contradicts it or shows little known."""
        prior = self._adrift.information
        fit = _fit(local, scan, guess, guess, prior)
        if fit.inliers < MIN_INLIERS or _apart(fit.pose, guess) > MOVED:
            return None
        if not seen_through(local.buckets.points, scan.points, fit.pose) < WRONG:
            return None
        return _matched(fit, found, prior, "matched")

    def _recover(
        self, local: LocalMap, scan: Scan, guess: Floats, least: float, wrong: float
    ) -> ScanMatch | None:
        """Search widely around the guess and the last pose for a match beyond doubt.

        It must score at least `least`, and look through less than `wrong`, if that is known.
        """
        least = max(least, WIDE_SCORE)
        points = thinned(scan.points, WIDELY)
        places = [search(local.image, points, at, WIDE, least) for at in (guess, self.pose)]
        found = max(places, key=lambda place: place.score)
        if found.score < least:
            return None
        prior = inverse_of(UNKNOWN)
        fit = _fit(local, scan, found.pose, found.pose, prior)
        if fit.inliers < WIDE_INLIERS or _apart(fit.pose, found.pose) > MOVED:
            return None
        if seen_through(local.buckets.points, scan.points, fit.pose) > wrong - CLEARER:
            return None
        return _matched(fit, found, prior, "recovered")

    def _lost(self, scan: Scan, guess: Floats, found: SearchResult) -> ScanMatch:
        """Continue by odometry alone, until the sequence counts as broken."""
        self._adrift = self._adrift.missed(self._fits_missed(scan, guess))
        self._missed = scan, guess
        if self._adrift.broken:
            return ScanMatch(guess, self._adrift.after_break(), "broken", found.score, 0.0)
        return ScanMatch(guess, self._adrift.covariance, "odometry", found.score, 0.0)

    def _fits_missed(self, scan: Scan, guess: Floats) -> bool:
        """Return whether the scan fits the one that was not matched before it."""
        if self._missed is None:
            return False
        before, pose = self._missed
        local = build([before], pose[None], pose, CELL, SIGMA)
        found = search(local.image, scan.points, guess, self._adrift.window)
        fit = _fit(local, scan, found.pose, guess, self._adrift.information)
        return fit.inliers >= WIDE_INLIERS

    def _summed(self, noise: Floats | None, delta: Floats) -> Floats | None:
        """Return the covariance of odometry since the last match, in the present pose's axes."""
        if noise is None or self._noise is None:
            return None
        if self._noise is not UNMOVED:
            lever = np.eye(3)
            lever[0, 2], lever[1, 2] = -delta[1], delta[0]
            noise = lever @ self._noise @ lever.T + noise
        return turned(noise, -float(delta[2]))

    def _far_enough(self) -> bool:
        if not self._poses:
            return True
        x, y, yaw = between(self._poses[-1], self.pose).tolist()
        return math.hypot(x, y) > self._spacing.travel or abs(yaw) > self._spacing.turn


def _likely(off: Floats, prior: Floats) -> bool:
    """Return whether odometry of this information may be `off` by that much, in the same axes."""
    off = wrapped(off)
    return bool(off @ prior @ off < CONTRADICTED)


def _fit(local: LocalMap, scan: Scan, start: Floats, guess: Floats, prior: Floats) -> IcpResult:
    return icp(local.buckets, thinned(scan.points, POINTS), start, GATE, prior, guess)


def _plain(
    fit: IcpResult, found: SearchResult, prior: Floats, covariance: Floats
) -> ScanMatch | None:
    """Return the match by search and ICP, or None if both have failed."""
    near = found.score > MIN_SCORE and _apart(fit.pose, found.pose) <= MOVED
    if near and fit.inliers >= INLIERS:
        return _matched(fit, found, prior, "matched")
    if found.score > SCORE:
        return ScanMatch(wrapped(found.pose), covariance, "searched", found.score, fit.inliers)
    return None


def _matched(
    fit: IcpResult, found: SearchResult, prior: Floats, kind: Kind, *, guided: bool = False
) -> ScanMatch:
    covariance = inverse_of(fit.information + prior)
    return ScanMatch(wrapped(fit.pose), covariance, kind, found.score, fit.inliers, guided)


def _apart(one: Floats, other: Floats) -> float:
    return float(np.hypot(*(one - other)[:2]))
