"""Zones and places of the present map, as received from perception."""

from collections import deque

from gigabrain_schemas.base import Name
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.topics import ZONES
from gigabrain_schemas.zones import Place, Zones
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import Refused, unknown

NO_ZONES = Zones()
KEPT = 16  # messages that may be newer than the scan that is planned with


class ZoneSource:
    """The newest zones, also as they were before a tick: so a replay plans with the same ones."""

    def __init__(self, bus: Bus) -> None:
        self._received: deque[Zones] = deque(maxlen=KEPT)
        bus.latest(ZONES, self._receive)

    @property
    def newest(self) -> Zones:
        """The zones that were received last."""
        return self._received[-1] if self._received else NO_ZONES

    @property
    def newest_loaded(self) -> int | None:
        """Return the count of loaded maps in the newest message; None before the first."""
        return self._received[-1].maps_loaded if self._received else None

    def at(self, boot: int, tick: int) -> Zones:
        """Return the newest zones from before `tick`, or from an earlier run of the driver."""
        return self._before(boot, tick) or NO_ZONES

    def maps_loaded(self, boot: int, tick: int) -> int | None:
        """Return how many maps were loaded before `tick`; None before the first message."""
        found = self._before(boot, tick)
        return found.maps_loaded if found else None

    def place(self, name: Name) -> Place:
        """Return a place by its name. Raises Refused, with the names that would do."""
        found = self.newest.place(name)
        if found is None:
            known = [one.name for one in self.newest.places] or ["none"]
            raise Refused(str(unknown("place", name, known)))
        return found

    def goal(self, name: Name, yaw: float | None) -> Goal:
        """Return the goal of a place, with another heading if one is given. Raises Refused."""
        place = self.place(name)
        return Goal(x=place.x, y=place.y, yaw=place.yaw if yaw is None else yaw)

    def _before(self, boot: int, tick: int) -> Zones | None:
        earlier = (one for one in reversed(self._received) if one.boot != boot or one.tick < tick)
        oldest = self._received[0] if len(self._received) == KEPT else None
        return next(earlier, oldest)

    def _receive(self, zones: Zones) -> None:
        self._received.append(zones)
