"""Loop closure: searches near the robot, and recognises places that drift put out of reach.

One false loop folds a map. A near loop must score well, be possible for the known drift, and be
confirmed by a second keyframe unless it moves next to nothing. For a far place several stretches
of the path must agree on it and on no other (pairwise consistency, J. Mangelson et al., ICRA
2018).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import (
    IDENTITY,
    between,
    compose,
    inverse,
    inverse_of,
    transform,
    turned,
    wrapped,
)
from gigabrain_zenoh.mapping.keyframes import Edge, Keyframe, Points, seen_through, thinned
from gigabrain_zenoh.mapping.local_map import build
from gigabrain_zenoh.mapping.pose_graph import Drift, DriftRates, explained
from gigabrain_zenoh.mapping.scan_matching import Window, icp, search

LOOP_RADIUS_M = 4.0  # [m] round the robot
LOOP_TRAVEL_M = 12.0  # [m] since, or it is no loop
SEARCH_SPACING_M = 0.5  # [m] of travel between searches
LOOP_WINDOW = Window(1.8, 0.45, 0.0205)
LOOP_CELL_M, LOOP_SIGMA_M = 0.075, 0.12  # [m], of the likelihood image
MIN_SCORE = 0.55
LOOP_GATE_M = 0.4  # [m]
ICP_POINTS = 360  # of a scan are enough for ICP
MIN_INLIERS = 0.6  # share of the points
DRIFT_SIGMAS = 4.0  # standard deviations of drift, beyond them there is no loop
MAX_RMS_M = 0.06  # [m]
MAX_SLIDE_M = 0.3  # [m], from search to ICP
MIN_PLACE_KEYFRAMES = 8  # keyframes round a place, and [m] of travel between the two
MAX_PLACE_KEYFRAMES = 20
PLACE_TRAVEL_M = 4.0
SMALL_CORRECTION = np.array((0.3, 0.3, 0.1))  # [m], [m], [rad]: needs no witness
WITNESS_TOLERANCE = np.array((0.2, 0.2, 0.05))  # [m], [m], [rad], between two witnesses
WITNESS_TRAVEL_M = 10.0  # [m] of travel for which a witness counts
LOOP = np.diag((0.05, 0.05, 0.01)) ** 2  # covariance beside that of ICP
OPEN = 0.05  # of what holds the best direction: a place that holds another less is an aisle

VISIT_TRAVEL_M = 30.0  # [m] driven since, or it is the same visit
OUT_OF_REACH_M = 1.5  # [m] of drift, below it the loop search finds the place
SIGMAS = 3.0  # of drift, within which a place may be
STRETCH_M = 8.0  # [m] of travel that are matched at once, and from one to the next
STRETCH_SPACING_M = 3.0
PLACE_RADIUS_M = 10.0  # [m] of travel before and after a keyframe that make up its place
MAX_SCANS = 16  # of a stretch or a place are enough
PLACE_SPACING_M = 5.0  # [m] from one place to the next
PLACE_WINDOW = Window(4.5, 0.6, 0.02)  # round a place, at most
REFINED = Window(0.3, 0.06, 0.02)
PLACE_CELL_M, PLACE_SIGMA_M = 0.1, 0.15  # [m], of the likelihood image
VOXEL_M = 0.2  # [m], of a stretch one point in each counts
ROUGH_POINTS = 60  # points for a first search, the search and ICP
REFINED_POINTS = 240
PLACE_ICP_POINTS = 720
ROUGH_SCORE, PLACE_SCORE = 0.4, 0.5
PLACE_GATE_M, PLACE_SLIDE_M = 0.5, 0.5  # [m]
PLACE_INLIERS, PLACE_RMS_M = 0.6, 0.08  # share of the points, [m]
MAX_SEEN_THROUGH = 0.2  # share of what is known that a scan may look through
NEARBY_M = 8.0  # [m], an earlier stretch is searched for again where another way comes so near
PLACES_PER_KEYFRAME = 10  # places matched for one keyframe: what bounds the time that it takes
STRETCH_START_PLACES = 3  # places, which beginning with a stretch takes as long as
MAX_NEAREST, MAX_OTHERS = 36, 36  # places matched to a stretch
BEST_GUESSES = 8  # guesses kept of a stretch
GUESS_MEMORY_M = 40.0  # [m] of travel, guesses farther apart say nothing of one another
MAX_GUESSES = 96  # guesses
REVISIT_SPACING_M = 4.0  # [m] of travel, from one earlier stretch to the next, after a correction
GUESS_TOLERANCE = np.array((0.5, 0.5, 0.06))  # [m], [m], [rad], between two guesses
MIN_STRETCHES = 3  # that have to agree, and [m] of travel from the first to the last
MIN_SPAN_M = 10.0
MAX_RIVAL_SHARE = 0.5  # stretches that agree on another place, per stretch that agrees on this one


class Trajectory(NamedTuple):
    """Keyframes with their poses (n, 3) and the distances driven until each (n,) [m]."""

    keyframes: Sequence[Keyframe]
    poses: Floats
    travel: Floats


class LoopSearch:
    """Looks for loops from each keyframe in turn. One thread at a time."""

    def __init__(self, rates: DriftRates) -> None:
        self.drift = Drift(rates)
        self._places = PlaceSearch(self.drift)
        self.waiting: list[Edge] = []  # loops without a second witness
        self.searched = -SEARCH_SPACING_M  # [m] of travel

    def find(self, keyframes: Sequence[Keyframe], poses: Floats) -> list[Edge]:
        """Loops that end at the last keyframe and are beyond doubt, and those that they confirm."""
        travel = np.array([keyframe.travel for keyframe in keyframes])
        trajectory = Trajectory(keyframes, poses, travel)
        far = self._places.find(trajectory)
        for loop in far:
            self.drift.closed(loop)
        return far or self._find_near(trajectory)

    def _find_near(self, trajectory: Trajectory) -> list[Edge]:
        keyframes, poses, travel = trajectory
        if travel[-1] - self.searched < SEARCH_SPACING_M:
            return []
        self.searched = float(travel[-1])
        self.waiting = [w for w in self.waiting if travel[-1] - travel[w.second] < WITNESS_TRAVEL_M]
        here = len(keyframes) - 1
        attempts = [
            _attempt(trajectory, there, here, *self.drift.between(there, here, poses))
            for there in _candidates(poses, travel, here)
        ]
        found = [loop for loop in attempts if loop and self.drift.explains(loop, poses)]
        sure = [loop for one in found for loop in self._confirmed(one, poses)]
        for loop in sure:
            self.drift.closed(loop)
        return sure

    def _confirmed(self, loop: Edge, poses: Floats) -> list[Edge]:
        """Return the loop with its witnesses, or nothing while it needs one and has none."""
        witnesses = [w for w in self.waiting if w.second != loop.second and _agree(loop, w, poses)]
        if not witnesses and not _is_small(loop, poses):
            self.waiting.append(loop)
            return []
        self.waiting = [w for w in self.waiting if w not in witnesses]
        return [loop, *witnesses]


def _candidates(poses: Floats, travel: Floats, here: int) -> list[int]:
    earlier = np.flatnonzero(travel[here] - travel[:here] > LOOP_TRAVEL_M)
    away = np.hypot(*(poses[earlier, :2] - poses[here, :2]).T)
    near = earlier[away < LOOP_RADIUS_M]
    if not len(near):
        return []
    return sorted({int(earlier[np.argmin(away)]), int(near[0])})


def around(travel: Floats, there: int, end: int) -> slice:
    """Return the keyframes before `end` that make up the place of keyframe `there`."""
    first, last = there, there
    while last - first + 1 < MAX_PLACE_KEYFRAMES:
        if (
            last - first + 1 >= MIN_PLACE_KEYFRAMES
            and travel[last] - travel[first] > PLACE_TRAVEL_M
        ):
            break
        before = travel[there] - travel[first - 1] if first else np.inf
        after = travel[last + 1] - travel[there] if last + 1 < end else np.inf
        if before == after == np.inf:
            break
        first, last = (first - 1, last) if before <= after else (first, last + 1)
    return slice(first, last + 1)


def _attempt(
    trajectory: Trajectory, there: int, here: int, turn: float, away: float
) -> Edge | None:
    """Return the loop from `there` to `here` if the scan of `here` fits into that place.

    The drift's variances, `turn` and `away`, decide where the place leaves a direction open. The
    loop's covariance does not include them, as the graph already does.
    """
    keyframes, poses, travel = trajectory
    place = around(travel, there, here)
    scans = [keyframe.scan for keyframe in keyframes[place]]
    local = build(scans, between(poses[there], poses[place]), IDENTITY, LOOP_CELL_M, LOOP_SIGMA_M)
    guess, scan = between(poses[there], poses[here]), keyframes[here].scan.points
    found = search(local.image, scan, guess, _window(turn, away))
    if found.score < MIN_SCORE:
        return None
    prior = np.diag((1 / away, 1 / away, 1 / turn))
    fit = icp(local.buckets, thinned(scan, ICP_POINTS), found.pose, LOOP_GATE_M, prior, guess)
    slid = float(np.hypot(*(fit.pose - found.pose)[:2]))
    if fit.inliers < MIN_INLIERS or fit.rms > MAX_RMS_M or slid > MAX_SLIDE_M:
        return None
    least, most = np.linalg.eigvalsh(fit.information[:2, :2])
    if least < OPEN * most:
        return None
    pose = wrapped(fit.pose)
    covariance = LOOP + turned(inverse_of(fit.information), -float(pose[2]))
    return Edge(there, here, pose, covariance, doubtful=True)


def _window(turn: float, away: float) -> Window:
    within = DRIFT_SIGMAS * np.sqrt((away, turn))
    return Window(
        min(LOOP_WINDOW.away, within[0]), min(LOOP_WINDOW.turn, within[1]), LOOP_WINDOW.step
    )


def _is_small(loop: Edge, poses: Floats) -> bool:
    change = between(between(poses[loop.first], poses[loop.second]), loop.relative)
    return bool((np.abs(change) < SMALL_CORRECTION).all())


def _agree(one: Edge, other: Edge, poses: Floats) -> bool:
    there = between(poses[one.first], poses[other.first])
    back = compose(other.relative, between(poses[other.second], poses[one.second]))
    round_trip = compose(compose(there, back), inverse(one.relative))
    return bool((np.abs(round_trip) < WITNESS_TOLERANCE).all())


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
        self._searched = -STRETCH_SPACING_M  # [m] of travel
        self._next = 0  # keyframe from which on the other places are taken in turn
        self._guesses: list[Edge] = []
        self._earlier = False  # whether it is an earlier stretch's turn
        self._again: list[int] = []  # keyframes to search from once more, the last first

    def find(self, trajectory: Trajectory) -> list[Edge]:
        """Match some more places, and return the loops to one that is beyond doubt.

        Every other time it is those of earlier stretches, as long as there are any: a correction
        brings together what was too far apart when it was searched for.
        """
        _, poses, travel = trajectory
        waiting = bool(self._again) or self._open[True] is not None
        self._earlier = waiting and not self._earlier
        left = PLACES_PER_KEYFRAME
        while left > 0:
            stretch = self._open[self._earlier]
            if stretch is None:
                stretch = self._begin(trajectory)
                left = max(left - STRETCH_START_PLACES, 1)
            if stretch is None:
                return []
            now, later = stretch.places[:left], stretch.places[left:]
            found = [_match(trajectory, stretch, there) for there in now]
            stretch.found.extend(one for one in found if one)
            stretch.places[:], left, done = later, left - len(now), not later
            self._open[self._earlier] = None if done else stretch
            sure = self._sure(stretch, poses, travel) if done else []
            if any(_is_far(loop, poses) for loop in sure):
                ends = np.arange(travel[0] + STRETCH_M, travel[-1], REVISIT_SPACING_M)
                self._again = np.searchsorted(travel, ends).tolist()
            if sure:
                return sure
        return []

    def _begin(self, trajectory: Trajectory) -> _Stretch | None:
        """Return the stretch whose turn it is, if there is one."""
        keyframes, poses, travel = trajectory
        if not self._earlier:
            if travel[-1] - self._searched < STRETCH_SPACING_M:
                return None
            self._searched = float(travel[-1])
            return self._begun(trajectory, len(keyframes) - 1)
        while self._again:
            here = self._again.pop()
            earlier = np.flatnonzero(travel[here] - travel > VISIT_TRAVEL_M)
            if (np.hypot(*(poses[earlier, :2] - poses[here, :2]).T) < NEARBY_M).any():
                return self._begun(trajectory, here, NEARBY_M)
        return None

    def _begun(self, trajectory: Trajectory, here: int, within: float = np.inf) -> _Stretch | None:
        """Return the stretch that ends here, if drift may have hidden a place from it."""
        _, poses, travel = trajectory
        turn, away = self._drift.spread(here, poses)
        far = np.hypot(*(poses[:, :2] - poses[here, :2]).T)
        reach = SIGMAS * np.sqrt(away)
        may_be = (travel[here] - travel > VISIT_TRAVEL_M) & (reach > OUT_OF_REACH_M)
        near = np.flatnonzero(may_be & (far < np.minimum(reach + PLACE_WINDOW.away, within)))
        if not len(near):
            return None
        first = int(np.searchsorted(travel, travel[here] - STRETCH_M))
        points = _points(trajectory, _spread_indices(first, here + 1), here)
        places = self._places(poses, here, near[np.argsort(far[near])])
        return _Stretch(here, points, places, turn, away, [])

    def _places(self, poses: Floats, here: int, near: NDArray[np.intp]) -> list[int]:
        """Return the places to match, of keyframes in the order of their distance.

        First those where earlier guesses have the robot now, then the nearest, and then some of the
        others in turn.
        """
        recent = self._guesses[-BEST_GUESSES:]
        expected = [self._expected(guess, poses, here, near) for guess in recent]
        apart = _spaced_out(poses, near)
        others = np.sort(apart[MAX_NEAREST:])
        others = np.roll(others, -int(np.searchsorted(others, self._next)))[:MAX_OTHERS]
        self._next = int(others[-1]) + 1 if len(others) else 0
        return list(dict.fromkeys([*expected, *apart[:MAX_NEAREST].tolist(), *others.tolist()]))

    def _expected(self, guess: Edge, poses: Floats, here: int, near: NDArray[np.intp]) -> int:
        """Return the keyframe of these that is nearest to the robot if the guess is right."""
        led = compose(guess.relative, between(poses[guess.second], poses[here]))
        at = compose(poses[guess.first], led)
        return int(near[np.argmin(np.hypot(*(poses[near, :2] - at[:2]).T))])

    def _sure(self, stretch: _Stretch, poses: Floats, travel: Floats) -> list[Edge]:
        """Return the guesses that agree, if they are enough and hardly any agree otherwise."""
        best = sorted(stretch.found, key=lambda one: -one[0])[:BEST_GUESSES]
        self._guesses = [*self._guesses, *(guess for _, guess in best)][-MAX_GUESSES:]
        away = np.abs(travel - travel[stretch.here])
        guesses = [guess for guess in self._guesses if away[guess.second] < GUESS_MEMORY_M]
        if not guesses:
            return []
        agree = _agreement(guesses, poses)
        ends = np.array([guess.second for guess in guesses])
        group = _largest(agree, ends, np.ones(len(ends), bool))
        rival = _largest(agree, ends, np.asarray(~agree[group].any(axis=0)))
        support, against = len(set(ends[group])), len(set(ends[rival]))
        span = float(np.ptp(travel[ends[group]]))
        if support < MIN_STRETCHES or span < MIN_SPAN_M or against > MAX_RIVAL_SHARE * support:
            return []
        used = {id(guess) for guess in guesses}
        self._guesses = [guess for guess in self._guesses if id(guess) not in used]
        return [guesses[k] for k in group]


def _is_far(loop: Edge, poses: Floats) -> bool:
    """Return whether closing the loop corrects what the loop search could not have."""
    change = between(between(poses[loop.first], poses[loop.second]), loop.relative)
    return bool(np.hypot(change[0], change[1]) > OUT_OF_REACH_M)


def _spread_indices(first: int, end: int) -> list[int]:
    count = min(MAX_SCANS, end - first)
    return [int(k) for k in np.linspace(first, end - 1, count)]


def _points(trajectory: Trajectory, chosen: Sequence[int], here: int) -> Points:
    """Return the points of the chosen keyframes in the frame of `here`, one in each voxel."""
    keyframes, poses, _ = trajectory
    placed = [transform(between(poses[here], poses[k]), keyframes[k].points) for k in chosen]
    points = np.concatenate(placed)
    _, first = np.unique(np.floor(points / VOXEL_M), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)], np.float32)


def _spaced_out(poses: Floats, near: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the first of these keyframes on each square of ground, by quarter of the compass."""
    squares = np.floor(poses[near] / (PLACE_SPACING_M, PLACE_SPACING_M, np.pi / 2))
    _, first = np.unique(squares, axis=0, return_index=True)
    return near[np.sort(first)]


def _match(trajectory: Trajectory, stretch: _Stretch, there: int) -> tuple[float, Edge] | None:
    """Return the inliers and the loop from `there`, if the stretch fits into that place."""
    keyframes, poses, travel = trajectory
    first, end = np.searchsorted(
        travel, (travel[there] - PLACE_RADIUS_M, travel[there] + PLACE_RADIUS_M)
    )
    chosen = _spread_indices(int(first), min(int(end), stretch.here))
    scans = [keyframes[k].scan for k in chosen]
    local = build(
        scans, between(poses[there], poses[chosen]), IDENTITY, PLACE_CELL_M, PLACE_SIGMA_M
    )
    yaw = float(between(poses[there], poses[stretch.here])[2])
    turn, away = float(stretch.turn[there]), float(stretch.away[there])
    window = Window(
        PLACE_WINDOW.away, min(PLACE_WINDOW.turn, SIGMAS * np.sqrt(turn)), PLACE_WINDOW.step
    )
    start, points = np.array((0.0, 0.0, yaw)), stretch.points
    found = search(local.image, points, start, window, ROUGH_SCORE, ROUGH_POINTS)
    if found.score < ROUGH_SCORE:
        return None
    found = search(local.image, points, found.pose, REFINED, PLACE_SCORE, REFINED_POINTS)
    if found.score < PLACE_SCORE:
        return None
    alone = np.zeros((3, 3))  # odometry says nothing
    fit = icp(
        local.buckets,
        thinned(points, PLACE_ICP_POINTS),
        found.pose,
        PLACE_GATE_M,
        alone,
        found.pose,
    )
    slid = float(np.hypot(*(fit.pose - found.pose)[:2]))
    if fit.inliers < PLACE_INLIERS or fit.rms > PLACE_RMS_M or slid > PLACE_SLIDE_M:
        return None
    least, most = np.linalg.eigvalsh(fit.information[:2, :2])
    if least < OPEN * most:
        return None
    if (
        seen_through(local.buckets.points, keyframes[stretch.here].points, fit.pose)
        > MAX_SEEN_THROUGH
    ):
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
    return np.asarray((np.abs(round_trip) < GUESS_TOLERANCE).all(axis=-1))


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
