"""Zones and places of the current map, received from perception."""

from collections import deque

from gigabrain_schemas.base import Name
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.topics import ZONES
from gigabrain_schemas.zones import Place, Zones
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import Refused, unknown

NO_ZONES = Zones()
KEPT = 16  # messages; some of them may be newer than the current scan


class ZoneSource:
    """The newest zones, and those from before a tick, so that a replay plans with the same ones."""

    def __init__(self, bus: Bus) -> None:
        self._received: deque[Zones] = deque(maxlen=KEPT)
        bus.latest(ZONES, self._receive)

    @property
    def newest(self) -> Zones:
        """The zones of the newest message."""
        return self._received[-1] if self._received else NO_ZONES

    @property
    def newest_loaded(self) -> int | None:
        """Return the count of loaded maps in the newest message; None before the first."""
        return self._received[-1].maps_loaded if self._received else None

    def at(self, boot: int, tick: int) -> Zones:
        """Return the newest zones of before `tick`, or of an earlier start of the driver."""
        return self._before(boot, tick) or NO_ZONES

    def maps_loaded(self, boot: int, tick: int) -> int | None:
        """Return how many maps were loaded before `tick`; None before the first message."""
        found = self._before(boot, tick)
        return found.maps_loaded if found else None

    def place(self, name: Name) -> Place:
        """Return a place by its name. Raises Refused, with the known names."""
        found = self.newest.place(name)
        if found is None:
            known = [place.name for place in self.newest.places] or ["none"]
            raise Refused(str(unknown("place", name, known)))
        return found

    def goal(self, name: Name, yaw: float | None) -> Goal:
        """Return the goal of a place, with another heading if one is given. Raises Refused."""
        place = self.place(name)
        return Goal(x=place.x, y=place.y, yaw=place.yaw if yaw is None else yaw)

    def _before(self, boot: int, tick: int) -> Zones | None:
        earlier = (
            zones for zones in reversed(self._received) if zones.boot != boot or zones.tick < tick
        )
        oldest = self._received[0] if len(self._received) == KEPT else None
        return next(earlier, oldest)

    def _receive(self, zones: Zones) -> None:
        self._received.append(zones)
