"""Loop closure: searches near the robot, and recognises places that drift put out of reach.

One false loop folds a map. A near loop must score well and be within the known drift; unless its
correction is small, a second keyframe must confirm it. On a far place several stretches of the path
must agree, and on no other (pairwise consistency, J. Mangelson et al., ICRA 2018).
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

LOOP_RADIUS_M = 4.0  # round the robot
LOOP_TRAVEL_M = 12.0  # from end to end of a loop
SEARCH_SPACING_M = 0.5  # of travel
LOOP_WINDOW = Window(1.8, 0.45, 0.0205)
LOOP_CELL_M, LOOP_SIGMA_M = 0.075, 0.12  # of the likelihood image
MIN_SCORE = 0.55
LOOP_GATE_M = 0.4  # of ICP
ICP_POINTS = 360  # of a scan
MIN_INLIERS = 0.6  # share of the points
DRIFT_SIGMAS = 4.0  # searched for a loop
MAX_RMS_M = 0.06
MAX_SLIDE_M = 0.3  # of ICP from the search's result
MIN_PLACE_KEYFRAMES, MAX_PLACE_KEYFRAMES = 8, 20
PLACE_TRAVEL_M = 4.0  # limits the number between the two
SMALL_CORRECTION = np.array((0.3, 0.3, 0.1))  # [m], [m], [rad], needs no witness
WITNESS_TOLERANCE = np.array((0.2, 0.2, 0.05))  # [m], [m], [rad], between two witnesses
WITNESS_TRAVEL_M = 10.0  # for which a witness counts
LOOP_COVARIANCE = np.diag((0.05, 0.05, 0.01)) ** 2  # added to that of ICP
MIN_INFORMATION_RATIO = 0.05  # of the weakest direction to the strongest; an aisle has less

VISIT_TRAVEL_M = 30.0  # after this travel a place is visited again
OUT_OF_REACH_M = 1.5  # of drift; with less the search for near loops finds the place
PLACE_DRIFT_SIGMAS = 3.0  # within which a place may be
STRETCH_M = 8.0  # of travel, matched at once
STRETCH_SPACING_M = 3.0  # of travel, from stretch to stretch
PLACE_RADIUS_M = 10.0  # of travel before and after a place's keyframe
MAX_SCANS = 16  # of a stretch or a place
PLACE_SPACING_M = 5.0
PLACE_WINDOW = Window(4.5, 0.6, 0.02)  # largest search round a place
REFINED_WINDOW = Window(0.3, 0.06, 0.02)
PLACE_CELL_M, PLACE_SIGMA_M = 0.1, 0.15  # of the likelihood image
VOXEL_M = 0.2  # a stretch has one point in each
ROUGH_POINTS, REFINED_POINTS, PLACE_ICP_POINTS = 60, 240, 720
ROUGH_SCORE, PLACE_SCORE = 0.4, 0.5
PLACE_GATE_M, PLACE_SLIDE_M = 0.5, 0.5
PLACE_INLIERS, PLACE_RMS_M = 0.6, 0.08  # inliers: share of the points
MAX_SEEN_THROUGH = 0.2  # share of a place's points that a scan looks through
NEARBY_M = 8.0  # an earlier stretch is searched again if it is this near to an older path
PLACES_PER_KEYFRAME = 10  # matched; this bounds the time per keyframe
STRETCH_START_PLACES = 3  # starting a stretch takes as long as matching so many places
MAX_NEAREST, MAX_OTHERS = 36, 36  # places matched to a stretch
BEST_GUESSES = 8  # of a stretch that are kept
GUESS_MEMORY_M = 40.0  # of travel; guesses farther apart are not compared
MAX_GUESSES = 96
REVISIT_SPACING_M = 4.0  # of travel, between earlier stretches to search again after a correction
GUESS_TOLERANCE = np.array((0.5, 0.5, 0.06))  # [m], [m], [rad], between two guesses
MIN_STRETCHES = 3  # that agree
MIN_SPAN_M = 10.0  # of travel, from the first of them to the last
MAX_RIVAL_SHARE = 0.5  # stretches that agree on another place, to those that agree on this one


class Trajectory(NamedTuple):
    """Keyframes, their poses (n, 3), and the distances driven before each (n,) [m]."""

    keyframes: Sequence[Keyframe]
    poses: Floats
    travel: Floats


class LoopSearch:
    """Searches for loops from each keyframe in turn. One thread at a time."""

    def __init__(self, rates: DriftRates) -> None:
        self.drift = Drift(rates)
        self._places = PlaceSearch(self.drift)
        self.waiting: list[Edge] = []  # loops without a witness
        self.searched = -SEARCH_SPACING_M  # [m] of travel

    def find(self, keyframes: Sequence[Keyframe], poses: Floats) -> list[Edge]:
        """Return confirmed loops that end at the last keyframe, and loops that they confirm."""
        travel = np.array([keyframe.travel for keyframe in keyframes])
        trajectory = Trajectory(keyframes, poses, travel)
        far = self._places.find(trajectory)
        for loop in far:
            self.drift.add_loop(loop)
        return far or self._find_near(trajectory)

    def _find_near(self, trajectory: Trajectory) -> list[Edge]:
        keyframes, poses, travel = trajectory
        if travel[-1] - self.searched < SEARCH_SPACING_M:
            return []
        self.searched = float(travel[-1])
        self.waiting = [w for w in self.waiting if travel[-1] - travel[w.second] < WITNESS_TRAVEL_M]
        here = len(keyframes) - 1
        attempts = [
            _try_loop(trajectory, there, here, *self.drift.between(there, here, poses))
            for there in _candidates(poses, travel, here)
        ]
        found = [loop for loop in attempts if loop and self.drift.explains(loop, poses)]
        confirmed = [loop for one in found for loop in self._confirmed(one, poses)]
        for loop in confirmed:
            self.drift.add_loop(loop)
        return confirmed

    def _confirmed(self, loop: Edge, poses: Floats) -> list[Edge]:
        """Return the loop and its witnesses; nothing if it needs a witness and has none."""
        witnesses = [
            w for w in self.waiting if w.second != loop.second and _close_circle(loop, w, poses)
        ]
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


def _try_loop(
    trajectory: Trajectory, there: int, here: int, turn: float, away: float
) -> Edge | None:
    """Return the loop from `there` to `here` if the scan of `here` fits that place.

    `turn` and `away` are the drift's variances. They decide in directions that the place leaves
    open. The loop's covariance excludes them, as the graph includes them already.
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
    slide = float(np.hypot(*(fit.pose - found.pose)[:2]))
    if fit.inliers < MIN_INLIERS or fit.rms > MAX_RMS_M or slide > MAX_SLIDE_M:
        return None
    weakest, strongest = np.linalg.eigvalsh(fit.information[:2, :2])
    if weakest < MIN_INFORMATION_RATIO * strongest:
        return None
    pose = wrapped(fit.pose)
    covariance = LOOP_COVARIANCE + turned(inverse_of(fit.information), -float(pose[2]))
    return Edge(there, here, pose, covariance, doubtful=True)


def _window(turn: float, away: float) -> Window:
    max_away, max_turn = DRIFT_SIGMAS * np.sqrt((away, turn))
    return Window(
        min(LOOP_WINDOW.away, max_away), min(LOOP_WINDOW.turn, max_turn), LOOP_WINDOW.step
    )


def _is_small(loop: Edge, poses: Floats) -> bool:
    change = between(between(poses[loop.first], poses[loop.second]), loop.relative)
    return bool((np.abs(change) < SMALL_CORRECTION).all())


def _close_circle(one: Edge, other: Edge, poses: Floats) -> bool:
    there = between(poses[one.first], poses[other.first])
    back = compose(other.relative, between(poses[other.second], poses[one.second]))
    round_trip = compose(compose(there, back), inverse(one.relative))
    return bool((np.abs(round_trip) < WITNESS_TOLERANCE).all())


@dataclass(frozen=True, slots=True)
class _Stretch:
    """A stretch of the path, and the places to match it to."""

    here: int  # its last keyframe
    points: Points  # in the frame of `here`
    places: list[int]  # keyframes, not yet matched
    turn: Floats  # (n,), variance of the drift of yaw since each keyframe
    away: Floats  # (n,), the same of position
    found: list[tuple[float, Edge]]  # inliers, and the loop


class PlaceSearch:
    """Searches for places far from where the robot seems to be. One thread at a time."""

    def __init__(self, drift: Drift) -> None:
        self._drift = drift
        self._stretches: dict[bool, _Stretch | None] = {False: None, True: None}  # True: revisited
        self._searched_travel = -STRETCH_SPACING_M  # [m] of travel
        self._next_place = 0  # keyframe from which places beyond the nearest are tried in turn
        self._guesses: list[Edge] = []
        self._revisiting = False  # the present stretch is an earlier one
        self._revisits: list[int] = []  # keyframes to search from again, the last first

    def find(self, trajectory: Trajectory) -> list[Edge]:
        """Match some more places, and return the loops to a confirmed one.

        Calls alternate between the newest and earlier stretches, if there are any: a correction
        may bring places into reach of a stretch that was searched before.
        """
        _, poses, travel = trajectory
        waiting = bool(self._revisits) or self._stretches[True] is not None
        self._revisiting = waiting and not self._revisiting
        left = PLACES_PER_KEYFRAME
        while left > 0:
            stretch = self._stretches[self._revisiting]
            if stretch is None:
                stretch = self._next_stretch(trajectory)
                left = max(left - STRETCH_START_PLACES, 1)
            if stretch is None:
                return []
            now, later = stretch.places[:left], stretch.places[left:]
            found = [_match_place(trajectory, stretch, there) for there in now]
            stretch.found.extend(one for one in found if one)
            stretch.places[:], left, done = later, left - len(now), not later
            self._stretches[self._revisiting] = None if done else stretch
            confirmed = self._agreed(stretch, poses, travel) if done else []
            if any(_is_far(loop, poses) for loop in confirmed):
                ends = np.arange(travel[0] + STRETCH_M, travel[-1], REVISIT_SPACING_M)
                self._revisits = np.searchsorted(travel, ends).tolist()
            if confirmed:
                return confirmed
        return []

    def _next_stretch(self, trajectory: Trajectory) -> _Stretch | None:
        """Return the next stretch to search for, if there is one."""
        keyframes, poses, travel = trajectory
        if not self._revisiting:
            if travel[-1] - self._searched_travel < STRETCH_SPACING_M:
                return None
            self._searched_travel = float(travel[-1])
            return self._stretch_at(trajectory, len(keyframes) - 1)
        while self._revisits:
            here = self._revisits.pop()
            earlier = np.flatnonzero(travel[here] - travel > VISIT_TRAVEL_M)
            if (np.hypot(*(poses[earlier, :2] - poses[here, :2]).T) < NEARBY_M).any():
                return self._stretch_at(trajectory, here, NEARBY_M)
        return None

    def _stretch_at(
        self, trajectory: Trajectory, here: int, limit: float = np.inf
    ) -> _Stretch | None:
        """Return the stretch that ends at `here`, if drift may have put places out of reach."""
        _, poses, travel = trajectory
        turn, away = self._drift.spread(here, poses)
        far = np.hypot(*(poses[:, :2] - poses[here, :2]).T)
        reach = PLACE_DRIFT_SIGMAS * np.sqrt(away)
        possible = (travel[here] - travel > VISIT_TRAVEL_M) & (reach > OUT_OF_REACH_M)
        near = np.flatnonzero(possible & (far < np.minimum(reach + PLACE_WINDOW.away, limit)))
        if not len(near):
            return None
        first = int(np.searchsorted(travel, travel[here] - STRETCH_M))
        points = _merged_points(trajectory, _spread_indices(first, here + 1), here)
        places = self._places(poses, here, near[np.argsort(far[near])])
        return _Stretch(here, points, places, turn, away, [])

    def _places(self, poses: Floats, here: int, near: NDArray[np.intp]) -> list[int]:
        """Return the places to match, from the keyframes `near`, which are sorted by distance.

        First where recent guesses put the robot, then the nearest places, then others in turn.
        """
        recent = self._guesses[-BEST_GUESSES:]
        expected = [self._expected(guess, poses, here, near) for guess in recent]
        spaced = _one_per_square(poses, near)
        others = np.sort(spaced[MAX_NEAREST:])
        others = np.roll(others, -int(np.searchsorted(others, self._next_place)))[:MAX_OTHERS]
        self._next_place = int(others[-1]) + 1 if len(others) else 0
        return list(dict.fromkeys([*expected, *spaced[:MAX_NEAREST].tolist(), *others.tolist()]))

    def _expected(self, guess: Edge, poses: Floats, here: int, near: NDArray[np.intp]) -> int:
        """Return the keyframe in `near` that is nearest to the robot if the guess is right."""
        led = compose(guess.relative, between(poses[guess.second], poses[here]))
        at = compose(poses[guess.first], led)
        return int(near[np.argmin(np.hypot(*(poses[near, :2] - at[:2]).T))])

    def _agreed(self, stretch: _Stretch, poses: Floats, travel: Floats) -> list[Edge]:
        """Return the guesses that agree, if they are enough and few agree on another place."""
        best = sorted(stretch.found, key=lambda one: -one[0])[:BEST_GUESSES]
        self._guesses = [*self._guesses, *(guess for _, guess in best)][-MAX_GUESSES:]
        away = np.abs(travel - travel[stretch.here])
        guesses = [guess for guess in self._guesses if away[guess.second] < GUESS_MEMORY_M]
        if not guesses:
            return []
        agree = _agreement(guesses, poses)
        ends = np.array([guess.second for guess in guesses])
        group = _largest_group(agree, ends, np.ones(len(ends), bool))
        rival = _largest_group(agree, ends, np.asarray(~agree[group].any(axis=0)))
        support, against = len(set(ends[group])), len(set(ends[rival]))
        span = float(np.ptp(travel[ends[group]]))
        if support < MIN_STRETCHES or span < MIN_SPAN_M or against > MAX_RIVAL_SHARE * support:
            return []
        used = {id(guess) for guess in guesses}
        self._guesses = [guess for guess in self._guesses if id(guess) not in used]
        return [guesses[k] for k in group]


def _is_far(loop: Edge, poses: Floats) -> bool:
    """Return whether the correction is beyond the search for near loops."""
    change = between(between(poses[loop.first], poses[loop.second]), loop.relative)
    return bool(np.hypot(change[0], change[1]) > OUT_OF_REACH_M)


def _spread_indices(first: int, end: int) -> list[int]:
    count = min(MAX_SCANS, end - first)
    return [int(k) for k in np.linspace(first, end - 1, count)]


def _merged_points(trajectory: Trajectory, chosen: Sequence[int], here: int) -> Points:
    """Return points of the chosen keyframes in the frame of `here`, one per voxel."""
    keyframes, poses, _ = trajectory
    placed = [transform(between(poses[here], poses[k]), keyframes[k].points) for k in chosen]
    points = np.concatenate(placed)
    _, first = np.unique(np.floor(points / VOXEL_M), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)], np.float32)


def _one_per_square(poses: Floats, near: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the first keyframe in `near` of each square and quarter of the compass."""
    squares = np.floor(poses[near] / (PLACE_SPACING_M, PLACE_SPACING_M, np.pi / 2))
    _, first = np.unique(squares, axis=0, return_index=True)
    return near[np.sort(first)]


def _match_place(
    trajectory: Trajectory, stretch: _Stretch, there: int
) -> tuple[float, Edge] | None:
    """Return the share of inliers and the loop from `there`, if the stretch fits that place."""
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
        PLACE_WINDOW.away,
        min(PLACE_WINDOW.turn, PLACE_DRIFT_SIGMAS * np.sqrt(turn)),
        PLACE_WINDOW.step,
    )
    start, points = np.array((0.0, 0.0, yaw)), stretch.points
    found = search(local.image, points, start, window, ROUGH_SCORE, ROUGH_POINTS)
    if found.score < ROUGH_SCORE:
        return None
    found = search(local.image, points, found.pose, REFINED_WINDOW, PLACE_SCORE, REFINED_POINTS)
    if found.score < PLACE_SCORE:
        return None
    no_prior = np.zeros((3, 3))
    fit = icp(
        local.buckets,
        thinned(points, PLACE_ICP_POINTS),
        found.pose,
        PLACE_GATE_M,
        no_prior,
        found.pose,
    )
    slide = float(np.hypot(*(fit.pose - found.pose)[:2]))
    if fit.inliers < PLACE_INLIERS or fit.rms > PLACE_RMS_M or slide > PLACE_SLIDE_M:
        return None
    weakest, strongest = np.linalg.eigvalsh(fit.information[:2, :2])
    if weakest < MIN_INFORMATION_RATIO * strongest:
        return None
    if (
        seen_through(local.buckets.points, keyframes[stretch.here].points, fit.pose)
        > MAX_SEEN_THROUGH
    ):
        return None
    pose = wrapped(fit.pose)
    covariance = LOOP_COVARIANCE + turned(inverse_of(fit.information), -float(pose[2]))
    loop = Edge(there, stretch.here, pose, covariance, doubtful=True)
    return (fit.inliers, loop) if explained(loop, poses, turn, away) else None


def _agreement(guesses: Sequence[Edge], poses: Floats) -> NDArray[np.bool_]:
    """Return which pairs agree (n, n): out by one guess and back by the other closes a circle."""
    first, second = poses[[g.first for g in guesses]], poses[[g.second for g in guesses]]
    relative = np.array([guess.relative for guess in guesses])
    there = between(first[:, None], first[None])
    back = compose(relative[None], between(second[None], second[:, None]))
    round_trip = compose(compose(there, back), inverse(relative)[:, None])
    return np.asarray((np.abs(round_trip) < GUESS_TOLERANCE).all(axis=-1))


def _largest_group(
    agree: NDArray[np.bool_], ends: NDArray[np.intp], eligible: NDArray[np.bool_]
) -> list[int]:
    """Return a group that agrees in all pairs, greedily with many different `ends`."""
    best: list[int] = []
    for seed in np.flatnonzero(eligible):
        group, left = [int(seed)], agree[seed] & agree[:, seed] & eligible
        left[seed] = False
        while left.any():
            likeliest = int(np.argmax(np.where(left, agree.sum(axis=1), -1)))
            group.append(likeliest)
            left &= agree[likeliest] & agree[:, likeliest]
            left[likeliest] = False
        best = max(best, group, key=lambda some: len(set(ends[some])))
    return best
