"""A localizer whose searches of the whole map run beside the scans."""

from gigabrain_zenoh.geometry.se2 import IDENTITY, Floats, compose
from gigabrain_zenoh.host.threads import ScheduledWorker, Take
from gigabrain_zenoh.mapping.field import Field
from gigabrain_zenoh.mapping.localizer import Localizer, Place, View
from gigabrain_zenoh.mapping.relocalize import search

SEARCH_SCANS = 8  # after which what a search has found is taken


class Finder:
    """Where the robot is in a map that does not change."""

    def __init__(
        self, field: Field, why: str, background: ScheduledWorker, last: Floats | None = None
    ) -> None:
        self._localizer = Localizer(field, why)
        self._background = background
        self._moved = IDENTITY  # since the scan that a search goes by
        self.last = last  # where it was before it was lost, by odometry: it may still be there
        self._lost = 0  # how often

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """One scan, after a `motion` (3,) of that covariance (3, 3), in its own frame."""
        self._moved = compose(self._moved, motion)
        self.last = None if self.last is None else compose(self.last, motion)
        place = self._localizer.step(view, motion, noise)
        if place.localized:
            self.last = place.pose
        if self._localizer.wants_search and self._background.idle:
            self._search(view)
        return place

    def lose(self, why: str) -> None:
        """The robot may be anywhere; a search that is under way is too late."""
        self._lost += 1
        self._localizer.lose(why)

    def _search(self, view: View) -> None:
        localizer, number, last = self._localizer, self._lost, self.last
        localizer.searching()
        self._moved = IDENTITY

        def work() -> Take:
            found = search(localizer.map, view.scan.points, view.scan.free, view.sensor, last)

            def take() -> None:
                if number == self._lost:
                    localizer.found(found, self._moved, self.last)

            return take

        self._background.start(work, SEARCH_SCANS)
