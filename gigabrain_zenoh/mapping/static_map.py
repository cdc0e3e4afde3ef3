"""The map that perception localizes in, as a protocol, and one that was saved."""

from typing import TYPE_CHECKING, Protocol

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Cause
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.geometry.se2 import IDENTITY
from gigabrain_zenoh.host.threads import PATIENCE_S, InTime, ScheduledWorker, done
from gigabrain_zenoh.mapping.global_localization import search
from gigabrain_zenoh.mapping.keyframes import Scan, View
from gigabrain_zenoh.mapping.likelihood_field import contradiction, field_of
from gigabrain_zenoh.mapping.localizer import BackgroundLocalizer, Place
from gigabrain_zenoh.mapping.map_file import SavedMap
from gigabrain_zenoh.mapping.occupancy_grid import CELL, Grid
from gigabrain_zenoh.mapping.occupancy_grid import warm_up as warm_up_grid

if TYPE_CHECKING:
    from gigabrain_zenoh.mapping.slam_map import Still  # and gtsam: only who makes maps pays

BEAMS, ROOM_M = 60, 1.0


class Chart(Protocol):
    """A map, and where the robot is in it."""

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """One scan, after a `motion` (3,) of that covariance (3, 3), in its own frame."""

    def lose(self, why: str) -> None:
        """The robot may be anywhere in the map."""

    def grid(self) -> OccupancyGrid:
        """The map as others see it."""

    def settle(self) -> bool:
        """Begin nothing new beside, until `still`; whether nothing is under way there."""

    def still(self) -> "Still":
        """A copy to be saved, which stays as it is. Raises Refused."""

    def keep(self) -> None:
        """Copy the map at the next scan at which nothing is under way beside; see `kept`."""

    def kept(self) -> "Still | None":
        """The copy of the map before the last scan, if one was made; only once."""

    def report(self) -> dict[str, int]:
        """Figures for people."""

    def problems(self) -> tuple[Cause, ...]:
        """What it cannot do now."""

    def close(self) -> None:
        """End what runs beside."""


class KnownMap:
    """A saved map, which stays as it is."""

    def __init__(
        self, saved: SavedMap, patience_s: float = PATIENCE_S, in_time: InTime = done
    ) -> None:
        self._saved, self._background = saved, ScheduledWorker(patience_s, in_time)
        field = field_of(saved.cells, saved.resolution, (saved.origin_x, saved.origin_y))
        self._finder = BackgroundLocalizer(
            field, "looking for the robot in the map", self._background
        )

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """See Chart."""
        self._background.at_scan()
        return self._finder.step(view, motion, noise)

    def lose(self, why: str) -> None:
        """See Chart."""
        self._finder.lose(why)

    def grid(self) -> OccupancyGrid:
        """See Chart."""
        height, width = self._saved.cells.shape
        return OccupancyGrid(
            resolution=self._saved.resolution,
            width=width,
            height=height,
            origin_x=self._saved.origin_x,
            origin_y=self._saved.origin_y,
            cells=self._saved.cells.tobytes(),
        )

    def settle(self) -> bool:
        """See Chart."""
        return True

    def still(self) -> "Still":
        """Never: it is saved already."""
        raise Refused("not saved: perception finds its way in a saved map, it makes none")

    def keep(self) -> None:
        """Never, likewise."""

    def kept(self) -> "Still | None":
        """Never, likewise."""
        return None

    def report(self) -> dict[str, int]:
        """See Chart."""
        return {"late": self._background.late}

    def problems(self) -> tuple[Cause, ...]:
        """See Chart."""
        return ()

    def close(self) -> None:
        """See Chart."""
        self._background.close()


def warm_up() -> None:
    """Call every kernel of finding the way in a map once, in a room of 2 x 2 m."""
    angles = np.linspace(0.0, 2 * np.pi, BEAMS, endpoint=False)
    ways = np.column_stack((np.cos(angles), np.sin(angles)))
    scan = Scan.of(ROOM_M * ways / np.abs(ways).max(axis=1, keepdims=True), ways[:1])
    warm_up_grid()
    drawn = Grid()
    drawn.draw(IDENTITY, scan.points, scan.free)
    field = field_of(drawn.percent(), CELL, (drawn.origin_x, drawn.origin_y))
    beams = View(scan, np.zeros(2)).beams
    search(field, beams)
    contradiction(field, beams, np.zeros(3))
