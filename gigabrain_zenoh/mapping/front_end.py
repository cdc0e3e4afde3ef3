"""The front end: where each scan lies in the map of the last few keyframes.

It knows nothing of loops: its own frame is smooth and drifts, and a correction never moves it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gigabrain_zenoh.mapping.local_map import LocalMap, build
from gigabrain_zenoh.mapping.matching import Fit, Found, Window, icp, search, thinned
from gigabrain_zenoh.mapping.points import Scan
from gigabrain_zenoh.mapping.se2 import (
    Floats,
    between,
    compose,
    inverse_of,
    rotation,
    turned,
    wrapped,
)

Kind = Literal["matched", "searched", "recovered", "odometry", "broken"]

CELL, SIGMA = 0.05, 0.08  # [m], of the likelihood image
GATE = 0.3  # [m]
POINTS = 360  # of a scan are enough for ICP
INLIERS = 0.35  # share of the points, below it ICP has failed
MOVED = 0.4  # [m], ICP that went farther from where it began has slid away
SCORE = 0.35  # a search below it has failed
LEAST_SCORE = 0.2  # of a search that ICP may begin from
SURE_SCORE, SURE_INLIERS = 0.55, 0.6  # what it takes to believe a wide search
WIDE = Window(1.0, 0.6)  # where to look when the scan does not fit where it should
FEW = 20  # points, with fewer there is nothing to match
MISSES, MISSED_TRAVEL, MISSED_TURN = 3, 0.5, 0.5  # scans, [m], [rad]: after these it is broken,
MISSES_STANDING = 30  # or after so many scans
CONTRADICTED = 16.3  # 99.9 % of chi-square with three degrees of freedom: odometry was wrong
UNMOVED = np.zeros((3, 3))
UNKNOWN = np.diag((10.0, 10.0, np.pi)) ** 2  # covariance of a link that nothing is known of


@dataclass(frozen=True, slots=True)
class Spacing:
    """When a scan becomes a keyframe, and how many of them the local map holds."""

    travel: float = 0.2  # [m]
    turn: float = 0.26  # [rad]
    fewest: int = 8  # keyframes, however far apart they are
    most: int = 20  # keyframes, however near
    length: float = 4.0  # [m] of travel, between the two


@dataclass(frozen=True, slots=True)
class Match:
    """Where the front end puts a scan, and how it came to that.

    matched: by ICP. searched: by search alone. recovered: far from where odometry had it.
    odometry: by odometry alone. broken: no longer joined to what was before.
    """

    pose: Floats  # in the front end's own frame
    covariance: Floats  # (3, 3), of x, y and yaw in that frame, against the local map
    kind: Kind
    score: float  # 0 to 1, of the search
    inliers: float  # share of the points that ICP laid onto lines
    guided: bool = False  # by odometry whose covariance is known, and does not speak against it


class FrontEnd:
    """Tracks the robot from scan to scan. The first scan lies at `pose`."""

    def __init__(self, spacing: Spacing, pose: Floats) -> None:
        self._spacing = spacing
        self._scans: list[Scan] = []
        self._poses: list[Floats] = []
        self._local: LocalMap | None = None
        self._adrift = _Adrift()
        self._noise: Floats | None = UNMOVED  # of odometry since a scan was matched
        self.pose = pose

    def add(self, scan: Scan, delta: Floats, noise: Floats | None = None) -> tuple[Match, bool]:
        """Where the scan lies, after odometry has moved by `delta`; and whether to keep it.

        `noise` is the covariance of `delta` in its own frame, if it is known.
        """
        guess = compose(self.pose, delta)
        self._adrift = self._adrift.moved(delta, len(scan.points) < FEW)
        self._noise = self._summed(noise, delta)
        if self._local is None:
            match = Match(guess, self._adrift.covariance, "matched", 1.0, 1.0)
        else:
            match = self._match(self._local, scan, guess)
        self.pose = match.pose
        far = match.kind == "broken" or self._far_enough()
        if match.kind == "odometry":
            return match, self._adrift.far and far
        self._adrift, self._noise = _Adrift(), UNMOVED
        return match, far

    def place(self, pose: Floats) -> None:
        """The robot is about here, and odometry until now says nothing of it."""
        self.pose, self._noise = pose, None

    def keep(self, scan: Scan, alone: bool) -> None:
        """Make the scan that was added last part of the local map, or all of it."""
        scans, poses = ([], []) if alone else (self._scans, self._poses)
        self.restart([*scans, scan], [*poses, self.pose])

    def restart(self, scans: Sequence[Scan], poses: Sequence[Floats]) -> None:
        """Match to these scans from now on, the nearest of them last."""
        first = _first(np.array(poses), self._spacing)
        self._scans, self._poses = list(scans[first:]), list(poses[first:])
        self._local = build(self._scans, np.array(self._poses), self.pose, CELL, SIGMA)

    @property
    def held(self) -> tuple[list[Scan], list[Floats]]:
        """The scans of the local map, and where they are in the front end's frame."""
        return self._scans, self._poses

    def _match(self, local: LocalMap, scan: Scan, guess: Floats) -> Match:
        if len(scan.points) < FEW:
            return Match(guess, self._adrift.covariance, "odometry", 0.0, 0.0)
        covariance = self._adrift.covariance
        found = search(local.image, scan.points, guess, _window(self._adrift))
        if self._noise is not None:
            known = turned(self._noise, float(guess[2]))
            fit = _fit(local, scan, found, guess, known)
            if fit.inliers >= INLIERS and _likely(fit.pose - guess, known):
                return replace(_matched(fit, found, known, "matched"), guided=True)
        fit = _fit(local, scan, found, guess, covariance)
        near = found.score > LEAST_SCORE and _apart(fit.pose, found.pose) <= MOVED
        if near and fit.inliers >= INLIERS:
            return _matched(fit, found, covariance, "matched")
        if found.score > SCORE:
            return Match(wrapped(found.pose), covariance, "searched", found.score, fit.inliers)
        return self._recover(local, scan, guess) or Match(
            guess,
            self._adrift.after_break() if self._adrift.broken else covariance,
            "broken" if self._adrift.broken else "odometry",
            found.score,
            fit.inliers,
        )

    def _summed(self, noise: Floats | None, delta: Floats) -> Floats | None:
        """The odometry's covariance since a scan was matched, in the axes of the pose now."""
        if noise is None or self._noise is None:
            return None
        turn = rotation(-float(delta[2]))
        lever = np.eye(3)
        lever[0, 2], lever[1, 2] = -delta[1], delta[0]
        return np.asarray(turn @ (lever @ self._noise @ lever.T + noise) @ turn.T)

    def _recover(self, local: LocalMap, scan: Scan, guess: Floats) -> Match | None:
        """Where the scan fits beyond doubt, wide round the guess or round where it was before."""
        for start in (guess, self.pose):
            found = search(local.image, scan.points, start, WIDE)
            if found.score < SURE_SCORE:
                continue
            fit = _fit(local, scan, found, found.pose, UNKNOWN)
            if fit.inliers >= SURE_INLIERS and _apart(fit.pose, found.pose) <= MOVED:
                return _matched(fit, found, UNKNOWN, "recovered")
        return None

    def _far_enough(self) -> bool:
        if not self._poses:
            return True
        x, y, yaw = between(self._poses[-1], self.pose)
        return bool(np.hypot(x, y) > self._spacing.travel or abs(yaw) > self._spacing.turn)


@dataclass(frozen=True, slots=True)
class _Adrift:
    """What odometry did since a scan was matched."""

    misses: int = 0  # scans
    travel: float = 0.0  # [m]
    turn: float = 0.0  # [rad]
    blind: bool = False  # there was nothing to match for a while, so odometry may be right

    def moved(self, delta: Floats, blind: bool) -> "_Adrift":
        travel = self.travel + float(np.hypot(delta[0], delta[1]))
        turn = self.turn + abs(float(delta[2]))
        return _Adrift(self.misses + (not blind), travel, turn, self.blind or blind)

    @property
    def covariance(self) -> Floats:
        """Of the odometry since; generous, as wheels slip and bad odometry is common."""
        away, turn = 0.1 + 0.2 * self.travel, 0.1 + 0.3 * self.turn
        return np.diag((away**2, away**2, turn**2))

    @property
    def broken(self) -> bool:
        return (self.misses >= MISSES and self.far) or self.misses >= MISSES_STANDING

    @property
    def far(self) -> bool:
        """Whether what was matched last may be out of sight by now."""
        return self.travel > MISSED_TRAVEL or self.turn > MISSED_TURN

    def after_break(self) -> Floats:
        return self.covariance if self.blind else UNKNOWN


def _window(adrift: _Adrift) -> Window:
    """The farther odometry has moved since the last match, the wider the search."""
    effort = min(1.0, adrift.travel / 0.5 + adrift.turn / 0.3)
    return Window(0.15 + 0.2 * effort, 0.12 + 0.23 * effort)


def _likely(off: Floats, covariance: Floats) -> bool:
    """Whether odometry of this covariance may have been `off` by so much, in the same axes."""
    off = wrapped(off)
    return bool(off @ inverse_of(covariance) @ off < CONTRADICTED)


def _fit(local: LocalMap, scan: Scan, found: Found, guess: Floats, covariance: Floats) -> Fit:
    points = thinned(scan.points, POINTS)
    return icp(local.buckets, points, found.pose, GATE, inverse_of(covariance), guess)


def _matched(fit: Fit, found: Found, prior: Floats, kind: Kind) -> Match:
    covariance = inverse_of(fit.information + inverse_of(prior))
    return Match(wrapped(fit.pose), covariance, kind, found.score, fit.inliers)


def _apart(one: Floats, other: Floats) -> float:
    return float(np.hypot(*(one - other)[:2]))


def _first(poses: Floats, spacing: Spacing) -> int:
    """The first of the poses (n, 3) that the local map still holds."""
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    behind = np.append(np.cumsum(steps[::-1])[::-1], 0.0)  # travel from each to the last
    age = np.arange(len(poses))[::-1]
    held = (age < spacing.fewest) | ((age < spacing.most) & (behind <= spacing.length))
    return int(np.argmax(held))
