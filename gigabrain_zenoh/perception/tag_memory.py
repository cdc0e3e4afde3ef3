"""Memory of tags: their places in the map, and pose hints for a robot that sees a known tag.

Places are learnt only while the robot is well localized. A tag that is seen elsewhere counts as
moved after some seconds: until then, the robot may have been carried away instead.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.objects import MapTag, TagDetection
from gigabrain_zenoh.geometry.se2 import compose, inverse, transform
from gigabrain_zenoh.mapping.pose_hint import PoseHint
from gigabrain_zenoh.perception.camera_view import CameraView
from gigabrain_zenoh.perception.object_memory import Anchor, Glance, carried

MAX_TILT = 0.5  # sine of the face's tilt; a tag on the floor has no yaw
FARTHEST_M = 6.0
CONFIRMED_PICTURES = 3  # minimum of a confirmed tag
MIN_GAIN = 0.05  # of a sighting
SAME_M, SAME_RAD = 0.3, 0.5  # with a larger offset, the tag or the robot has been moved
MOVED_S, MOVED_SEEN = 3.0, 10  # minimum time and sightings elsewhere of a moved tag
MAX_GAP_S = 5.0  # between two of these sightings
MAX_POSE_M, MAX_POSE_RAD = 0.15, 0.1  # standard deviations of a pose from which places are learnt
POSITION_M, POSITION_PER_M = 0.03, 0.04  # standard deviation, and its growth per metre of distance
YAW_RAD = 0.15  # standard deviation of the direction of its face
KNOWN_M = 0.05  # standard deviation of its place in the map
MISSED, MAX_PATIENCE = 1, 8  # a tag is forgotten after so many pictures that should show it
NEAR_M, MIN_FACING = 2.0, 0.5  # it should be seen up to this distance, from this cosine on
MAX_TAGS = 256


@dataclass
class TagTrack:
    """A tag in the map."""

    id: int
    place: Floats  # (4,) x, y, z [m] and yaw [rad]
    size: float  # [m]
    seen: int
    last_s: float
    last_ns: int
    patience: int = MAX_PATIENCE
    anchor: Anchor | None = None
    elsewhere: "TagTrack | None" = None  # if it is seen elsewhere now
    since_s: float = 0.0

    @property
    def confirmed(self) -> bool:
        """Return whether it has been seen often enough."""
        return self.seen >= CONFIRMED_PICTURES

    def message(self) -> MapTag:
        """Return the message that is published and saved."""
        x, y, z = (round(value, 3) for value in self.place[:3].tolist())
        return MapTag(
            id=self.id, x=x, y=y, z=z, yaw=round(float(self.place[3]), 4),
            size=round(self.size, 4), seen=self.seen, last_seen_ns=self.last_ns,
        )  # fmt: skip


class TagMemory:
    """All tags in the map."""

    def __init__(self) -> None:
        self._tracks: dict[int, TagTrack] = {}

    def look(self, glance: Glance) -> None:
        """Update the tracks by the tags in one picture, if the robot is well localized."""
        deviations = np.sqrt(np.diag(glance.spread))
        if max(deviations[0], deviations[1]) > MAX_POSE_M or deviations[2] > MAX_POSE_RAD:
            return
        seen = set()
        for one in glance.detections.tags:
            place = _in_body(one, glance)
            if place is not None and one.id not in seen:
                seen.add(one.id)
                self._update(one, compose_place(glance.pose, place), glance)
        self._forget_missing(seen, glance)

    def hint(self, tags: Sequence[TagDetection]) -> PoseHint | None:
        """Return a hint about the robot's pose, by the nearest known tag that it sees."""
        found: list[tuple[float, PoseHint]] = []
        for one in tags:
            known = self._tracks.get(one.id)
            yaw = face_yaw(one)
            distance = math.hypot(one.position[0], one.position[1])
            if known is None or not known.confirmed or yaw is None or distance > FARTHEST_M:
                continue
            seen = np.array((one.position[0], one.position[1], yaw))
            there = known.place[[0, 1, 3]]
            pose = compose(there, inverse(seen))
            found.append((distance, PoseHint(pose, _covariance(pose, there, distance))))
        return min(found, key=lambda one: one[0])[1] if found else None

    def doubt(self) -> None:
        """Drop sightings elsewhere, as the robot's pose may have been wrong."""
        for one in self._tracks.values():
            one.elsewhere = None

    def tags(self) -> tuple[MapTag, ...]:
        """Return the confirmed tags."""
        return tuple(one.message() for one in self._tracks.values() if one.confirmed)

    def anchored(self) -> list[tuple[MapTag, Anchor | None]]:
        """Return the confirmed tags, each with its anchor."""
        return [(one.message(), one.anchor) for one in self._tracks.values() if one.confirmed]

    def restore(self, found: Sequence[tuple[MapTag, Anchor | None]]) -> None:
        """Replace all tracks by these tags."""
        self._tracks = {
            one.id: TagTrack(
                one.id, np.array((one.x, one.y, one.z, one.yaw)), one.size,
                max(one.seen, CONFIRMED_PICTURES), -math.inf, one.last_seen_ns, anchor=anchor,
            )
            for one, anchor in found[:MAX_TAGS]
        }  # fmt: skip

    def restart(self) -> None:
        """Keep all tags, but no sightings elsewhere, as the robot's time restarts."""
        self.doubt()
        for one in self._tracks.values():
            one.last_s = -math.inf

    def forget(self, ids: Sequence[int]) -> list[int]:
        """Forget tags by their ids. Return the ids that were known."""
        return [one for one in dict.fromkeys(ids) if self._tracks.pop(one, None)]

    def clear(self) -> None:
        """Forget all tags."""
        self._tracks = {}

    def follow(self, poses: Floats) -> None:
        """Move tags with their keyframes (n, 3)."""
        for one in self._tracks.values():
            one.place, one.anchor = carried(one.place, one.anchor, poses)

    def _update(self, one: TagDetection, place: Floats, glance: Glance) -> None:
        known = self._tracks.get(one.id)
        if known is None:
            if len(self._tracks) >= MAX_TAGS and not self._drop_unconfirmed():
                return
            self._tracks[one.id] = _new(one, place, glance)
        elif _same_place(known.place, place):
            _average(known, one, place, glance)
            known.elsewhere = None
        elif not known.confirmed:
            self._tracks[one.id] = _new(one, place, glance)
        else:
            self._update_elsewhere(known, one, place, glance)

    def _update_elsewhere(
        self, known: TagTrack, one: TagDetection, place: Floats, glance: Glance
    ) -> None:
        """Add a sighting elsewhere. After enough of them, the tag is moved there."""
        other = known.elsewhere
        in_time = other and glance.time_s - other.last_s <= MAX_GAP_S
        if other is None or not in_time or not _same_place(other.place, place):
            known.elsewhere = _new(one, place, glance)
            known.elsewhere.since_s = glance.time_s
            return
        _average(other, one, place, glance)
        if other.seen >= MOVED_SEEN and glance.time_s - other.since_s >= MOVED_S:
            self._tracks[one.id] = other

    def _drop_unconfirmed(self) -> bool:
        unconfirmed = next((key for key, one in self._tracks.items() if not one.confirmed), None)
        return unconfirmed is not None and self._tracks.pop(unconfirmed) is not None

    def _forget_missing(self, seen: set[int], glance: Glance) -> None:
        """Forget tags that several pictures should have shown but did not."""
        if not glance.steady or not self._tracks:
            return
        view, here = CameraView(glance.camera), inverse(glance.pose)
        for one in list(self._tracks.values()):
            if one.id in seen or not one.confirmed:
                continue
            x, y = transform(here, one.place[None, :2])[0].tolist()
            away = math.atan2(-y, -x) - float(one.place[3] - glance.pose[2])
            spot = view.spot(np.array((x, y, float(one.place[2]))), one.size, NEAR_M)
            if (
                spot is None
                or math.cos(away) < MIN_FACING
                or view.hidden(glance.hits, (x, y), 0.15)
            ):
                continue
            one.patience -= MISSED
            if one.patience <= 0:
                del self._tracks[one.id]


def face_yaw(tag: TagDetection) -> float | None:
    """Return the direction of a tag's face, about the vertical [rad]; None if it lies flat.

    The normal of its face is the x axis of its orientation.
    """
    x, y, z, w = tag.orientation
    out_x, out_y = 1 - 2 * (y * y + z * z), 2 * (x * y + z * w)
    out_z = 2 * (x * z - y * w)
    length = math.sqrt(out_x**2 + out_y**2 + out_z**2)
    if length < 1e-6 or abs(out_z) > MAX_TILT * length:
        return None
    return math.atan2(out_y, out_x)


def compose_place(pose: Floats, place: Floats) -> Floats:
    """Transform a place (4,) x, y, z and yaw from the frame `pose` to its parent frame."""
    x, y, yaw = compose(pose, place[[0, 1, 3]]).tolist()
    return np.array((x, y, float(place[2]), yaw))


def _in_body(tag: TagDetection, glance: Glance) -> Floats | None:
    """Return a tag's place (4,) in the body's frame; None if it is not plausible."""
    yaw = face_yaw(tag)
    x, y, z = tag.position
    far = math.hypot(x - glance.camera.x, y - glance.camera.y) > FARTHEST_M
    if yaw is None or far or not -1.0 <= z <= 5.0:
        return None
    return np.array((x, y, z, yaw))


def _new(one: TagDetection, place: Floats, glance: Glance) -> TagTrack:
    size = min(one.size, 5.0)
    return TagTrack(one.id, place, size, 1, glance.time_s, glance.unix_ns)


def _average(known: TagTrack, one: TagDetection, place: Floats, glance: Glance) -> None:
    gain = max(1.0 / (known.seen + 1), MIN_GAIN)
    off = place - known.place
    off[3] = math.remainder(off[3], math.tau)
    known.place = known.place + gain * off
    known.size += gain * (min(one.size, 5.0) - known.size)
    known.seen, known.last_s, known.last_ns = known.seen + 1, glance.time_s, glance.unix_ns
    known.patience, known.anchor = MAX_PATIENCE, None


def _same_place(one: Floats, other: Floats) -> bool:
    turned = abs(math.remainder(float(one[3] - other[3]), math.tau))
    return math.hypot(*(one - other)[:2].tolist()) <= SAME_M and turned <= SAME_RAD


def _covariance(pose: Floats, tag: Floats, distance: float) -> Floats:
    """Return the covariance (3, 3) of a robot's pose by a tag, in the map's axes.

    An error of the tag's yaw moves the pose on a circle around the tag.
    """
    own = KNOWN_M**2 + (POSITION_M + POSITION_PER_M * distance) ** 2
    x, y = (pose - tag)[:2].tolist()
    lever = np.array((-y, x, 1.0))
    return np.diag((own, own, 1e-3)) + YAW_RAD**2 * np.outer(lever, lever)
