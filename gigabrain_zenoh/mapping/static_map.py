"""Protocol of the maps that perception localizes in, and a saved map."""

from typing import TYPE_CHECKING, Protocol

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Cause
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.config.map_image import SavedMap
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.geometry.se2 import IDENTITY
from gigabrain_zenoh.host.threads import PATIENCE_S, InTime, ScheduledWorker, done
from gigabrain_zenoh.mapping.global_localization import search
from gigabrain_zenoh.mapping.keyframes import Scan, View
from gigabrain_zenoh.mapping.likelihood_field import contradiction, field_of
from gigabrain_zenoh.mapping.localizer import BackgroundLocalizer, Place
from gigabrain_zenoh.mapping.occupancy_grid import CELL, LogOddsGrid
from gigabrain_zenoh.mapping.occupancy_grid import warm_up as warm_up_grid
from gigabrain_zenoh.mapping.pose_hint import PoseHint

if TYPE_CHECKING:
    from gigabrain_zenoh.mapping.slam_map import MapSnapshot  # imports gtsam: for slam only

BEAMS, ROOM_M = 60, 1.0  # of warm_up; half a side
NO_POSES: Floats = np.empty((0, 3))


class RobotMap(Protocol):
    """A map, and the robot's pose in it."""

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """Process one scan after a `motion` (3,) of covariance `noise` (3, 3), in its own frame."""

    def lose(self, why: str) -> None:
        """Search the whole map for the robot."""

    def suggest(self, hint: PoseHint) -> None:
        """Look for the robot near `hint`, a pose of the next scan.

        A localized robot stays, unless its scan fits better there.
        """

    def grid(self) -> OccupancyGrid:
        """Return the map as a message."""

    def keyframes(self) -> tuple[int, Floats]:
        """Return the poses of the keyframes as they are in the grid (n, 3), and their version.

        The version changes when poses are corrected, not when some are added. A map that never
        changes has no keyframes.
        """
        return 0, NO_POSES

    def settle(self) -> bool:
        """Start no background work until `still`; return whether none is running."""
        return True

    def still(self) -> "MapSnapshot":
        """Return a copy to be saved, which does not change. Raises Refused."""

    def keep(self) -> None:
        """Copy the map at the next scan without background work; see `kept`."""
        return

    def kept(self) -> "MapSnapshot | None":
        """Return the copy of the map before the last scan, once; None if none was made."""
        return None

    def report(self) -> dict[str, int]:
        """Return counters for health reports."""

    def problems(self) -> tuple[Cause, ...]:
        """Return the present problems of the map."""
        return ()

    def close(self) -> None:
        """End the background work."""


class StaticMap(RobotMap):
    """A saved map, which does not change."""

    def __init__(
        self, saved: SavedMap, patience_s: float = PATIENCE_S, in_time: InTime = done
    ) -> None:
        self._saved, self._background = saved, ScheduledWorker(patience_s, in_time)
        field = field_of(saved.cells, saved.resolution, (saved.origin_x, saved.origin_y))
        self._finder = BackgroundLocalizer(
            field, "looking for the robot in the map", self._background
        )

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """See RobotMap."""
        self._background.at_scan()
        return self._finder.step(view, motion, noise)

    def lose(self, why: str) -> None:
        """See RobotMap."""
        self._finder.lose(why)

    def suggest(self, hint: PoseHint) -> None:
        """See RobotMap."""
        self._finder.suggest(hint)

    def grid(self) -> OccupancyGrid:
        """See RobotMap."""
        height, width = self._saved.cells.shape
        return OccupancyGrid(
            resolution=self._saved.resolution,
            width=width,
            height=height,
            origin_x=self._saved.origin_x,
            origin_y=self._saved.origin_y,
            cells=self._saved.cells.tobytes(),
        )

    def still(self) -> "MapSnapshot":
        """Refuse: the map is saved already."""
        raise Refused("not saved: perception only localizes in a saved map; set mapping: slam")

    def report(self) -> dict[str, int]:
        """See RobotMap."""
        return {"late": self._background.late}

    def close(self) -> None:
        """See RobotMap."""
        self._background.close()


def warm_up() -> None:
    """Compile the kernels that localize, by calling each once in a room of 2 x 2 m."""
    angles = np.linspace(0.0, 2 * np.pi, BEAMS, endpoint=False)
    rays = np.column_stack((np.cos(angles), np.sin(angles)))
    scan = Scan.of(ROOM_M * rays / np.abs(rays).max(axis=1, keepdims=True), rays[:1])
    warm_up_grid()
    grid = LogOddsGrid()
    grid.draw(IDENTITY, scan.points, scan.free)
    field = field_of(grid.percent(), CELL, (grid.origin_x, grid.origin_y))
    beams = View(scan, np.zeros(2)).beams
    search(field, beams)
    contradiction(field, beams, np.zeros(3))
