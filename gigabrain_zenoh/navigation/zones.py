"""Zones of a map for the planners: cells to keep out of, lanes, and speed limits.

A zone map is made when the zones change, and its overlay when the shape of the grid changes.
"""

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.zones import Zone
from gigabrain_zenoh.geometry import polygon
from gigabrain_zenoh.geometry.sweep import Corners
from gigabrain_zenoh.navigation.block_bounds import COLUMN_STEPS, ROW_STEPS
from gigabrain_zenoh.navigation.costmap import (
    NO_LANES,
    Inflation,
    WayBits,
    ZoneOverlay,
    clearance_costs,
)

EDGE_STEP = 0.5  # [cells] between points of an edge, whose cells are filled too
AGAINST_COSINE = -0.2  # of the angle to a lane; ways with a smaller one are against it
MAX_NAMED = 3  # lanes in a text
MIN_USE_M = 0.5  # a path uses a lane that it follows for more than this
OCCUPIED = 100  # value of cells in keep-out zones

REACTION_S = 0.3  # before the body slows down for a speed zone
BRAKING_SHARE = 0.5  # of the body's deceleration, used to slow down
MIN_LOOK_M = 1.0  # of the path, examined for speed zones

Mask = NDArray[np.uint8]
Box = tuple[float, float, float, float]  # least x and y, greatest x and y [m]


class LanePart(NamedTuple):
    """A straight part of a one-way lane."""

    corners: Floats  # (4, 2) [m]
    begin: Floats  # (2,) [m], middle of the first edge
    ahead: Floats  # (2,), unit vector of the direction
    length: float  # [m]
    half_width: float  # [m]
    against: int  # bits of forbidden ways

    def leads_along(self, path: Floats) -> bool:
        """Return whether a `path` (n, 2) [m] follows this part in its direction."""
        x, y = self.ahead
        off = path - self.begin
        along, aside = off @ self.ahead, np.abs(off @ np.array((-y, x)))
        inside = (along >= 0) & (along <= self.length) & (aside <= self.half_width)
        both = inside[1:] & inside[:-1]
        return bool(both.any()) and float(np.diff(along)[both].sum()) > MIN_USE_M


@dataclass(frozen=True, kw_only=True, eq=False)
class Area:
    """A zone with its polygon, or the middle line of its lane."""

    zone: Zone
    corners: Floats  # (n, 2) [m]
    box: Box
    parts: tuple[LanePart, ...] = ()  # of a lane

    def near(self, x: float, y: float, reach: float) -> bool:
        """Return whether the box of the zone is within `reach` [m] of (x, y)."""
        left, bottom, right, top = self.box
        return left - reach <= x <= right + reach and bottom - reach <= y <= top + reach


@dataclass(frozen=True, kw_only=True)
class SpeedCap:
    """The speed that a zone allows now."""

    speed: float  # [m/s]
    zone: str  # name of the zone


class ZoneMap:
    """The zones of one map, prepared for planning. It is immutable."""

    def __init__(self, zones: Iterable[Zone]) -> None:
        areas = [_area(zone) for zone in zones]
        self.keepouts = [area for area in areas if area.zone.kind == "keepout"]
        self.speeds = [area for area in areas if area.zone.kind == "speed"]
        self.lanes = [area for area in areas if area.zone.kind == "one_way"]

    @property
    def empty(self) -> bool:
        """Return whether no zone restricts where the body may drive."""
        return not self.keepouts and not self.lanes

    def overlay(self, grid: OccupancyGrid, rules: Inflation) -> ZoneOverlay | None:
        """Return the zones in cells of `grid`; None without keep-out zones and lanes."""
        if self.empty:
            return None
        cost = cells = None
        if self.keepouts:
            cells = self._occupied(grid)
            cost = clearance_costs(cells, rules, grid.resolution)
        return ZoneOverlay(
            cost=cost,
            keepouts=cells,
            against=self._against(grid) if self.lanes else NO_LANES,
            problem=lambda x, y: self.problem(x, y, rules.fits),
        )

    def problem(self, x: float, y: float, fits: float) -> str:
        """Return why the body must not be at (x, y) [m], or an empty text.

        Its centre needs a distance of `fits` [m].
        """
        place = np.array(((x, y),))
        for area in self.keepouts:
            if not area.near(x, y, fits):
                continue
            away = float(polygon.distance(area.corners, place)[0])
            if away == 0.0:
                return f"lies in keep-out zone {area.zone.name!r}"
            if away < fits:
                name, needs = area.zone.name, f"the body needs {fits:.2f} m"
                return f"is {away:.2f} m from keep-out zone {name!r}; {needs}"
        return ""

    def in_the_way(self, path: Floats) -> str:
        """Return which zones a `path` (n, 2) [m] would violate, as text."""
        for area in self.keepouts:
            if polygon.contains(area.corners, path).any():
                return f"without entering keep-out zone {area.zone.name!r}"
        names = ", ".join(repr(area.zone.name) for area in self.lanes[:MAX_NAMED])
        lanes = f" or going against one-way lane {names}" if names else ""
        return f"that keeps clear of the keep-out zones{lanes}"

    def keepouts_near(self, x: float, y: float, reach: float) -> tuple[Floats, ...]:
        """Return the polygons (n, 2) [m] of keep-out zones within `reach` [m] of (x, y)."""
        return tuple(area.corners for area in self.keepouts if area.near(x, y, reach))

    def lanes_beside(self, x: float, y: float, reach: float, path: Floats) -> tuple[Floats, ...]:
        """Return the parts of nearby lanes that a `path` (n, 2) [m] does not follow.

        The path may lead past a lane, out of it, or across it. The local planner knows no
        directions, and might take a shorter way against the lane.
        """
        found: list[Floats] = []
        if not self.lanes:
            return ()
        path = path[(np.abs(path - (x, y)) <= reach).all(axis=1)]
        for area in self.lanes:
            assert area.zone.lane_width
            near = area.near(x, y, reach + area.zone.lane_width)
            if near and not any(part.leads_along(path) for part in area.parts):
                found += [part.corners for part in area.parts]
        return tuple(found)

    def speed_cap(
        self, here: Pose, footprint: Corners, path: Floats, speed: float, deceleration: float
    ) -> SpeedCap | None:
        """Return the lowest speed that a zone ahead or around allows; None without one.

        The body drives at `speed` [m/s] along `path` (n, 2) [m], from where it is. A zone counts
        where the turning body could touch it.
        """
        if not self.speeds:
            return None
        brake = BRAKING_SHARE * deceleration
        reach = float(np.hypot(*np.array(footprint).T).max())
        look = MIN_LOOK_M + reach + speed * REACTION_S + speed**2 / (2 * brake)
        gone = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
        ahead, gone = path[gone <= look], gone[gone <= look]
        caps = []
        for area in self.speeds:
            assert area.zone.max_speed
            if not area.near(here.x, here.y, look):
                continue
            touches = np.flatnonzero(polygon.distance(area.corners, ahead) <= reach)
            if not len(touches):
                continue
            away = float(gone[touches[0]])
            left = max(0.0, away - speed * REACTION_S)
            allowed = math.sqrt(area.zone.max_speed**2 + 2 * brake * left)
            caps.append(SpeedCap(speed=allowed, zone=area.zone.name))
        return min(caps, key=lambda cap: cap.speed, default=None)

    def _occupied(self, grid: OccupancyGrid) -> NDArray[np.int8]:
        cells = np.zeros((grid.height, grid.width), np.uint8)
        for area in self.keepouts:
            fill(cells, _in_cells(grid, area.corners), OCCUPIED)
        return cells.view(np.int8)

    def _against(self, grid: OccupancyGrid) -> WayBits:
        """Return the ways that lanes forbid. Overlapping parts of a lane forbid common ways."""
        found = np.zeros((grid.height, grid.width), np.uint8)
        for area in self.lanes:
            outlines = [_in_cells(grid, part.corners) for part in area.parts]
            low = np.floor(np.min([one.min(axis=0) for one in outlines], axis=0)).clip(0)
            high = np.max([one.max(axis=0) for one in outlines], axis=0).clip(low) + 1
            window = found[int(low[1]) : int(high[1]) + 1, int(low[0]) : int(high[0]) + 1]
            lane, covered = np.full_like(window, 255), np.zeros_like(window)
            for part, outline in zip(area.parts, outlines, strict=True):
                drawn = np.zeros_like(window)
                fill(drawn, outline - low, 1)
                lane[drawn == 1] &= np.uint8(part.against)
                covered |= drawn
            window |= np.where(covered == 1, lane, np.uint8(0))
        return found


def _area(zone: Zone) -> Area:
    corners = np.array(zone.points)
    (left, bottom), (right, top) = corners.min(axis=0), corners.max(axis=0)
    box = float(left), float(bottom), float(right), float(top)
    parts = tuple(_lane_parts(corners, zone.lane_width)) if zone.lane_width else ()
    return Area(zone=zone, corners=corners, box=box, parts=parts)


def _lane_parts(middle: Floats, width: float) -> Iterator[LanePart]:
    """Yield the straight parts of a lane."""
    for begin, end in itertools.pairwise(middle):
        along = end - begin
        length = float(np.hypot(*along))
        if length == 0.0:
            continue
        ahead = along / length
        aside = np.array((-ahead[1], ahead[0])) * width / 2
        bits = 0
        for way, (down, right) in enumerate(zip(ROW_STEPS, COLUMN_STEPS, strict=True)):
            cosine = (right * ahead[0] + down * ahead[1]) / math.hypot(right, down)
            bits |= int(cosine < AGAINST_COSINE) << way
        corners = np.array((begin + aside, begin - aside, end - aside, end + aside))
        yield LanePart(corners, begin, ahead, length, width / 2, bits)


def _in_cells(grid: OccupancyGrid, corners: Floats) -> Floats:
    found: Floats = (corners - (grid.origin_x, grid.origin_y)) / grid.resolution
    return found


def fill(cells: Mask, corners: Floats, value: int) -> None:
    """Set the `cells` (height, width) that a polygon (n, 2), in cells, covers or touches."""
    height, width = cells.shape
    inside = clipped(corners, (-1.0, -1.0, width + 1.0, height + 1.0))
    if not len(inside):
        return
    left, top = np.maximum(inside.min(axis=0), 0).astype(np.intp)
    right, bottom = np.floor(inside.max(axis=0)).astype(np.intp) + 1
    part = cells[top:bottom, left:right]
    if part.size:
        part[_covered(inside - (left, top), part.shape)] = value


def _covered(corners: Floats, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the cells (height, width) whose middle is inside a polygon or that an edge crosses."""
    height, width = shape
    ends = np.roll(corners, -1, axis=0)
    crossings = np.zeros((height, width + 1), np.uint8)  # before a cell's middle, modulo 256
    both = np.ceil(np.stack((corners[:, 1], ends[:, 1])) - 0.5).clip(0, height).astype(np.intp)
    first, last = both.min(axis=0), both.max(axis=0)
    edge, rows = polygon.spread(last - first)
    rows += first[edge]
    (x, y), (to_x, to_y) = corners[edge].T, ends[edge].T
    at = x + (rows + 0.5 - y) / np.where(to_y == y, 1.0, to_y - y) * (to_x - x)
    columns = np.ceil(at - 0.5).clip(0, width).astype(np.intp)
    np.add.at(crossings, (rows, columns), np.uint8(1))
    covered: NDArray[np.bool_] = np.cumsum(crossings[:, :-1], axis=1, dtype=np.uint8) & 1 == 1
    counts = np.ceil(np.abs(ends - corners).max(axis=1) / EDGE_STEP).astype(np.intp) + 1
    edge, step = polygon.spread(counts)
    share = step / counts[edge]
    points = corners[edge] + share[:, None] * (ends - corners)[edge]
    points = points[((points >= 0) & (points < (width, height))).all(axis=1)]
    columns, rows = points.astype(np.intp).T
    covered[rows, columns] = True
    return covered


def clipped(corners: Floats, box: Box) -> Floats:
    """Return the part (m, 2) of a polygon (n, 2) inside `box`.

    Sutherland and Hodgman, Reentrant polygon clipping, CACM 1974.
    """
    for axis, limit, sign in ((0, box[0], 1), (1, box[1], 1), (0, box[2], -1), (1, box[3], -1)):
        if not len(corners):
            break
        ends = np.roll(corners, -1, axis=0)
        room, end_room = sign * (corners[:, axis] - limit), sign * (ends[:, axis] - limit)
        crosses = (room < 0) != (end_room < 0)
        share = room / np.where(crosses, room - end_room, 1.0)
        meets = corners + share[:, None] * (ends - corners)
        both = np.stack((corners, meets), axis=1).reshape(-1, 2)
        corners = both[np.stack((room >= 0, crosses), axis=1).ravel()]
    return corners


NO_ZONES = ZoneMap(())
