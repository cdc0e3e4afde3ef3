"""Adds contours of cameras to the world model: obstacles that the scan does not show."""

import logging
import math
from collections import Counter

from msgspec.structs import replace

from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import Contour, WorldModel
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.logs import Fault

MAX_DISTANCE_M = 100.0  # from the body to a corner: no camera measures farther
POINT_STEP_M = 0.05  # between sampled points of an edge
MAX_EDGE_POINTS = 200
AHEAD = PerceptionConfig()  # the same cone and strip count as ahead as for scans
REFUSED = "refused_contours"
log = logging.getLogger(__name__)


class ContourFilter:
    """Merges contours into the world model, and refuses impossible ones."""

    def __init__(self, counters: Counter[str]) -> None:
        self._counters, self._fault = counters, Fault(log)

    def merged(self, world: WorldModel, body: BodyDescription | None) -> WorldModel:
        """Return `world` with the contours that block the body, as in `with_contours`."""
        if not world.contours:
            return world
        possible = [contour for contour in world.contours if _possible(contour)]
        if refused := len(world.contours) - len(possible):
            self._counters[REFUSED] += refused
            far = f"corners more than {MAX_DISTANCE_M:.0f} m from the body"
            self._fault.begin(f"refused {refused} contours with {far}; check perception")
        else:
            self._fault.end("all contours are plausible again")
        height = body.body_height if body else math.inf
        blocking = tuple(contour for contour in possible if contour.bottom < height)
        return with_contours(replace(world, contours=blocking), body)


def _possible(contour: Contour) -> bool:
    return all(math.hypot(x, y) <= MAX_DISTANCE_M for x, y in contour.polygon)


def with_contours(world: WorldModel, body: BodyDescription | None) -> WorldModel:
    """Return `world` with its contours in `obstacle_ahead`, `distance_ahead` and `sectors`."""
    if not world.contours or not world.scan_ok or body is None:
        return world
    import numpy as np  # not needed without cameras

    from gigabrain_zenoh.geometry.polygon import points_on_edges

    front = max(x for x, _ in body.footprint)
    radius = max(math.hypot(x, y) for x, y in body.footprint)
    polygons = [np.array(contour.polygon) for contour in world.contours]
    x, y = points_on_edges(polygons, POINT_STEP_M, MAX_EDGE_POINTS).T
    distance, bearing = np.hypot(x, y), np.arctan2(y, x)
    cone = (np.abs(bearing) <= math.radians(AHEAD.sector_deg) / 2) & (distance <= AHEAD.ahead)
    strip = (x > 0) & (x <= front + AHEAD.corridor)
    strip &= np.abs(y) <= radius + AHEAD.turning_room
    ahead = distance[cone | strip]
    nearest = world.distance_ahead
    if ahead.size:
        closest = float(ahead.min())
        nearest = closest if nearest is None else min(closest, nearest)
    sectors = list(world.sectors)
    if count := len(sectors):
        index = np.floor(bearing * (count / math.tau) + 0.5).astype(int) % count
        for sector in set(index.tolist()):
            closest, scanned = float(distance[index == sector].min()), sectors[sector]
            sectors[sector] = closest if scanned is None else min(closest, scanned)
    return replace(
        world,
        obstacle_ahead=world.obstacle_ahead or ahead.size > 0,
        distance_ahead=nearest,
        sectors=tuple(sectors),
    )
