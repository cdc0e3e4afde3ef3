"""Place recognition: finds places that drift has carried out of reach of the loop search.

So far from where the robot is thought to be, one scan proves nothing: corridors and doors look
alike. So the last stretch of the way is matched to every place within the drift, and a place is
believed when several stretches agree on it and on no other (pairwise consistency, J. Mangelson et
al., ICRA 2018).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.se2 import (
    IDENTITY,
    Floats,
    between,
    compose,
    inverse,
    inverse_of,
    transform,
    turned,
    wrapped,
)
from gigabrain_zenoh.mapping.correlative import Window, search
from gigabrain_zenoh.mapping.drift import Drift, explained
from gigabrain_zenoh.mapping.keyframe import Edge, Keyframe
from gigabrain_zenoh.mapping.local_map import build
from gigabrain_zenoh.mapping.matching import icp
from gigabrain_zenoh.mapping.points import Points, thinned
from gigabrain_zenoh.mapping.visibility import seen_through

TRAVEL = 30.0  # [m] driven since, or it is the same visit
OUT_OF_REACH = 1.5  # [m] of drift, below it the loop search finds the place
SIGMAS = 3.0  # of drift, within which a place may be
STRETCH, SPACING = 8.0, 3.0  # [m] of travel that are matched at once, and from one to the next
PLACE = 10.0  # [m] of travel before and after a keyframe that make up its place
SCANS = 16  # of a stretch or a place are enough
APART = 5.0  # [m] from one place to the next
WINDOW = Window(4.5, 0.6, 0.02)  # round a place, at most
REFINED = Window(0.3, 0.06, 0.02)
CELL, SIGMA = 0.1, 0.15  # [m], of the likelihood image
VOXEL = 0.2  # [m], of a stretch one point in each counts
ROUGHLY, SEARCHED, LAID = 60, 240, 720  # points for a first search, the search and ICP
ROUGH_SCORE, SCORE = 0.4, 0.5
GATE, SLID = 0.5, 0.5  # [m]
INLIERS, RMS = 0.6, 0.08  # share of the points, [m]
OPEN = 0.05  # see loops.py
THROUGH = 0.2  # share of what is known that a scan may look through
BESIDE = 8.0  # [m], an earlier stretch is searched for again where another way comes so near
AT_ONCE = 10  # places matched for one keyframe: what bounds the time that it takes
BEGINNING = 3  # places, which beginning with a stretch takes as long as
NEAREST, OTHERS = 36, 36  # places matched to a stretch
BEST = 8  # guesses kept of a stretch
MEMORY = 40.0  # [m] of travel, guesses farther apart say nothing of one another
KEPT = 96  # guesses
AGAIN = 4.0  # [m] of travel, from one earlier stretch to the next, after a correction
AGREE = np.array((0.5, 0.5, 0.06))  # [m], [m], [rad], between two guesses
STRETCHES, SPAN = 3, 10.0  # that have to agree, and [m] of travel from the first to the last
RIVALS = 0.5  # stretches that agree on another place, per stretch that agrees on this one
LOOP = np.diag((0.05, 0.05, 0.01)) ** 2  # covariance beside that of ICP


@dataclass(frozen=True, slots=True)
class _Stretch:
    """The last metres of the way, and the places that they are still to be matched to."""

    here: int  # the keyframe in whose frame the points are
    points: Points
    places: list[int]
    turn: Floats  # (n,), variance of the yaw's drift since each keyframe,
    away: Floats  # and of the place's
    found: list[tuple[float, Edge]]  # inliers, and the place that fits


class PlaceSearch:
    """Looks for places that are far off. One thread at a time."""

    def __init__(self, drift: Drift) -> None:
        self._drift = drift
        self._open: dict[bool, _Stretch | None] = {False: None, True: None}  # True: an earlier one
        self._searched = -SPACING  # [m] of travel
        self._next = 0  # keyframe from which on the other places are taken in turn
        self._guesses: list[Edge] = []
        self._earlier = False  # whether it is an earlier stretch's turn
        self._again: list[int] = []  # keyframes to search from once more, the last first

    def find(self, keyframes: Sequence[Keyframe], poses: Floats) -> list[Edge]:
        """Match some more places, and return the loops to one that is beyond doubt.

        Every other time it is those of earlier stretches, as long as there are any: a correction
        brings together what was too far apart when it was searched for.
        """
        travel = np.array([keyframe.travel for keyframe in keyframes])
        waiting = bool(self._again) or self._open[True] is not None
        self._earlier = waiting and not self._earlier
        left = AT_ONCE
        while left > 0:
            stretch = self._open[self._earlier]
            if stretch is None:
                stretch = self._begin(keyframes, poses, travel)
                left = max(left - BEGINNING, 1)
            if stretch is None:
                return []
            now, later = stretch.places[:left], stretch.places[left:]
            found = [_match(keyframes, poses, travel, stretch, there) for there in now]
            stretch.found.extend(one for one in found if one)
            stretch.places[:], left, done = later, left - len(now), not later
            self._open[self._earlier] = None if done else stretch
            sure = self._sure(stretch, poses, travel) if done else []
            if any(_far(loop, poses) for loop in sure):
                ends = np.arange(travel[0] + STRETCH, travel[-1], AGAIN)
                self._again = np.searchsorted(travel, ends).tolist()
            if sure:
                return sure
        return []

    def _begin(
        self, keyframes: Sequence[Keyframe], poses: Floats, travel: Floats
    ) -> _Stretch | None:
        """Return the stretch whose turn it is, if there is one."""
        if not self._earlier:
            if travel[-1] - self._searched < SPACING:
                return None
            self._searched = float(travel[-1])
            return self._begun(keyframes, poses, travel, len(keyframes) - 1)
        while self._again:
            here = self._again.pop()
            earlier = np.flatnonzero(travel[here] - travel > TRAVEL)
            if (np.hypot(*(poses[earlier, :2] - poses[here, :2]).T) < BESIDE).any():
                return self._begun(keyframes, poses, travel, here, BESIDE)
        return None

    def _begun(
        self,
        keyframes: Sequence[Keyframe],
        poses: Floats,
        travel: Floats,
        here: int,
        within: float = np.inf,
    ) -> _Stretch | None:
        """Return the stretch that ends here, if drift may have hidden a place from it."""
        turn, away = self._drift.spread(here, poses)
        far = np.hypot(*(poses[:, :2] - poses[here, :2]).T)
        reach = SIGMAS * np.sqrt(away)
        may_be = (travel[here] - travel > TRAVEL) & (reach > OUT_OF_REACH)
        near = np.flatnonzero(may_be & (far < np.minimum(reach + WINDOW.away, within)))
        if not len(near):
            return None
        first = int(np.searchsorted(travel, travel[here] - STRETCH))
        points = _points(keyframes, poses, _some(first, here + 1), here)
        places = self._places(poses, here, near[np.argsort(far[near])])
        return _Stretch(here, points, places, turn, away, [])

    def _places(self, poses: Floats, here: int, near: NDArray[np.intp]) -> list[int]:
        """Return the places to match, of keyframes in the order of their distance.

        First those where earlier guesses have the robot now, then the nearest, and then some of the
        others in turn.
        """
        recent = self._guesses[-BEST:]
        expected = [self._expected(guess, poses, here, near) for guess in recent]
        apart = _apart(poses, near)
        others = np.sort(apart[NEAREST:])
        others = np.roll(others, -int(np.searchsorted(others, self._next)))[:OTHERS]
        self._next = int(others[-1]) + 1 if len(others) else 0
        return list(dict.fromkeys([*expected, *apart[:NEAREST].tolist(), *others.tolist()]))

    def _expected(self, guess: Edge, poses: Floats, here: int, near: NDArray[np.intp]) -> int:
        """Return the keyframe of these that is nearest to the robot if the guess is right."""
        led = compose(guess.relative, between(poses[guess.second], poses[here]))
        at = compose(poses[guess.first], led)
        return int(near[np.argmin(np.hypot(*(poses[near, :2] - at[:2]).T))])

    def _sure(self, stretch: _Stretch, poses: Floats, travel: Floats) -> list[Edge]:
        """Return the guesses that agree, if they are enough and hardly any agree otherwise."""
        best = sorted(stretch.found, key=lambda one: -one[0])[:BEST]
        self._guesses = [*self._guesses, *(guess for _, guess in best)][-KEPT:]
        away = np.abs(travel - travel[stretch.here])
        guesses = [guess for guess in self._guesses if away[guess.second] < MEMORY]
        if not guesses:
            return []
        agree = _agreement(guesses, poses)
        ends = np.array([guess.second for guess in guesses])
        group = _largest(agree, ends, np.ones(len(ends), bool))
        rival = _largest(agree, ends, np.asarray(~agree[group].any(axis=0)))
        support, against = len(set(ends[group])), len(set(ends[rival]))
        span = float(np.ptp(travel[ends[group]]))
        if support < STRETCHES or span < SPAN or against > RIVALS * support:
            return []
        used = {id(guess) for guess in guesses}
        self._guesses = [guess for guess in self._guesses if id(guess) not in used]
        return [guesses[k] for k in group]


def _far(loop: Edge, poses: Floats) -> bool:
    """Return whether closing the loop corrects what the loop search could not have."""
    change = between(between(poses[loop.first], poses[loop.second]), loop.relative)
    return bool(np.hypot(change[0], change[1]) > OUT_OF_REACH)


def _some(first: int, end: int) -> list[int]:
    """Return at most SCANS indices from `first` to before `end`, evenly."""
    count = min(SCANS, end - first)
    return [int(k) for k in np.linspace(first, end - 1, count)]


def _points(
    keyframes: Sequence[Keyframe], poses: Floats, chosen: Sequence[int], here: int
) -> Points:
    """Return the points of the chosen keyframes in the frame of `here`, one in each voxel."""
    placed = [transform(between(poses[here], poses[k]), keyframes[k].points) for k in chosen]
    points = np.concatenate(placed)
    _, first = np.unique(np.floor(points / VOXEL), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)], np.float32)


def _apart(poses: Floats, near: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the first of these keyframes on each square of ground, by quarter of the compass."""
    squares = np.floor(poses[near] / (APART, APART, np.pi / 2))
    _, first = np.unique(squares, axis=0, return_index=True)
    return near[np.sort(first)]


def _match(
    keyframes: Sequence[Keyframe], poses: Floats, travel: Floats, stretch: _Stretch, there: int
) -> tuple[float, Edge] | None:
    """Return the inliers and the loop from `there`, if the stretch fits into that place."""
    first, end = np.searchsorted(travel, (travel[there] - PLACE, travel[there] + PLACE))
    chosen = _some(int(first), min(int(end), stretch.here))
    scans = [keyframes[k].scan for k in chosen]
    local = build(scans, between(poses[there], poses[chosen]), IDENTITY, CELL, SIGMA)
    yaw = float(between(poses[there], poses[stretch.here])[2])
    turn, away = float(stretch.turn[there]), float(stretch.away[there])
    window = Window(WINDOW.away, min(WINDOW.turn, SIGMAS * np.sqrt(turn)), WINDOW.step)
    start, points = np.array((0.0, 0.0, yaw)), stretch.points
    found = search(local.image, points, start, window, ROUGH_SCORE, ROUGHLY)
    if found.score < ROUGH_SCORE:
        return None
    found = search(local.image, points, found.pose, REFINED, SCORE, SEARCHED)
    if found.score < SCORE:
        return None
    alone = np.zeros((3, 3))  # odometry says nothing
    fit = icp(local.buckets, thinned(points, LAID), found.pose, GATE, alone, found.pose)
    slid = float(np.hypot(*(fit.pose - found.pose)[:2]))
    if fit.inliers < INLIERS or fit.rms > RMS or slid > SLID:
        return None
    least, most = np.linalg.eigvalsh(fit.information[:2, :2])
    if least < OPEN * most:
        return None
    if seen_through(local.buckets.points, keyframes[stretch.here].points, fit.pose) > THROUGH:
        return None
    pose = wrapped(fit.pose)
    covariance = LOOP + turned(inverse_of(fit.information), -float(pose[2]))
    loop = Edge(there, stretch.here, pose, covariance, doubtful=True)
    return (fit.inliers, loop) if explained(loop, poses, turn, away) else None


def _agreement(guesses: Sequence[Edge], poses: Floats) -> NDArray[np.bool_]:
    """Return for each two whether going out by one and back by the other ends where it began."""
    first, second = poses[[g.first for g in guesses]], poses[[g.second for g in guesses]]
    relative = np.array([guess.relative for guess in guesses])
    there = between(first[:, None], first[None])
    back = compose(relative[None], between(second[None], second[:, None]))
    round_trip = compose(compose(there, back), inverse(relative)[:, None])
    return np.asarray((np.abs(round_trip) < AGREE).all(axis=-1))


def _largest(
    agree: NDArray[np.bool_], ends: NDArray[np.intp], among: NDArray[np.bool_]
) -> list[int]:
    """Return guesses that all agree, with as many different `ends` as can be found greedily."""
    best: list[int] = []
    for seed in np.flatnonzero(among):
        group, left = [int(seed)], agree[seed] & agree[:, seed] & among
        left[seed] = False
        while left.any():
            likeliest = int(np.argmax(np.where(left, agree.sum(axis=1), -1)))
            group.append(likeliest)
            left &= agree[likeliest] & agree[:, likeliest]
            left[likeliest] = False
        best = max(best, group, key=lambda some: len(set(ends[some])))
    return best
