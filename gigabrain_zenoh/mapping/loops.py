"""Loop search: has the robot been here before, and is that beyond doubt?

Places look alike, and one false loop folds a map. So a loop must score well, be possible for what
is known of the drift, and, unless it moves next to nothing, be seen from a second keyframe too.
"""

from collections.abc import Sequence

import numpy as np

from gigabrain_zenoh.geometry.se2 import (
    IDENTITY,
    Floats,
    between,
    compose,
    inverse,
    inverse_of,
    turned,
    wrapped,
)
from gigabrain_zenoh.mapping.correlative import Window, search
from gigabrain_zenoh.mapping.drift import Drift, Rates
from gigabrain_zenoh.mapping.keyframe import Edge, Keyframe
from gigabrain_zenoh.mapping.local_map import build
from gigabrain_zenoh.mapping.matching import icp
from gigabrain_zenoh.mapping.places import PlaceSearch
from gigabrain_zenoh.mapping.points import thinned

RADIUS = 4.0  # [m] round the robot
TRAVEL = 12.0  # [m] since, or it is no loop
SPACING = 0.5  # [m] of travel between searches
WINDOW = Window(1.8, 0.45, 0.0205)
CELL, SIGMA = 0.075, 0.12  # [m], of the likelihood image
SCORE = 0.55
GATE = 0.4  # [m]
POINTS = 360  # of a scan are enough for ICP
INLIERS = 0.6  # share of the points
WITHIN = 4.0  # standard deviations of drift, beyond them there is no loop
RMS = 0.06  # [m]
MOVED = 0.3  # [m], from search to ICP
FEWEST, MOST, LENGTH = 8, 20, 4.0  # keyframes round a place, and [m] of travel between the two
SMALL = np.array((0.3, 0.3, 0.1))  # [m], [m], [rad]: a loop that changes less needs no witness
AGREE = np.array((0.2, 0.2, 0.05))  # [m], [m], [rad], between two witnesses
MEMORY = 10.0  # [m] of travel, a witness is heard so long
LOOP = np.diag((0.05, 0.05, 0.01)) ** 2  # covariance beside that of ICP
OPEN = 0.05  # of what holds the best direction: a place that holds another less is an aisle


class LoopSearch:
    """Looks for loops from each keyframe in turn. One thread at a time."""

    def __init__(self, rates: Rates) -> None:
        self.drift = Drift(rates)
        self._places = PlaceSearch(self.drift)
        self.waiting: list[Edge] = []  # loops without a second witness
        self.searched = -SPACING  # [m] of travel

    def find(self, keyframes: Sequence[Keyframe], poses: Floats) -> list[Edge]:
        """Loops that end at the last keyframe and are beyond doubt, and those that they confirm."""
        travel = np.array([keyframe.travel for keyframe in keyframes])
        far = self._places.find(keyframes, poses)
        for loop in far:
            self.drift.closed(loop)
        return far or self._near(keyframes, poses, travel)

    def _near(self, keyframes: Sequence[Keyframe], poses: Floats, travel: Floats) -> list[Edge]:
        if travel[-1] - self.searched < SPACING:
            return []
        self.searched = float(travel[-1])
        self.waiting = [w for w in self.waiting if travel[-1] - travel[w.second] < MEMORY]
        here = len(keyframes) - 1
        attempts = [
            _attempt(keyframes, poses, travel, there, here, *self.drift.between(there, here, poses))
            for there in _candidates(poses, travel, here)
        ]
        found = [loop for loop in attempts if loop and self.drift.explains(loop, poses)]
        sure = [loop for one in found for loop in self._sure(one, poses)]
        for loop in sure:
            self.drift.closed(loop)
        return sure

    def _sure(self, loop: Edge, poses: Floats) -> list[Edge]:
        """The loop and its witnesses, or nothing as long as it has none and would need one."""
        witnesses = [w for w in self.waiting if w.second != loop.second and _agree(loop, w, poses)]
        if not witnesses and not _small(loop, poses):
            self.waiting.append(loop)
            return []
        self.waiting = [w for w in self.waiting if w not in witnesses]
        return [loop, *witnesses]


def _candidates(poses: Floats, travel: Floats, here: int) -> list[int]:
    """Of the earlier keyframes near by, the nearest and the first."""
    earlier = np.flatnonzero(travel[here] - travel[:here] > TRAVEL)
    away = np.hypot(*(poses[earlier, :2] - poses[here, :2]).T)
    near = earlier[away < RADIUS]
    if not len(near):
        return []
    return sorted({int(earlier[np.argmin(away)]), int(near[0])})


def around(travel: Floats, there: int, end: int) -> slice:
    """The keyframes before `end` that make up the place of one of them."""
    first, last = there, there
    while last - first + 1 < MOST:
        if last - first + 1 >= FEWEST and travel[last] - travel[first] > LENGTH:
            break
        before = travel[there] - travel[first - 1] if first else np.inf
        after = travel[last + 1] - travel[there] if last + 1 < end else np.inf
        if before == after == np.inf:
            break
        first, last = (first - 1, last) if before <= after else (first, last + 1)
    return slice(first, last + 1)


def _attempt(
    keyframes: Sequence[Keyframe],
    poses: Floats,
    travel: Floats,
    there: int,
    here: int,
    turn: float,
    away: float,
) -> Edge | None:
    """The loop from `there` to `here`, if the scan of the one fits into the place of the other.

    The variances of the drift, `turn` and `away`, decide where the place leaves a direction open;
    the loop's own covariance does not count them, as the graph does already.
    """
    place = around(travel, there, here)
    scans = [keyframe.scan for keyframe in keyframes[place]]
    local = build(scans, between(poses[there], poses[place]), IDENTITY, CELL, SIGMA)
    guess, scan = between(poses[there], poses[here]), keyframes[here].scan.points
    found = search(local.image, scan, guess, _window(turn, away))
    if found.score < SCORE:
        return None
    prior = np.diag((1 / away, 1 / away, 1 / turn))
    fit = icp(local.buckets, thinned(scan, POINTS), found.pose, GATE, prior, guess)
    slid = float(np.hypot(*(fit.pose - found.pose)[:2]))
    if fit.inliers < INLIERS or fit.rms > RMS or slid > MOVED:
        return None
    least, most = np.linalg.eigvalsh(fit.information[:2, :2])
    if least < OPEN * most:
        return None
    pose = wrapped(fit.pose)
    covariance = LOOP + turned(inverse_of(fit.information), -float(pose[2]))
    return Edge(there, here, pose, covariance, doubtful=True)


def _window(turn: float, away: float) -> Window:
    """Where to search after a drift of these variances."""
    within = WITHIN * np.sqrt((away, turn))
    return Window(min(WINDOW.away, within[0]), min(WINDOW.turn, within[1]), WINDOW.step)


def _small(loop: Edge, poses: Floats) -> bool:
    change = between(between(poses[loop.first], poses[loop.second]), loop.relative)
    return bool((np.abs(change) < SMALL).all())


def _agree(one: Edge, other: Edge, poses: Floats) -> bool:
    """Whether going out by one loop and back by the other ends where it began."""
    there = between(poses[one.first], poses[other.first])
    back = compose(other.relative, between(poses[other.second], poses[one.second]))
    round_trip = compose(compose(there, back), inverse(one.relative))
    return bool((np.abs(round_trip) < AGREE).all())
