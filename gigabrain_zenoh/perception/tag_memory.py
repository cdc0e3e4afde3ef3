"""Memory of tags: where they hang in the map, and where the robot is that sees a known one.

Only a well localized robot teaches a place. A tag that is seen elsewhere is taken for moved after
some seconds: until then it may be the robot that was carried off.
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

MAX_TILT = 0.5  # of the face's axis, upwards or downwards: a tag on the floor has no yaw
FARTHEST_M = 6.0
CONFIRMED_PICTURES = 3  # pictures, from which on a tag counts
MIN_GAIN = 0.05  # of a sighting
SAME_M, SAME_RAD = 0.3, 0.5  # a tag that is seen farther off has been moved, or the robot has
MOVED_S, MOVED_SEEN = 3.0, 10  # for so long and so often
GAP_S = 5.0  # between two sightings of a moved tag
WELL_M, WELL_RAD = 0.15, 0.1  # deviations of a robot that is well localized
POSITION_M, POSITION_PER_M = 0.03, 0.04  # deviation of a tag's position, and that per metre off
YAW_RAD = 0.15  # deviation of where its face looks: it is the least certain
KNOWN_M = 0.05  # deviation of its place in the map
MISSED, MAX_PATIENCE = 1, 8  # pictures that should show a tag, until it is forgotten
NEAR_M, FACING = 2.0, 0.5  # within which, and cosine from which on, it should be seen
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
    elsewhere: "TagTrack | None" = None  # where it is seen now, if not here
    since_s: float = 0.0

    @property
    def sure(self) -> bool:
        """Return whether it has been seen often enough to count."""
        return self.seen >= CONFIRMED_PICTURES

    def message(self) -> MapTag:
        """Return it as it is published and saved."""
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
        """Take the tags of one picture, if the robot is well localized."""
        deviations = np.sqrt(np.diag(glance.spread))
        if max(deviations[0], deviations[1]) > WELL_M or deviations[2] > WELL_RAD:
            return
        seen = set()
        for one in glance.detections.tags:
            place = _in_body(one, glance)
            if place is not None and one.id not in seen:
                seen.add(one.id)
                self._take(one, compose_place(glance.pose, place), glance)
        self._miss(seen, glance)

    def hint(self, tags: Sequence[TagDetection]) -> PoseHint | None:
        """Return where the robot is that sees these tags, by the nearest that is known."""
        found: list[tuple[float, PoseHint]] = []
        for one in tags:
            known = self._tracks.get(one.id)
            yaw = face_yaw(one)
            distance = math.hypot(one.position[0], one.position[1])
            if known is None or not known.sure or yaw is None or distance > FARTHEST_M:
                continue
            seen = np.array((one.position[0], one.position[1], yaw))
            there = known.place[[0, 1, 3]]
            pose = compose(there, inverse(seen))
            found.append((distance, PoseHint(pose, _spread(pose, there, distance))))
        return min(found, key=lambda one: one[0])[1] if found else None

    def doubt(self) -> None:
        """The robot is not where it was thought to be: no tag was seen elsewhere."""
        for one in self._tracks.values():
            one.elsewhere = None

    def tags(self) -> tuple[MapTag, ...]:
        """Return the tags that count."""
        return tuple(one.message() for one in self._tracks.values() if one.sure)

    def anchored(self) -> list[tuple[MapTag, Anchor | None]]:
        """Return the tags that count, each with its anchor."""
        return [(one.message(), one.anchor) for one in self._tracks.values() if one.sure]

    def restore(self, found: Sequence[tuple[MapTag, Anchor | None]]) -> None:
        """Know these tags instead of all others."""
        self._tracks = {
            one.id: TagTrack(
                one.id, np.array((one.x, one.y, one.z, one.yaw)), one.size,
                max(one.seen, CONFIRMED_PICTURES), -math.inf, one.last_seen_ns, anchor=anchor,
            )
            for one, anchor in found[:MAX_TAGS]
        }  # fmt: skip

    def restart(self) -> None:
        """Go on when the robot's time begins again."""
        self.doubt()
        for one in self._tracks.values():
            one.last_s = -math.inf

    def forget(self, ids: Sequence[int]) -> list[int]:
        """Forget tags by their ids; return those that were there."""
        return [one for one in dict.fromkeys(ids) if self._tracks.pop(one, None)]

    def clear(self) -> None:
        """Forget all tags."""
        self._tracks = {}

    def follow(self, poses: Floats) -> None:
        """Move tags with the keyframes (n, 3) that they are fixed to."""
        for one in self._tracks.values():
            one.place, one.anchor = carried(one.place, one.anchor, poses)

    def _take(self, one: TagDetection, place: Floats, glance: Glance) -> None:
        known = self._tracks.get(one.id)
        if known is None:
            if len(self._tracks) >= MAX_TAGS and not self._drop_unsure():
                return
            self._tracks[one.id] = _new(one, place, glance)
        elif _same(known.place, place):
            _average(known, one, place, glance)
            known.elsewhere = None
        elif not known.sure:
            self._tracks[one.id] = _new(one, place, glance)
        else:
            self._take_elsewhere(known, one, place, glance)

    def _take_elsewhere(
        self, known: TagTrack, one: TagDetection, place: Floats, glance: Glance
    ) -> None:
        """Learn where a tag hangs now, once it was seen there for long enough."""
        there = known.elsewhere
        goes_on = there and glance.time_s - there.last_s <= GAP_S and _same(there.place, place)
        if there is None or not goes_on:
            known.elsewhere = _new(one, place, glance)
            known.elsewhere.since_s = glance.time_s
            return
        _average(there, one, place, glance)
        if there.seen >= MOVED_SEEN and glance.time_s - there.since_s >= MOVED_S:
            self._tracks[one.id] = there

    def _drop_unsure(self) -> bool:
        unsure = next((key for key, one in self._tracks.items() if not one.sure), None)
        return unsure is not None and self._tracks.pop(unsure) is not None

    def _miss(self, seen: set[int], glance: Glance) -> None:
        """Forget tags that should be in some pictures and are not."""
        if not glance.steady or not self._tracks:
            return
        view, here = CameraView(glance.camera), inverse(glance.pose)
        for one in list(self._tracks.values()):
            if one.id in seen or not one.sure:
                continue
            x, y = transform(here, one.place[None, :2])[0].tolist()
            away = math.atan2(-y, -x) - float(one.place[3] - glance.pose[2])
            spot = view.spot(np.array((x, y, float(one.place[2]))), one.size, NEAR_M)
            if spot is None or math.cos(away) < FACING or view.hidden(glance.hits, (x, y), 0.15):
                continue
            one.patience -= MISSED
            if one.patience <= 0:
                del self._tracks[one.id]


def face_yaw(tag: TagDetection) -> float | None:
    """Return where a tag's face looks, about the vertical [rad]; None if it lies flat.

    The axis that comes out of its face is x, in the frame of its orientation.
    """
    x, y, z, w = tag.orientation
    out_x, out_y = 1 - 2 * (y * y + z * z), 2 * (x * y + z * w)
    out_z = 2 * (x * z - y * w)
    length = math.sqrt(out_x**2 + out_y**2 + out_z**2)
    if length < 1e-6 or abs(out_z) > MAX_TILT * length:
        return None
    return math.atan2(out_y, out_x)


def compose_place(pose: Floats, place: Floats) -> Floats:
    """Return a place (4,) x, y, z and yaw from the frame `pose` in its parent frame."""
    x, y, yaw = compose(pose, place[[0, 1, 3]]).tolist()
    return np.array((x, y, float(place[2]), yaw))


def _in_body(tag: TagDetection, glance: Glance) -> Floats | None:
    """Return a tag's place (4,) in the body's frame; None if it cannot be true."""
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


def _same(one: Floats, other: Floats) -> bool:
    turned = abs(math.remainder(float(one[3] - other[3]), math.tau))
    return math.hypot(*(one - other)[:2].tolist()) <= SAME_M and turned <= SAME_RAD


def _spread(pose: Floats, tag: Floats, distance: float) -> Floats:
    """Return the covariance (3, 3) of a robot's pose by a tag, in the map's axes.

    An error of the tag's yaw carries the robot round the tag.
    """
    own = KNOWN_M**2 + (POSITION_M + POSITION_PER_M * distance) ** 2
    x, y = (pose - tag)[:2].tolist()
    lever = np.array((-y, x, 1.0))
    return np.diag((own, own, 1e-3)) + YAW_RAD**2 * np.outer(lever, lever)
