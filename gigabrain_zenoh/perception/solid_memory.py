"""Memory of what stands near an arm: fits of several pictures, tracked in the odometry's frame."""

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

FITS = 9  # newest ones, whose median counts: from near by a thing is seen best
CONFIRMED_PICTURES = 2  # pictures, from which on a thing counts
SAME_M, SAME_SHARE = 0.03, 0.5  # how far off the same thing may be: at least, and of its width
MOVED_M = 0.02  # from its median: it was moved, and what was known of its place is dropped
LOOKED_AT = 1.6  # of the height of its middle: there it would hide the floor, or what is behind
MISSES = 3  # pictures in which it is seen through
KEPT_S = 120.0  # without being seen: odometry drifts
MAX_SOLIDS = 64
NAMED = 150  # things recognised that are not tracked yet: half a minute of one
LABEL_M = 0.06  # beside the middle of a thing, within which something recognised is this thing
Place = tuple[float, float]  # x, y [m]
QUARTER = math.pi / 2  # a box looks the same by each of its sides


@dataclass
class Track:
    """One thing. Places are in the odometry's frame."""

    id: int
    tick: int  # when it was seen last
    seen: int = 0  # pictures
    misses: int = 0
    fits: deque[SolidFit] = field(default_factory=lambda: deque(maxlen=FITS))
    votes: ClassVotes = field(default_factory=ClassVotes)

    @property
    def fit(self) -> SolidFit:
        """The median of the newest fits of the shape that most of them have."""
        shape = Counter(fit.shape for fit in self.fits).most_common(1)[0][0]
        same = [fit for fit in self.fits if fit.shape == shape]
        size = np.median([fit.size for fit in same], axis=0)
        position = np.median([fit.position for fit in same], axis=0)
        yaw = same[-1].yaw + float(np.median([_turn(fit.yaw - same[-1].yaw) for fit in same]))
        x, y, z = position.tolist()
        return SolidFit(shape, tuple(size.tolist()), (x, y, z), yaw, same[-1].error)


class SolidMemory:
    """Tracks things near the arm of one body.

    Its numbers begin at the tick of its first picture, so that after a restart of perception no
    other thing gets the number of an earlier one.
    """

    def __init__(self) -> None:
        self._tracks: list[Track] = []
        self._number = 0  # of the newest track
        self._named: deque[tuple[Place, str, float, float]] = deque(maxlen=NAMED)
        "What was recognised where nothing was tracked yet: place, class, confidence, distance."

    def look(
        self, fits: Sequence[SolidFit], pose: Pose, tick: int, gone: Callable[[Floats], bool]
    ) -> None:
        """Take what a picture shows, as seen from a body at `pose` at `tick`.

        `gone` tells whether the picture shows what is behind a place (3,) in the body's frame.
        """
        self._number = self._number or tick
        placed = [_moved(fit, lambda x, y: to_parent(pose, x, y), pose.yaw) for fit in fits]
        open_ = list(self._tracks)
        for fit in sorted(placed, key=lambda one: _nearest(one.position[:2], self._tracks)[0]):
            off, track = _nearest(fit.position[:2], open_)
            if track is None or off > _gate(fit):
                self._number += 1
                track = Track(id=self._number, tick=tick)
                self._tracks.append(track)
                self._recall(track, fit)
            else:
                open_.remove(track)
            _take(track, fit, tick)
        for track in open_:
            x, y = to_frame(pose, *track.fit.position[:2])
            missed = gone(np.array((x, y, LOOKED_AT * track.fit.position[2])))
            track.misses = track.misses + 1 if missed else 0
        oldest = tick - KEPT_S / TICK_S
        kept = [one for one in self._tracks if one.misses < MISSES and one.tick >= oldest]
        self._tracks = sorted(kept, key=lambda one: -one.tick)[:MAX_SOLIDS]

    def name(
        self, label: str, confidence: float, place: Place, distance: float, pose: Pose
    ) -> None:
        """Record that something was recognised at a place [m] in the frame of a body at `pose`.

        The camera was at a `distance` of it [m].
        """
        there = to_parent(pose, *place)
        off, track = _nearest(there, self._tracks)
        if track and off <= _label_gate(track.fit):
            track.votes.add(label, confidence, distance)
        else:
            self._named.append((there, label, confidence, distance))

    def _recall(self, track: Track, fit: SolidFit) -> None:
        """Have a new track know as what it was recognised before, from farther off."""
        for place, label, confidence, distance in self._named:
            if math.dist(place, fit.position[:2]) <= _label_gate(fit):
                track.votes.add(label, confidence, distance)

    def solids(self, pose: Pose, tick: int) -> tuple[SeenSolid, ...]:
        """Return what counts, in the frame of a body at `pose` at `tick`, the nearest first."""
        found = []
        for track in self._tracks:
            if track.seen >= CONFIRMED_PICTURES:
                fit = _moved(track.fit, lambda x, y: to_frame(pose, x, y), -pose.yaw)
                found.append(SeenSolid(
                    id=track.id, shape=fit.shape, size=fit.size, position=fit.position,
                    yaw=_turn(fit.yaw), label=track.votes.label, seen=track.seen,
                    age=max(0, tick - track.tick) * TICK_S,
                ))  # fmt: skip
        return tuple(sorted(found, key=lambda one: math.hypot(*one.position[:2])))


def _nearest(place: Place, tracks: Sequence[Track]) -> tuple[float, Track | None]:
    """Return how far the nearest track is from a place [m], and the track."""
    away = [(math.dist(track.fit.position[:2], place), track.id, track) for track in tracks]
    off, _, track = min(away, default=(math.inf, 0, None))
    return off, track


def _take(track: Track, fit: SolidFit, tick: int) -> None:
    """Add a fit to a track; those before it are dropped where the thing was moved."""
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


def _gate(fit: SolidFit) -> float:
    return max(SAME_M, SAME_SHARE * _width(fit))


def _turn(angle: float) -> float:
    """Return a box's yaw from -45 to 45 degrees [rad]."""
    return math.remainder(angle, QUARTER)
