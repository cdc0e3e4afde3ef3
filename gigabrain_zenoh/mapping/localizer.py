"""Localizes in a known map: tracks hypotheses, searches when lost, detects kidnapping.

While more than one place explains the scans, none is believed. Each is followed until scans
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

LOST_SCORE, LOST_SCANS = 0.45, 5  # so bad a fit for so long: the robot is somewhere else
# so good a fit for so many scans, and the only one: it is here
CONFIRMED_SCORE, CONFIRMED_SCANS = 0.65, 3
TOLERANCE = 0.03  # of all beams ruled out, more than elsewhere, say nothing against a place,
STILL_TOLERANCE, STILL_SCANS = 0.05, 5  # and while the robot stands, it takes more, and some scans
AGAINST = 0.2  # that much in all speaks against it,
AGAINST_ODOMETRY = 0.6  # and that much at odometry's place: a person may stand in the view
BUMPED_M, BUMPED_RAD = 0.6, math.radians(45)  # so far off odometry, it may have slipped or been hit
MAX_WRONG = 0.15  # of all beams ruled out, or it is not sure to be here
DOUBTED_WRONG = 0.1  # ruled out, where the fit is bad as well, are enough against a place
WALL_M = 0.08  # so near to a wall there is no body
SHOWN = 0.1  # of the hits: a place that the map shows less of cannot be judged
GONE_SCANS = 20  # after so many, it is asked whether that place is likely at all
VIEW_M, VIEW_RAD = 0.1, math.radians(6)  # farther on, what is seen counts as seen elsewhere
LOOSE_M, LOOSE_RAD = 0.5, math.radians(20)  # a deviation beyond that is no position
SEARCH_INTERVAL_SCANS = 10  # from one search of the whole map to the next
SPREAD = np.diag((0.1, 0.1, 0.05)) ** 2  # the covariance of a place that a search has found
NOWHERE = np.diag((1e3, 1e3, math.pi)) ** 2  # the covariance of what is not known

ALIKE_SCORE = 0.1  # places of one hint that fit so much alike: the hint does not tell them apart
ASKED_SCANS = 3  # between two looks of a localized robot at where a hint says that it is
ELSEWHERE = "a tag says that it is elsewhere, and so does the scan"
SEARCH_DEADLINE_SCANS = 8  # after which what a search has found is taken

JUDGED_RADIUS_M = 5.0  # round the robot, beams that end farther off are not judged
JUDGED_STEP_M = 0.5  # from one place to the next at which the map round the robot is looked at
SUDDEN_INCREASE = 0.3  # so many more of all beams than before
USUAL_GAIN = 0.1  # of a new scan in what is usual
KIDNAPPED_SCANS = 3  # in a row, then it is certain


@dataclass(frozen=True, slots=True)
class Place:
    """Estimated pose of the robot."""

    pose: Floats  # (3,)
    covariance: Floats  # (3, 3), in the map's axes
    localized: bool
    why: str = ""  # not


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A possible place of the robot."""

    pose: Floats
    covariance: Floats
    score: float = 0.0
    shown: float = 1.0  # of the hits, see FieldFit
    wrong: float = 0.0  # beams that the map rules out, see FieldFit
    against: float = 0.0
    continues: bool = False  # odometry has the robot here, from where it was before it was lost
    good: int = 0  # scans in a row that fit
    bad: int = 0  # scans in a row that do not


@dataclass(slots=True)
class Localizer:
    """Follows hypotheses through one map."""

    map: LikelihoodField
    why: str = "not found yet"
    _places: list[Hypothesis] = field(default_factory=list)
    _localized: bool = False
    _unsearched: int = SEARCH_INTERVAL_SCANS  # scans since the last search
    _still: int = 0  # scans since the last view
    _moved: Floats = field(default_factory=lambda: IDENTITY.copy())  # since the last view
    _last: Hypothesis = field(default_factory=lambda: Hypothesis(IDENTITY, NOWHERE))

    @property
    def wants_search(self) -> bool:
        """Return whether the whole map should be searched now."""
        return not self._places and self._unsearched >= SEARCH_INTERVAL_SCANS

    @property
    def place(self) -> Place:
        """The present estimate."""
        if self._localized:
            here = self._places[0]
            return Place(here.pose, here.covariance, True)
        best = self._places[0] if self._places else self._last
        return Place(best.pose, NOWHERE, False, self.why)

    def believe(self, pose: Floats, covariance: Floats) -> None:
        """Follow this place alone; it is known to be right."""
        self._places, self._localized, self.why = [Hypothesis(pose, covariance)], True, ""

    def lose(self, why: str) -> None:
        """Search the whole map for the robot."""
        if self._places:
            self._last = self._places[0]
        self._places, self._localized, self.why = [], False, why
        self._unsearched = SEARCH_INTERVAL_SCANS

    def searching(self) -> None:
        """Somebody has begun to search with the scan of the last step."""
        self._unsearched = 0

    def found(self, candidates: list[Candidate], moved: Floats, last: Floats | None = None) -> None:
        """Follow what a search has found, `moved` (3,) being the way since its scan.

        `last` (3,) is where odometry has the robot now, if it was known before it was lost.
        """
        if self._places:
            return
        poses = [compose(one.pose, moved) for one in candidates]
        here = None if last is None else _continuing(poses, last)
        self._places = [
            Hypothesis(pose, SPREAD, one.score, continues=k == here)
            for k, (pose, one) in enumerate(zip(poses, candidates, strict=True))
        ]
        self.why = _in_words(len(poses))

    def suggest(self, candidates: list[Candidate]) -> None:
        """Follow what a hint has found at the last scan, beside the other places.

        If it is a single place, it counts as odometry's does. A robot that is localized stays.
        """
        if self._localized or not candidates:
            return
        alike = [one for one in candidates if one.score >= candidates[0].score - ALIKE_SCORE]
        sole = len(alike) == 1
        for one in alike:
            near = [k for k, h in enumerate(self._places) if not apart(h.pose, (one.pose,))]
            good = int(one.score >= CONFIRMED_SCORE)
            there = Hypothesis(one.pose, SPREAD, one.score, good=good)
            if near:
                there = self._places.pop(near[0])
            self._places.insert(0, replace(there, continues=sole))
        self.why = _in_words(len(self._places))

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """Process one scan after a `motion` (3,) of covariance `noise` (3, 3), in its own frame."""
        self._unsearched += 1
        self._moved = compose(self._moved, motion)
        seen = len(view.scan.points) >= MIN_POINTS
        self._places = [
            _followed(self.map, _predicted(one, motion, noise), view if seen else None)
            for one in self._places
        ]
        if self._localized:
            self._doubt()
        elif seen and self._places:
            self._choose()
        return self.place

    def _doubt(self) -> None:
        """Give up the one place if it no longer fits or is too uncertain."""
        here = self._places[0]
        if here.bad >= LOST_SCANS:
            self.lose("what is seen is not where the robot was thought to be")
            return
        deviations = np.sqrt(np.diag(here.covariance))
        if max(deviations[0], deviations[1]) > LOOSE_M or deviations[2] > LOOSE_RAD:
            self.lose("nothing to go by was seen for too long")

    def _choose(self) -> None:
        """Drop places that what is seen speaks against; the last one is right."""
        moved = math.hypot(self._moved[0], self._moved[1]) > VIEW_M
        moved = moved or abs(float(self._moved[2])) > VIEW_RAD
        self._still = 0 if moved else self._still + 1
        if moved or self._still % STILL_SCANS == 0:
            least = min(one.wrong for one in self._places)
            bar = least + (TOLERANCE if moved else STILL_TOLERANCE)
            self._moved = IDENTITY.copy() if moved else self._moved
            self._places = [_judged(one, bar) for one in self._places]
        best = max(self._places, key=lambda one: one.score)
        left = [one for one in self._places if _possible(one) and not self._gone(one, best)]
        self._places = []
        for one in sorted(left, key=lambda one: (not one.continues, -one.score)):
            if apart(one.pose, (other.pose for other in self._places)):
                self._places.append(one)
        if all(one.bad >= LOST_SCANS for one in self._places):
            self.lose("no place in the map looks like this")
        elif (sure := self._sure()) is not None:
            self._places, self._localized, self.why = [sure], True, ""
        else:
            self.why = _in_words(len(self._places))

    def _sure(self) -> Hypothesis | None:
        """Return the only place left, or that of odometry, once it has fitted for some scans.

        Earlier contradictions of the latter do not count: a person may have stood in the view.
        """
        for one in self._places:
            if one.good >= CONFIRMED_SCANS and (one.continues or len(self._places) == 1):
                return one
        return None

    def _gone(self, one: Hypothesis, best: Hypothesis) -> bool:
        """Return whether `one` has left the mapped area without support from the map's symmetry."""
        if one.shown >= SHOWN or one.bad % GONE_SCANS != GONE_SCANS - 1 or not best.good:
            return False
        return not is_self_similar(self.map, compose(one.pose, inverse(best.pose)))


def _possible(one: Hypothesis) -> bool:
    """Return whether a place remains possible: neither beams nor a bad fit rule it out.

    A bad fit alone may come from walls that the map shows badly, as at its edge.
    """
    most = AGAINST_ODOMETRY if one.continues else AGAINST
    return one.against < most and (one.bad < LOST_SCANS or one.wrong < DOUBTED_WRONG)


def _continuing(poses: list[Floats], last: Floats) -> int | None:
    """Return the index of the place nearest to odometry's, if one is near."""
    off = [between(last, pose).tolist() for pose in poses]
    away = [math.hypot(x, y) if abs(yaw) < BUMPED_RAD else math.inf for x, y, yaw in off]
    nearest = min(range(len(away)), key=away.__getitem__, default=None)
    return None if nearest is None or away[nearest] > BUMPED_M else nearest


def _in_words(count: int) -> str:
    places = {0: "no place in the map looks like this", 1: "one place looks like this"}
    return places.get(count, f"it could be in {count} places")


def _predicted(one: Hypothesis, motion: Floats, noise: Floats) -> Hypothesis:
    pose = compose(one.pose, motion)
    turn = np.eye(3)
    turn[0, 2], turn[1, 2] = one.pose[1] - pose[1], pose[0] - one.pose[0]
    spread = turn @ one.covariance @ turn.T + turned(noise, float(one.pose[2]))
    return replace(one, pose=pose, covariance=spread)


def _followed(into: LikelihoodField, one: Hypothesis, view: View | None) -> Hypothesis:
    """Return `one` moved to where the scan fits best, unless it fits nowhere near."""
    if view is None:
        return one
    prior = _inverse(one.covariance)
    found = fit(into, view.beams, one.pose, prior)
    seen = replace(one, score=found.score, shown=found.shown, wrong=found.wrong, good=0)
    if clearance(into, one.pose) < WALL_M:
        seen = replace(seen, against=math.inf)
    if found.score < LOST_SCORE:
        seen = replace(seen, bad=one.bad + 1)
    if found.shown < SHOWN or found.likely < LOST_SCORE:
        return seen
    return replace(
        seen,
        pose=found.pose,
        covariance=_inverse(prior + found.information),
        good=one.good + 1 if found.score >= CONFIRMED_SCORE and found.wrong < MAX_WRONG else 0,
        bad=0 if found.score >= LOST_SCORE else seen.bad,
    )


def _judged(one: Hypothesis, bar: float) -> Hypothesis:
    return replace(one, against=one.against + max(one.wrong - bar, 0.0))


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
        self._moved = IDENTITY  # since the scan that a search uses
        self.last = last  # where it was before it was lost, by odometry: it may still be there
        self._lost = 0  # how often
        self._hint: PoseHint | None = None  # of the next scan
        self._unasked = (
            ASKED_SCANS  # scans since a localized robot has looked where a hint says it is
        )

    def suggest(self, hint: PoseHint) -> None:
        """See RobotMap."""
        self._hint = hint

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """Process one scan, and start a search of the whole map when it is needed."""
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
        """Return whether the scan fits where a hint says, and better than where the robot is."""
        self._unasked += 1
        if self._unasked < ASKED_SCANS or not far_from(hint, pose):
            return False
        self._unasked = 0
        return bool(better(self._localizer.map, view.beams, hint, pose))

    def lose(self, why: str) -> None:
        """Search the whole map for the robot; discard the result of a running search."""
        self._lost += 1
        self._localizer.lose(why)

    def _search(self, view: View) -> None:
        localizer, number, last = self._localizer, self._lost, self.last
        localizer.searching()
        self._moved = IDENTITY

        def work() -> Take:
            found = search(localizer.map, view.beams, last)

            def take() -> None:
                if number == self._lost:
                    localizer.found(found, self._moved, self.last)

            return take

        self._background.start(work, SEARCH_DEADLINE_SCANS)


class KidnapDetector:
    """Looks at each scan before the map takes it."""

    def __init__(self) -> None:
        self._usual = 0.0  # share of beams that the map rules out
        self._field: LikelihoodField | None = None  # None where the map is empty
        self._made_of: tuple[LogOddsGrid, int, float, float] | None = None
        self.scans = 0  # in a row that do not belong here

    @property
    def certain(self) -> bool:
        """Return whether the robot is certainly somewhere else."""
        return self.scans >= KIDNAPPED_SCANS

    def look(self, grid: LogOddsGrid, view: View, pose: Floats) -> bool:
        """Return whether the scan does not belong at `pose`, where odometry has the robot."""
        field = self._field_around(grid, pose)
        if field is None:
            return False
        share = contradiction(field, view.beams, pose)
        if share > self._usual + SUDDEN_INCREASE:
            self.scans += 1
            return True
        self._usual += USUAL_GAIN * (share - self._usual)
        self.scans = 0
        return False

    def _field_around(self, grid: LogOddsGrid, pose: Floats) -> LikelihoodField | None:
        """Return the field around `pose`, which is made again once a scan was drawn in the grid."""
        x, y = (round(v / JUDGED_STEP_M) * JUDGED_STEP_M for v in pose[:2].tolist())
        made_of = grid, grid.scans, x, y
        if made_of != self._made_of:
            cells, corner = grid.around(x, y, JUDGED_RADIUS_M)
            self._field = field_of(cells, CELL, corner, CONTRADICTION_CAP_M) if cells.size else None
            self._made_of = made_of
        return self._field
