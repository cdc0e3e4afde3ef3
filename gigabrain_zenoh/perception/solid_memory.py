"""Memory of solids near an arm: fits in pictures, tracked in the odometry frame."""

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S, Pose
from gigabrain_schemas.objects import SeenSolid
from gigabrain_zenoh.geometry.pose import to_frame, to_parent
from gigabrain_zenoh.perception.class_votes import ClassVotes
from gigabrain_zenoh.vision.solid_fit import SolidFit

MAX_FITS = 9  # newest fits of a thing, as near ones are best; their median counts
CONFIRMED_PICTURES = 2  # minimum of a confirmed thing
MIN_GATE_M = 0.03  # maximum offset of the same thing if it is narrow,
GATE_SHARE = 0.5  # and as a share of its width
MOVED_M = 0.02  # a fit farther from the median shows that a thing was moved; older fits are dropped
CHECKED_HEIGHT = 1.6  # times that of its middle; there it should hide what is behind it
MAX_MISSES = 3  # pictures that show what is behind it, until it is forgotten
KEPT_S = 120.0  # without being seen, as the odometry drifts
MAX_SOLIDS = 64
MAX_NAMED = 150  # recognised things that are not tracked yet; half a minute of one
LABEL_M = 0.06  # maximum offset of a recognised thing from the middle of its track
Place = tuple[float, float]  # x, y [m]
QUARTER = math.pi / 2  # a box looks the same after a quarter turn


@dataclass
class Track:
    """One thing. Its fits are in the odometry frame."""

    id: int
    tick: int  # when it was seen last
    seen: int = 0  # pictures
    misses: int = 0
    fits: deque[SolidFit] = field(default_factory=lambda: deque(maxlen=MAX_FITS))
    votes: ClassVotes = field(default_factory=ClassVotes)

    @property
    def fit(self) -> SolidFit:
        """The median of the newest fits that have the most common shape."""
        shape = Counter(fit.shape for fit in self.fits).most_common(1)[0][0]
        same = [fit for fit in self.fits if fit.shape == shape]
        size = np.median([fit.size for fit in same], axis=0)
        position = np.median([fit.position for fit in same], axis=0)
        turns = [_wrapped_yaw(fit.yaw - same[-1].yaw) for fit in same]
        yaw = same[-1].yaw + float(np.median(turns))
        x, y, z = position.tolist()
        return SolidFit(shape, tuple(size.tolist()), (x, y, z), yaw, same[-1].error)


class SolidMemory:
    """Tracks things near the arm of one body.

    Ids begin at the tick of the first picture, so that they are not reused after a restart of
    perception.
    """

    def __init__(self) -> None:
        self._tracks: list[Track] = []
        self._number = 0  # of the newest track
        self._named: deque[tuple[Place, str, float, float]] = deque(maxlen=MAX_NAMED)
        "Recognised things that are not tracked yet: place, class, confidence, distance."

    def look(
        self, fits: Sequence[SolidFit], pose: Pose, tick: int, gone: Callable[[Floats], bool]
    ) -> None:
        """Update the tracks by the fits in a picture, taken by a body at `pose` at `tick`.

        `gone` returns whether the picture shows what is behind a place (3,) in the body's frame.
        """
        self._number = self._number or tick
        placed = [_moved(fit, lambda x, y: to_parent(pose, x, y), pose.yaw) for fit in fits]
        unmatched = list(self._tracks)
        for fit in sorted(placed, key=lambda one: _nearest(one.position[:2], self._tracks)[0]):
            off, track = _nearest(fit.position[:2], unmatched)
            if track is None or off > _match_gate(fit):
                self._number += 1
                track = Track(id=self._number, tick=tick)
                self._tracks.append(track)
                self._add_earlier_names(track, fit)
            else:
                unmatched.remove(track)
            _add_fit(track, fit, tick)
        for track in unmatched:
            x, y = to_frame(pose, *track.fit.position[:2])
            missed = gone(np.array((x, y, CHECKED_HEIGHT * track.fit.position[2])))
            track.misses = track.misses + 1 if missed else 0
        oldest = tick - KEPT_S / TICK_S
        kept = [one for one in self._tracks if one.misses < MAX_MISSES and one.tick >= oldest]
        self._tracks = sorted(kept, key=lambda one: -one.tick)[:MAX_SOLIDS]

    def name(
        self, label: str, confidence: float, place: Place, distance: float, pose: Pose
    ) -> None:
        """Add the class of a thing at `place` [m], in the frame of a body at `pose`.

        The camera was at `distance` [m] from it.
        """
        in_odometry = to_parent(pose, *place)
        off, track = _nearest(in_odometry, self._tracks)
        if track and off <= _label_gate(track.fit):
            track.votes.add(label, confidence, distance)
        else:
            self._named.append((in_odometry, label, confidence, distance))

    def _add_earlier_names(self, track: Track, fit: SolidFit) -> None:
        """Add to a new track the classes that were recognised earlier at its place."""
        for place, label, confidence, distance in self._named:
            if math.dist(place, fit.position[:2]) <= _label_gate(fit):
                track.votes.add(label, confidence, distance)

    def solids(self, pose: Pose, tick: int) -> tuple[SeenSolid, ...]:
        """Return the confirmed things in the frame of a body at `pose`, the nearest first."""
        found = []
        for track in self._tracks:
            if track.seen >= CONFIRMED_PICTURES:
                fit = _moved(track.fit, lambda x, y: to_frame(pose, x, y), -pose.yaw)
                found.append(SeenSolid(
                    id=track.id, shape=fit.shape, size=fit.size, position=fit.position,
                    yaw=_wrapped_yaw(fit.yaw), label=track.votes.label, seen=track.seen,
                    age=max(0, tick - track.tick) * TICK_S,
                ))  # fmt: skip
        return tuple(sorted(found, key=lambda one: math.hypot(*one.position[:2])))


def _nearest(place: Place, tracks: Sequence[Track]) -> tuple[float, Track | None]:
    """Return the distance from a place to the nearest track [m], and that track."""
    away = [(math.dist(track.fit.position[:2], place), track.id, track) for track in tracks]
    off, _, track = min(away, default=(math.inf, 0, None))
    return off, track


def _add_fit(track: Track, fit: SolidFit, tick: int) -> None:
    """Add a fit to a track. If the thing was moved, the earlier fits are dropped."""
    if track.fits and math.dist(track.fit.position[:2], fit.position[:2]) > MOVED_M:
        track.fits.clear()
    track.fits.append(fit)
    track.tick, track.seen, track.misses = tick, track.seen + 1, 0


def _moved(
    fit: SolidFit, place: Callable[[float, float], tuple[float, float]], turn: float
) -> SolidFit:
    x, y = place(*fit.position[:2])
    return fit._replace(position=(x, y, fit.position[2]), yaw=fit.yaw + turn)


def _width(fit: SolidFit) -> float:
    return max(fit.size[:2]) if fit.shape == "box" else 2 * fit.size[0]


def _label_gate(fit: SolidFit) -> float:
    return max(LABEL_M, _width(fit))


def _match_gate(fit: SolidFit) -> float:
    return max(MIN_GATE_M, GATE_SHARE * _width(fit))


def _wrapped_yaw(angle: float) -> float:
    """Return the yaw of a box, wrapped to -45 to 45 degrees [rad]."""
    return math.remainder(angle, QUARTER)
