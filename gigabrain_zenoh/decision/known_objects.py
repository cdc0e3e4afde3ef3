"""Objects and tags in the map, received from perception, and the search for a wanted one."""

import math
from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.objects import Labels, MapObject, MapTag, ObjectMap
from gigabrain_schemas.topics import LABELS, OBJECT_MAP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import Latest
from gigabrain_zenoh.decision.behaviours import Target
from gigabrain_zenoh.decision.zones import KEPT
from gigabrain_zenoh.errors import unknown
from gigabrain_zenoh.host.bounded import put_newest

TAG_RADIUS_M = 0.02
MIN_RADIUS_M, MAX_RADIUS_M = 0.02, 1.0
MAX_RECOGNIZERS = 32
NO_OBJECTS = ObjectMap()
Wanted = str | int  # class of an object, or number of a tag


@dataclass(frozen=True, kw_only=True)
class Sought:
    """The result of a search; `target` is None if nothing wanted is known."""

    target: Target | None = None
    id: int = 0  # of the target
    recognizing: bool = True  # recognition runs, so that looking around can find an object


# arguments: wanted, ids to leave out, preferred id
Seek = Callable[[Wanted, Collection[int], int | None], Sought]


class ObjectSource:
    """The newest object map of before a tick, so that a replay finds the same objects."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._received: deque[ObjectMap] = deque(maxlen=KEPT)
        self._subscribed = False

    def observe(self, body: BodyDescription | None) -> None:
        """Subscribe once the body is known to have cameras."""
        if body and body.cameras and not self._subscribed:
            self._subscribed = True
            self._bus.latest(OBJECT_MAP, self._received.append)

    @property
    def newest(self) -> ObjectMap:
        """The objects of the newest message."""
        return self._received[-1] if self._received else NO_OBJECTS

    def at(self, boot: int, tick: int) -> ObjectMap:
        """Return the newest objects of before `tick`, or of an earlier start of the driver."""
        earlier = (
            objects
            for objects in reversed(self._received)
            if objects.boot != boot or objects.tick < tick
        )
        oldest = self._received[0] if len(self._received) == KEPT else NO_OBJECTS
        return next(earlier, oldest)


class LabelSource:
    """The classes that running processes recognise."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._newest: dict[str, Latest[Labels]] = {}  # by key
        self._subscribed = False

    def observe(self, body: BodyDescription | None) -> None:
        """Subscribe once the body is known to have cameras."""
        if body and body.cameras and not self._subscribed:
            self._subscribed = True
            self._bus.subscribe(LABELS, self._receive)

    def check(self, wanted: Iterable[str], remembered: ObjectMap) -> None:
        """Raise UnknownName for a class that is neither recognised nor remembered.

        Without a process that publishes its classes, every class is accepted.
        """
        fresh = [labels for one in self._newest.values() if (labels := one.fresh())]
        known = {label for one in fresh for label in one.labels}
        for label in wanted if fresh else ():
            if label not in known and not any(one.label == label for one in remembered.objects):
                raise unknown("label", label, known)

    def _receive(self, key: str, labels: Labels) -> None:
        latest = self._newest.get(key) or Latest(LABELS, self._bus.clock, self._bus.time)
        latest.store(labels)
        put_newest(self._newest, key, latest, MAX_RECOGNIZERS)


def sought(
    known: ObjectMap,
    here: Pose | None,
    wanted: Wanted,
    without: Collection[int],
    preferred: int | None,
) -> Sought:
    """Return the wanted object nearest to `here`, or the `preferred` one while it is known.

    Objects with an id in `without` are left out.
    """
    found: list[MapObject | MapTag]
    if isinstance(wanted, int):
        found = [one for one in known.tags if one.id == wanted and one.id not in without]
    else:
        found = [one for one in known.objects if one.label == wanted and one.id not in without]
    if not found:
        return Sought(recognizing=known.recognizing)
    x, y = (here.x, here.y) if here else (found[0].x, found[0].y)
    best = min(
        found, key=lambda one: (one.id != preferred, math.hypot(one.x - x, one.y - y), one.id)
    )
    return Sought(target=_target(best), id=best.id, recognizing=known.recognizing)


def _target(one: MapObject | MapTag) -> Target:
    if isinstance(one, MapTag):
        return Target(name=f"tag {one.id}", x=one.x, y=one.y, radius=TAG_RADIUS_M, yaw=one.yaw)
    radius = min(max(one.size[0] / 2, MIN_RADIUS_M), MAX_RADIUS_M)
    return Target(name=f"{one.label} {one.id}", x=one.x, y=one.y, radius=radius)


def named(wanted: Wanted) -> str:
    """Return the wanted object as text for users, such as `a can` or `tag 3`."""
    if isinstance(wanted, int):
        return f"tag {wanted}"
    return f"{'an' if wanted[:1].lower() in 'aeiou' else 'a'} {wanted}"
