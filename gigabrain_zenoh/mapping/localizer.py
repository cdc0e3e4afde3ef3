"""Localizes in a known map: tracks hypotheses, searches when lost, detects kidnapping.

While several places explain the scans, the robot is not localized. Each is followed until scans
contradict it.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import IDENTITY, between, compose, inverse, turned
from gigabrain_zenoh.host.threads import ScheduledWorker, Take
from gigabrain_zenoh.mapping.global_localization import MIN_POINTS, Candidate, apart, search
from gigabrain_zenoh.mapping.keyframes import View
from gigabrain_zenoh.mapping.likelihood_field import (
    CONTRADICTION_CAP_M,
    LikelihoodField,
    clearance,
    contradiction,
    field_of,
    fit,
    is_self_similar,
)
from gigabrain_zenoh.mapping.occupancy_grid import CELL, LogOddsGrid
from gigabrain_zenoh.mapping.pose_hint import PoseHint, better, explained, far_from

LOST_SCORE, LOST_SCANS = 0.45, 5  # worse fits in a row: the robot is somewhere else
CONFIRMED_SCORE, CONFIRMED_SCANS = 0.65, 3  # better fits in a row at the only place: it is here
# shares of all beams that the map rules out:
MOVING_TOLERANCE = 0.03  # more than at the best place; less does not count while the robot moves
STILL_TOLERANCE, STILL_SCANS = 0.05, 5  # the same at rest, where one scan in so many counts
MAX_CONTRADICTION = 0.2  # in sum, for a hypothesis
MAX_ODOMETRY_CONTRADICTION = 0.6  # in sum, at odometry's place: a person may stand in the view
MAX_CONFIRMED_WRONG = 0.15  # in a scan that confirms a place
MAX_BAD_WRONG = 0.1  # of a place that fits badly
MAX_BUMP_M, MAX_BUMP_RAD = 0.6, math.radians(45)  # error of odometry after slip or a collision
MIN_CLEARANCE_M = 0.08  # of a body's centre
MIN_SHOWN = 0.1  # share of the hits; a place where the map can judge fewer is not judged
SYMMETRY_CHECK_SCANS = 20  # bad ones, after which the map's symmetry must support a place
VIEW_M, VIEW_RAD = 0.1, math.radians(6)  # after this motion a scan is a new view
MAX_DEVIATION_M, MAX_DEVIATION_RAD = 0.5, math.radians(20)  # of a localized robot
SEARCH_INTERVAL_SCANS = 10
FOUND_COVARIANCE = np.diag((0.1, 0.1, 0.05)) ** 2  # of a place that a search found
NOWHERE = np.diag((1e3, 1e3, math.pi)) ** 2  # covariance of an unknown pose

SAME_SCORE_BAND = 0.1  # below the best: a hint does not distinguish its places in this band
HINT_INTERVAL_SCANS = 3  # between hints that a localized robot checks
ELSEWHERE = "a tag and the scan place the robot elsewhere"
SEARCH_DEADLINE_SCANS = 8  # after which the result of a search is used

JUDGED_RADIUS_M = 5.0  # round the robot; beams that end farther away are not judged
JUDGED_STEP_M = 0.5  # of the grid of centres for the map round the robot
SUDDEN_INCREASE = 0.3  # of the share of ruled-out beams
USUAL_GAIN = 0.1  # of a new scan in the usual share
KIDNAPPED_SCANS = 3  # in a row, for certainty


@dataclass(frozen=True, slots=True)
class Place:
    """Estimated pose of the robot."""

    pose: Floats  # (3,)
    covariance: Floats  # (3, 3), in the map's axes
    localized: bool
    why: str = ""  # reason if it is not localized


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A possible place of the robot."""

    pose: Floats
    covariance: Floats
    score: float = 0.0
    shown: float = 1.0  # see FieldFit
    wrong: float = 0.0  # see FieldFit
    contradiction: float = 0.0  # sum of excess shares of ruled-out beams
    by_odometry: bool = False  # odometry leads here from the last known pose, or a hint does
    good_scans: int = 0  # in a row, which fit well
    bad_scans: int = 0  # in a row, which fit badly


@dataclass(slots=True)
class Localizer:
    """Follows hypotheses through one map."""

    map: LikelihoodField
    why: str = "not found yet"
    _places: list[Hypothesis] = field(default_factory=list)
    _localized: bool = False
    _scans_since_search: int = SEARCH_INTERVAL_SCANS
    _scans_since_view: int = 0
    _moved: Floats = field(default_factory=lambda: IDENTITY.copy())  # since the last view
    _last: Hypothesis = field(default_factory=lambda: Hypothesis(IDENTITY, NOWHERE))

    @property
    def wants_search(self) -> bool:
        """Return whether the whole map should be searched now."""
        return not self._places and self._scans_since_search >= SEARCH_INTERVAL_SCANS

    @property
    def place(self) -> Place:
        """The present estimate."""
        if self._localized:
            here = self._places[0]
            return Place(here.pose, here.covariance, True)
        best = self._places[0] if self._places else self._last
        return Place(best.pose, NOWHERE, False, self.why)

    def lose(self, why: str) -> None:
        """Search the whole map for the robot."""
        if self._places:
            self._last = self._places[0]
        self._places, self._localized, self.why = [], False, why
        self._scans_since_search = SEARCH_INTERVAL_SCANS

    def search_started(self) -> None:
        """Note that a search with the scan of the last step has started."""
        self._scans_since_search = 0

    def found(self, candidates: list[Candidate], moved: Floats, last: Floats | None = None) -> None:
        """Follow the candidates of a search; `moved` (3,) is the motion since its scan.

        `last` (3,) is the robot's present pose by odometry, if it was known before it was lost.
        """
        if self._places:
            return
        poses = [compose(one.pose, moved) for one in candidates]
        here = None if last is None else _nearest_to_odometry(poses, last)
        self._places = [
            Hypothesis(pose, FOUND_COVARIANCE, one.score, by_odometry=k == here)
            for k, (pose, one) in enumerate(zip(poses, candidates, strict=True))
        ]
        self.why = _in_words(len(poses))

    def suggest(self, candidates: list[Candidate]) -> None:
        """Follow the candidates of a hint for the last scan, beside the other places.

        A single one counts like odometry's place. A localized robot stays where it is.
        """
        if self._localized or not candidates:
            return
        similar = [one for one in candidates if one.score >= candidates[0].score - SAME_SCORE_BAND]
        only_one = len(similar) == 1
        for one in similar:
            near = [k for k, h in enumerate(self._places) if not apart(h.pose, (one.pose,))]
            good_scans = int(one.score >= CONFIRMED_SCORE)
            hypothesis = Hypothesis(one.pose, FOUND_COVARIANCE, one.score, good_scans=good_scans)
            if near:
                hypothesis = self._places.pop(near[0])
            self._places.insert(0, replace(hypothesis, by_odometry=only_one))
        self.why = _in_words(len(self._places))

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """Process one scan after a `motion` (3,) of covariance `noise` (3, 3), in its own frame."""
        self._scans_since_search += 1
        self._moved = compose(self._moved, motion)
        seen = len(view.scan.points) >= MIN_POINTS
        self._places = [
            _fitted(self.map, _predicted(one, motion, noise), view if seen else None)
            for one in self._places
        ]
        if self._localized:
            self._check_localized()
        elif seen and self._places:
            self._check_hypotheses()
        return self.place

    def _check_localized(self) -> None:
        """Lose the robot if its place no longer fits or is too uncertain."""
        here = self._places[0]
        if here.bad_scans >= LOST_SCANS:
            self.lose("the scans do not fit the robot's place in the map")
            return
        deviations = np.sqrt(np.diag(here.covariance))
        if max(deviations[0], deviations[1]) > MAX_DEVIATION_M or deviations[2] > MAX_DEVIATION_RAD:
            self.lose("the scans did not confirm the robot's place for too long")

    def _check_hypotheses(self) -> None:
        """Drop places that scans contradict; localize the robot when one is confirmed."""
        moved = math.hypot(self._moved[0], self._moved[1]) > VIEW_M
        moved = moved or abs(float(self._moved[2])) > VIEW_RAD
        self._scans_since_view = 0 if moved else self._scans_since_view + 1
        if moved or self._scans_since_view % STILL_SCANS == 0:
            least = min(one.wrong for one in self._places)
            bar = least + (MOVING_TOLERANCE if moved else STILL_TOLERANCE)
            self._moved = IDENTITY.copy() if moved else self._moved
            self._places = [_with_contradiction(one, bar) for one in self._places]
        best = max(self._places, key=lambda one: one.score)
        left = [one for one in self._places if _is_possible(one) and not self._left_map(one, best)]
        self._places = []
        for one in sorted(left, key=lambda one: (not one.by_odometry, -one.score)):
            if apart(one.pose, (other.pose for other in self._places)):
                self._places.append(one)
        if all(one.bad_scans >= LOST_SCANS for one in self._places):
            self.lose("no place in the map matches the scans")
        elif (confirmed := self._confirmed()) is not None:
            self._places, self._localized, self.why = [confirmed], True, ""
        else:
            self.why = _in_words(len(self._places))

    def _confirmed(self) -> Hypothesis | None:
        """Return the only place left, or that of odometry, if the last scans fit it.

        Earlier contradictions of the latter do not count: a person may have stood in the view.
        """
        for one in self._places:
            if one.good_scans >= CONFIRMED_SCANS and (one.by_odometry or len(self._places) == 1):
                return one
        return None

    def _left_map(self, one: Hypothesis, best: Hypothesis) -> bool:
        """Return whether `one` left the mapped area, and the map's symmetry does not support it."""
        if (
            one.shown >= MIN_SHOWN
            or one.bad_scans % SYMMETRY_CHECK_SCANS != SYMMETRY_CHECK_SCANS - 1
            or not best.good_scans
        ):
            return False
        return not is_self_similar(self.map, compose(one.pose, inverse(best.pose)))


def _is_possible(one: Hypothesis) -> bool:
    """Return whether neither beams nor a bad fit rule out a place.

    A bad fit alone may come from a bad map, as at its edge.
    """
    limit = MAX_ODOMETRY_CONTRADICTION if one.by_odometry else MAX_CONTRADICTION
    return one.contradiction < limit and (one.bad_scans < LOST_SCANS or one.wrong < MAX_BAD_WRONG)


def _nearest_to_odometry(poses: list[Floats], last: Floats) -> int | None:
    """Return the index of the place nearest to odometry's, if one is near."""
    off = [between(last, pose).tolist() for pose in poses]
    away = [math.hypot(x, y) if abs(yaw) < MAX_BUMP_RAD else math.inf for x, y, yaw in off]
    nearest = min(range(len(away)), key=away.__getitem__, default=None)
    return None if nearest is None or away[nearest] > MAX_BUMP_M else nearest


def _in_words(count: int) -> str:
    places = {0: "no place in the map matches the scans", 1: "one place matches the scans"}
    return places.get(count, f"{count} places match the scans")


def _predicted(one: Hypothesis, motion: Floats, noise: Floats) -> Hypothesis:
    pose = compose(one.pose, motion)
    turn = np.eye(3)
    turn[0, 2], turn[1, 2] = one.pose[1] - pose[1], pose[0] - one.pose[0]
    spread = turn @ one.covariance @ turn.T + turned(noise, float(one.pose[2]))
    return replace(one, pose=pose, covariance=spread)


def _fitted(map_field: LikelihoodField, one: Hypothesis, view: View | None) -> Hypothesis:
    """Return `one` moved to where the scan fits best, if it fits nearby."""
    if view is None:
        return one
    prior = _inverse(one.covariance)
    found = fit(map_field, view.beams, one.pose, prior)
    seen = replace(one, score=found.score, shown=found.shown, wrong=found.wrong, good_scans=0)
    if clearance(map_field, one.pose) < MIN_CLEARANCE_M:
        seen = replace(seen, contradiction=math.inf)
    if found.score < LOST_SCORE:
        seen = replace(seen, bad_scans=one.bad_scans + 1)
    if found.shown < MIN_SHOWN or found.likely < LOST_SCORE:
        return seen
    return replace(
        seen,
        pose=found.pose,
        covariance=_inverse(prior + found.information),
        good_scans=one.good_scans + 1
        if found.score >= CONFIRMED_SCORE and found.wrong < MAX_CONFIRMED_WRONG
        else 0,
        bad_scans=0 if found.score >= LOST_SCORE else seen.bad_scans,
    )


def _with_contradiction(one: Hypothesis, bar: float) -> Hypothesis:
    return replace(one, contradiction=one.contradiction + max(one.wrong - bar, 0.0))


def _inverse(matrix: Floats) -> Floats:
    return np.asarray(np.linalg.inv(matrix), np.float64)


class BackgroundLocalizer:
    """Localizes in a fixed map, and searches it in the background."""

    def __init__(
        self,
        field: LikelihoodField,
        why: str,
        background: ScheduledWorker,
        last: Floats | None = None,
    ) -> None:
        self._localizer = Localizer(field, why)
        self._background = background
        self._moved = IDENTITY  # since the scan of the running search
        self.last = last  # (3,), the last known pose, moved by odometry
        self._losses = 0
        self._hint: PoseHint | None = None  # of the next scan
        self._scans_since_hint = HINT_INTERVAL_SCANS  # that a localized robot checked

    def suggest(self, hint: PoseHint) -> None:
        """See RobotMap."""
        self._hint = hint

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """Process one scan; start a search of the whole map if it is needed."""
        self._moved = compose(self._moved, motion)
        self.last = None if self.last is None else compose(self.last, motion)
        place = self._localizer.step(view, motion, noise)
        hint, self._hint = self._hint, None
        if place.localized and hint and self._is_elsewhere(view, hint, place.pose):
            self.lose(ELSEWHERE)
            place = self._localizer.place
        if place.localized:
            self.last = place.pose
        elif hint:
            self._localizer.suggest(explained(self._localizer.map, view.beams, hint))
            place = self._localizer.place
        if self._localizer.wants_search and self._background.idle:
            self._search(view)
        return place

    def _is_elsewhere(self, view: View, hint: PoseHint, pose: Floats) -> bool:
        """Return whether the scan fits better at the hint than at the robot's pose."""
        self._scans_since_hint += 1
        if self._scans_since_hint < HINT_INTERVAL_SCANS or not far_from(hint, pose):
            return False
        self._scans_since_hint = 0
        return bool(better(self._localizer.map, view.beams, hint, pose))

    def lose(self, why: str) -> None:
        """Search the whole map for the robot; discard the result of a running search."""
        self._losses += 1
        self._localizer.lose(why)

    def _search(self, view: View) -> None:
        localizer, number, last = self._localizer, self._losses, self.last
        localizer.search_started()
        self._moved = IDENTITY

        def work() -> Take:
            found = search(localizer.map, view.beams, last)

            def take() -> None:
                if number == self._losses:
                    localizer.found(found, self._moved, self.last)

            return take

        self._background.start(work, SEARCH_DEADLINE_SCANS)


class KidnapDetector:
    """Checks each scan before it is added to the map."""

    def __init__(self) -> None:
        self._usual_share = 0.0  # share of beams that the map rules out
        self._field: LikelihoodField | None = None  # None where the map is empty
        self._field_key: tuple[LogOddsGrid, int, float, float] | None = None
        self.scans = 0  # in a row, that contradict the map

    @property
    def certain(self) -> bool:
        """Return whether enough scans contradict the map."""
        return self.scans >= KIDNAPPED_SCANS

    def look(self, grid: LogOddsGrid, view: View, pose: Floats) -> bool:
        """Return whether the scan contradicts the map at `pose`, the robot's pose by odometry."""
        field = self._field_around(grid, pose)
        if field is None:
            return False
        share = contradiction(field, view.beams, pose)
        if share > self._usual_share + SUDDEN_INCREASE:
            self.scans += 1
            return True
        self._usual_share += USUAL_GAIN * (share - self._usual_share)
        self.scans = 0
        return False

    def _field_around(self, grid: LogOddsGrid, pose: Floats) -> LikelihoodField | None:
        """Return the field around `pose`; build it again after the grid changed."""
        x, y = (round(v / JUDGED_STEP_M) * JUDGED_STEP_M for v in pose[:2].tolist())
        key = grid, grid.scans, x, y
        if key != self._field_key:
            cells, corner = grid.around(x, y, JUDGED_RADIUS_M)
            self._field = field_of(cells, CELL, corner, CONTRADICTION_CAP_M) if cells.size else None
            self._field_key = key
        return self._field
