"""Memory of objects: tracks things that are recognised in pictures, and places them in the map.

The noise of a sighting grows with its distance and with the uncertainty of the robot's pose.
Existence is in log-odds: sightings raise them, and pictures that should show a thing and do not
lower them. A thing that is behind the robot, far away or hidden is kept. A thing that moves by
itself is forgotten after some seconds.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import Camera
from gigabrain_schemas.objects import Box, Detections, MapObject
from gigabrain_zenoh.geometry.se2 import compose, inverse, transform
from gigabrain_zenoh.perception.camera_view import CameraView
from gigabrain_zenoh.perception.class_votes import NEAREST_M, ClassVotes

MOVERS = frozenset(("person", "robot", "dog", "cat", "bird"))  # classes that move by themselves
MOVERS_KEPT_S = 3.0  # without being seen
FARTHEST_M, HIGHEST_M = 8.0, 3.0  # farther or higher sightings are rejected
NOISE_M, NOISE_PER_M = 0.03, 0.01  # standard deviation of a position, and its growth per metre off
MIN_GAIN = 0.06  # of a sighting, so that a thing that was moved a little is followed
GATE_M, GATE_SIGMAS, MOVER_GATE_M = 0.25, 3.0, 1.0  # maximum offset of a sighting of the same thing
GATE_HEIGHT_M = 0.4
OTHER_GATE_M = 0.15  # the same for a sighting of another class, as classes are confused
SEEN_ODDS, CONFIDENCE_ODDS, MISSED_ODDS, MAX_ODDS = 0.4, 0.8, 0.6, 4.0
BEGIN_ODDS = -0.8
CONFIRMED_PICTURES, CONFIRMED_ODDS = 3, 1.0  # minimum of a confirmed thing
GLIMPSE_S = 2.0  # without being seen, until an unconfirmed thing is forgotten
NEAR_M = 2.0  # up to here, nine of ten pictures show a thing that they should show
BEFORE_M = 0.15  # something nearer by more than this may hide a thing
MERGE_M = 0.08  # things of one class that are nearer to each other are merged
MAX_TRACKS = 256
MAX_LABEL_BYTES = 96  # so that all things fit into a message


@dataclass(frozen=True, kw_only=True)
class Glance:
    """Detections in one picture, with the data to place them in the map."""

    detections: Detections
    camera: Camera
    pose: Floats  # (3,) of the body in the map at the exposure
    spread: Floats  # (3, 3), covariance of the pose, in the map's axes
    hits: Floats  # (n, 2) [m], in the body's frame, of a scan at about that time
    time_s: float  # time of the robot
    unix_ns: int
    steady: bool = True  # the body turned slowly enough for a sharp picture


class Sighting(NamedTuple):
    """A thing in a picture, placed in the map."""

    label: str
    confidence: float
    position: Floats  # (3,) [m]
    variance: float  # [m2], of x and y each
    size: tuple[float, float] | None
    box: Box
    distance: float  # [m], from the camera


@dataclass
class Anchor:
    """The keyframe that a thing moves with."""

    keyframe: int
    pose: Floats  # (3,), of the keyframe when the thing was placed


@dataclass
class ObjectTrack:
    """A thing that is tracked from picture to picture."""

    id: int
    position: Floats  # (3,) [m] in the map
    variance: float  # [m2]
    size: tuple[float, float]  # [m]
    odds: float  # log-odds of its existence
    seen: int
    last_s: float  # time of the robot
    last_ns: int
    votes: ClassVotes = field(default_factory=ClassVotes)
    anchor: Anchor | None = None

    @property
    def label(self) -> str:
        """The most likely class."""
        return self.votes.label

    @property
    def moves(self) -> bool:
        """Return whether things of its class move by themselves."""
        return self.label in MOVERS

    @property
    def confirmed(self) -> bool:
        """Return whether it has been seen often and reliably enough."""
        return self.seen >= CONFIRMED_PICTURES and self.odds >= CONFIRMED_ODDS

    def message(self) -> MapObject:
        """Return the message that is published and saved."""
        x, y, z = (round(value, 3) for value in self.position.tolist())
        width, height = self.size
        return MapObject(
            id=self.id, label=self.label, x=x, y=y, z=z,
            size=(round(width, 3), round(height, 3)),
            confidence=round(1 / (1 + math.exp(-self.odds)), 3),
            seen=self.seen, last_seen_ns=self.last_ns,
        )  # fmt: skip


class ObjectMemory:
    """All tracked things."""

    def __init__(self) -> None:
        self._tracks: list[ObjectTrack] = []
        self._next_id = 1

    def look(self, glance: Glance) -> None:
        """Update the tracks by one picture."""
        self._expire(glance.time_s)
        sightings = _placed(glance)
        pairs = _matched(sightings, self._tracks)
        for sighting, track in pairs:
            _update(track, sighting, glance)
        matched = {id(track) for _, track in pairs}
        unseen = [one for one in self._tracks if id(one) not in matched]
        self._lower_odds(unseen, sightings, glance)
        taken = {id(sighting) for sighting, _ in pairs}
        for sighting in sightings:
            if id(sighting) not in taken:
                self._start(sighting, glance)
        self._merge()

    def objects(self) -> tuple[MapObject, ...]:
        """Return the confirmed things, the oldest first."""
        return tuple(one.message() for one in self._tracks if one.confirmed)

    def anchored(self) -> list[tuple[MapObject, Anchor | None]]:
        """Return the confirmed things that do not move by themselves, each with its anchor."""
        return [
            (one.message(), one.anchor) for one in self._tracks if one.confirmed and not one.moves
        ]

    def restore(self, found: Sequence[tuple[MapObject, Anchor | None]]) -> None:
        """Replace all tracks by these things."""
        self._tracks = [_restored(one, anchor) for one, anchor in found[:MAX_TRACKS]]
        self._next_id = max((one.id for one in self._tracks), default=0) % 2**62 + 1

    def restart(self) -> None:
        """Forget moving and unconfirmed things, as the robot's time restarts."""
        self._tracks = [one for one in self._tracks if one.confirmed and not one.moves]
        for one in self._tracks:
            one.last_s = -math.inf

    def forget(self, ids: Sequence[int]) -> list[int]:
        """Forget things by their ids. Return the ids that were known."""
        wanted = set(ids)
        known = [one.id for one in self._tracks if one.id in wanted]
        self._tracks = [one for one in self._tracks if one.id not in wanted]
        return known

    def clear(self) -> None:
        """Forget everything."""
        self._tracks = []

    def follow(self, poses: Floats) -> None:
        """Move things with their keyframes (n, 3)."""
        for one in self._tracks:
            one.position, one.anchor = carried(one.position, one.anchor, poses)

    def _expire(self, now_s: float) -> None:
        self._tracks = [
            one
            for one in self._tracks
            if now_s - one.last_s <= (MOVERS_KEPT_S if one.confirmed else GLIMPSE_S)
            or (one.confirmed and not one.moves)
        ]

    def _start(self, sighting: Sighting, glance: Glance) -> None:
        if len(self._tracks) >= MAX_TRACKS:
            weakest = min(range(len(self._tracks)), key=lambda k: self._tracks[k].odds)
            if self._tracks[weakest].confirmed:
                return
            del self._tracks[weakest]
        self._tracks.append(
            ObjectTrack(
                id=self._next_id,
                position=sighting.position,
                variance=sighting.variance,
                size=sighting.size or (0.1, 0.1),
                odds=BEGIN_ODDS + CONFIDENCE_ODDS * sighting.confidence,
                seen=1,
                last_s=glance.time_s,
                last_ns=glance.unix_ns,
            )
        )
        self._tracks[-1].votes.add(sighting.label, sighting.confidence, sighting.distance)
        self._next_id += 1

    def _lower_odds(
        self, unseen: list[ObjectTrack], sightings: list[Sighting], glance: Glance
    ) -> None:
        """Lower the odds of things that this picture should show and does not."""
        expected = [one for one in unseen if one.confirmed and not one.moves]
        if not expected or not glance.steady:
            return
        view = CameraView(glance.camera)
        here = inverse(glance.pose)
        gone = set()
        for one in expected:
            x, y = transform(here, one.position[None, :2])[0].tolist()
            spot = view.spot(np.array((x, y, float(one.position[2]))), max(one.size), NEAR_M)
            if spot is None or view.hidden(glance.hits, (x, y), max(one.size) / 2 + BEFORE_M):
                continue
            if any(_hides(other, spot.pixel, spot.depth) for other in sightings):
                continue
            one.odds -= MISSED_ODDS
            if one.odds < 0.0:
                gone.add(id(one))
        self._tracks = [one for one in self._tracks if id(one) not in gone]

    def _merge(self) -> None:
        """Merge things of one class at the same place; the older one is kept."""
        if len(self._tracks) < 2:
            return
        places = np.array([one.position for one in self._tracks])
        near = np.hypot(*(places[:, None, :2] - places[None, :, :2]).transpose(2, 0, 1))
        first, second = np.nonzero(np.triu(near < MERGE_M, k=1))
        gone = set()
        for i, j in zip(first.tolist(), second.tolist(), strict=True):
            one, other = self._tracks[i], self._tracks[j]
            if one.label == other.label and abs(one.position[2] - other.position[2]) < MERGE_M:
                gone.add(id(other))
        self._tracks = [one for one in self._tracks if id(one) not in gone]


def _placed(glance: Glance) -> list[Sighting]:
    """Return the detections that have a plausible position, placed in the map."""
    found = []
    pose_variance = float(glance.spread[0, 0] + glance.spread[1, 1]) / 2
    for one in glance.detections.things:
        valid_label = one.label.isprintable() and len(one.label.encode()) <= MAX_LABEL_BYTES
        if one.position is None or not valid_label:
            continue
        x, y, z = one.position
        distance = math.hypot(x - glance.camera.x, y - glance.camera.y)
        if distance > FARTHEST_M or not -1.0 <= z <= HIGHEST_M:
            continue
        own = (NOISE_M + NOISE_PER_M * distance) ** 2
        variance = own + pose_variance + float(glance.spread[2, 2]) * distance**2
        at_x, at_y = transform(glance.pose, np.array(((x, y),)))[0].tolist()
        place = np.array((at_x, at_y, z))
        size = None if one.size is None else (min(one.size[0], 5.0), min(one.size[1], 5.0))
        found.append(Sighting(one.label, one.confidence, place, variance, size, one.box, distance))
    return found


def _matched(
    sightings: list[Sighting], tracks: list[ObjectTrack]
) -> list[tuple[Sighting, ObjectTrack]]:
    """Return pairs of a sighting and its track, the nearest first; none is in two pairs."""
    if not sightings or not tracks:
        return []
    seen = np.array([one.position for one in sightings])
    known = np.array([one.position for one in tracks])
    off = np.hypot(*(seen[:, None, :2] - known[None, :, :2]).transpose(2, 0, 1))
    variance = np.add.outer([one.variance for one in sightings], [one.variance for one in tracks])
    gates = np.maximum(GATE_M, GATE_SIGMAS * np.sqrt(variance)).clip(max=MOVER_GATE_M)
    gates[:, [one.moves for one in tracks]] = MOVER_GATE_M
    labels = np.array([one.label for one in tracks])
    same = np.array([one.label for one in sightings])[:, None] == labels[None, :]
    gates = np.where(same, gates, OTHER_GATE_M)
    level = np.abs(seen[:, None, 2] - known[None, :, 2]) < GATE_HEIGHT_M
    cost = np.where(same, off, off + GATE_M)
    rows, columns = np.nonzero((off < gates) & level)
    pairs, taken_rows, taken_columns = [], set(), set()
    for k in np.argsort(cost[rows, columns], kind="stable").tolist():
        row, column = int(rows[k]), int(columns[k])
        if row not in taken_rows and column not in taken_columns:
            taken_rows.add(row)
            taken_columns.add(column)
            pairs.append((sightings[row], tracks[column]))
    return pairs


def _update(track: ObjectTrack, sighting: Sighting, glance: Glance) -> None:
    gain = max(track.variance / (track.variance + sighting.variance), MIN_GAIN)
    gain = 0.6 if track.moves else gain
    track.position = track.position + gain * (sighting.position - track.position)
    track.variance = gain * sighting.variance
    if sighting.size:
        old, new = track.size, sighting.size
        track.size = old[0] + gain * (new[0] - old[0]), old[1] + gain * (new[1] - old[1])
    track.odds = min(track.odds + SEEN_ODDS + CONFIDENCE_ODDS * sighting.confidence, MAX_ODDS)
    track.seen, track.last_s, track.last_ns = track.seen + 1, glance.time_s, glance.unix_ns
    track.anchor = None  # the keyframe nearest to its new place becomes its anchor
    track.votes.add(sighting.label, sighting.confidence, sighting.distance)


def _hides(other: Sighting, pixel: tuple[float, float], depth: float) -> bool:
    """Return whether another thing in the picture hides a pixel at this depth [m]."""
    left, top, right, bottom = other.box
    inside = left <= pixel[0] <= right and top <= pixel[1] <= bottom
    return inside and other.distance < depth - BEFORE_M / 2


def _restored(one: MapObject, anchor: Anchor | None) -> ObjectTrack:
    confidence = min(max(one.confidence, 0.73), 0.982)
    votes = ClassVotes()
    votes.add(one.label, 1.0, NEAREST_M)
    return ObjectTrack(
        id=one.id,
        position=np.array((one.x, one.y, one.z)),
        variance=NOISE_M**2,
        size=one.size,
        odds=math.log(confidence / (1 - confidence)) + 0.01,
        seen=max(one.seen, CONFIRMED_PICTURES),
        last_s=-math.inf,
        last_ns=one.last_seen_ns,
        votes=votes,
        anchor=anchor,
    )


def carried(position: Floats, anchor: Anchor | None, poses: Floats) -> tuple[Floats, Anchor | None]:
    """Return a position moved with its keyframe, and its anchor.

    The position is (3,) x, y, z or (4,) with yaw. Without an anchor, it stays and is anchored to
    the nearest keyframe.
    """
    if not len(poses):
        return position, anchor
    if anchor is None or anchor.keyframe >= len(poses):
        nearest = int(np.hypot(*(poses[:, :2] - position[:2]).T).argmin())
        return position, Anchor(nearest, poses[nearest].copy())
    now = poses[anchor.keyframe]
    if np.array_equal(now, anchor.pose):
        return position, anchor
    moved = compose(now, inverse(anchor.pose))
    there = position.copy()
    there[:2] = transform(moved, position[None, :2])[0]
    if len(position) > 3:
        there[3] = math.remainder(float(position[3] + moved[2]), math.tau)
    return there, Anchor(anchor.keyframe, now.copy())
