"""Random cluttered worlds: a planar lidar does not see most of their objects and pits.

Each is a walled room with ten goals. A search on the true shapes has found a way from goal to goal,
wide enough for the body to turn anywhere on it.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.geometry.polygon import distance
from gigabrain_zenoh.geometry.sweep import radius
from gigabrain_zenoh.navigation.costmap import LETHAL
from gigabrain_zenoh.navigation.grid_search import GridSearch
from gigabrain_zenoh.qa.bench.eyes_worlds import Part, Pit, distances

HALF_M = 2.1  # half the room's width
GOALS = 10
THINGS = (12, 16)  # smallest and largest number
PITS = (1, 3)  # the same
KINDS = (  # repeated by their frequency
    "table", "low table", "low table", "box", "box", "box", "bar", "bar", "shelf", "sill", "sill",
    "post", "cupboard",
)  # fmt: skip
GAP_M = 0.10  # between two things
START_M = 0.55  # free radius round the start
CELL_M = 0.05
WAY_SPARE_M, GOAL_SPARE_M = 0.08, 0.17  # added to the radius in which the body turns
LOW_ROOF_M = 0.08  # above the body; ways do not lead under lower roofs
LEG_M, MAX_LEG_M = 0.9, 1.6  # least and largest length of the way from goal to goal
CANDIDATES = 30  # for a goal; the farthest from earlier goals is chosen
SPREAD_M = 2.0  # least extent of all goals along x or y
BARRED_SHARE = 0.8  # of the legs, for which a blocked straight line is preferred
MAX_DRAWS = 200
DEEPEST_M = 0.5  # of a pit
Point = tuple[float, float]


@dataclass(frozen=True)
class ClutteredWorld:
    """A room with things, pits, and goals that are reachable in turn."""

    seed: int
    parts: tuple[Part, ...]
    kinds: tuple[str, ...]  # by a thing's number
    pits: tuple[Pit, ...]
    start: Pose
    goals: tuple[Point, ...]
    legs: tuple[float, ...]  # [m], length of the way to each goal

    def name_near(self, x: float, y: float) -> str:
        """Return the kind of the thing, pit or wall that is nearest to a point [m]."""
        at = np.array([[x, y]])
        named = [(one.outline, self.kinds[one.thing]) for one in self.parts]
        named += [(one.outline, "pit") for one in self.pits]
        away = [(float(distances([outline], at)[0]), name) for outline, name in named]
        away.append((HALF_M - max(abs(x), abs(y)), "wall"))
        return min(away)[1]


def draw_cluttered(seed: int, body: BodyDescription) -> ClutteredWorld:
    """Return the world of a seed for a body."""
    random = np.random.default_rng(np.random.SeedSequence((seed, 1800)))
    for _ in range(MAX_DRAWS):
        world = _draw(seed, random, body)
        if world:
            return world
    raise AssertionError(f"no world with ten goals for seed {seed}")  # the body is too large


def _draw(seed: int, random: np.random.Generator, body: BodyDescription) -> ClutteredWorld | None:
    parts: list[Part] = []
    kinds: list[str] = []
    x, y = random.uniform(-HALF_M + 0.8, HALF_M - 0.8, 2).tolist()
    start = Pose(x=x, y=y, yaw=float(random.uniform(-math.pi, math.pi)))
    pits: list[Pit] = []
    pit_count = random.integers(PITS[0], PITS[1] + 1)
    for _ in range(20):
        pit = _pit(random)
        if len(pits) < pit_count and _fits(pit.outline, [one.outline for one in pits], start):
            pits.append(pit)
    wanted = int(random.integers(THINGS[0], THINGS[1] + 1))
    for _ in range(20 * wanted):
        if len(kinds) == wanted:
            break
        kind = str(random.choice(KINDS))
        new = list(_thing(random, len(kinds), kind, body.body_height))
        others = [one.outline for one in parts] + [one.outline for one in pits]
        if all(_fits(one.outline, others, start) for one in new):
            parts += new
            kinds.append(kind)
    free = FreeSpace(parts, pits, body)
    found = free.goals(random, (start.x, start.y))
    if found is None:
        return None
    goals, legs = found
    return ClutteredWorld(seed, tuple(parts), tuple(kinds), tuple(pits), start, goals, legs)


def _pit(random: np.random.Generator) -> Pit:
    half_x, half_y = random.uniform(0.15, 0.5, 2).tolist()
    reach_x, reach_y = HALF_M - half_x, HALF_M - half_y
    x, y = random.uniform(-reach_x, reach_x), random.uniform(-reach_y, reach_y)
    if random.random() < 0.3:  # a step down along a wall
        x = math.copysign(reach_x, x)
    return Pit(float(x), float(y), half_x, half_y, float(random.uniform(0.05, DEEPEST_M)))


def _fits(outline: Floats, others: Sequence[Floats], start: Pose) -> bool:
    if np.abs(outline).max() > HALF_M + 1e-9:
        return False
    if distance(outline, np.array([[start.x, start.y]]))[0] < START_M:
        return False
    rim = _points_along(outline)
    return all(
        _boxes_gap(outline, other) >= GAP_M
        or min(distance(other, rim).min(), distance(outline, _points_along(other)).min()) >= GAP_M
        for other in others
    )


def _boxes_gap(one: Floats, other: Floats) -> float:
    """Return the gap between the axis-aligned boxes round two outlines [m]."""
    beyond = np.maximum(one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0))
    return float(beyond.max())


def _points_along(outline: Floats) -> Floats:
    """Return points (n, 2) [m] along an outline, closer than half of GAP_M."""
    steps = math.ceil(4 * HALF_M / GAP_M)
    share = np.linspace(0.0, 1.0, steps, endpoint=False)[:, None, None]
    points: Floats = (outline + share * (np.roll(outline, -1, axis=0) - outline)).reshape(-1, 2)
    return points


def _thing(random: np.random.Generator, thing: int, kind: str, height: float) -> Iterator[Part]:
    """Draw the parts of one thing of a kind; `thing` is its number."""
    x, y = random.uniform(-HALF_M, HALF_M, 2).tolist()
    yaw = float(random.uniform(-math.pi, math.pi))

    def draw(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def beside(across: float, along: float) -> Point:
        cos, sin = math.cos(yaw), math.sin(yaw)
        return x + cos * across - sin * along, y + sin * across + cos * along

    if kind in ("table", "low table"):
        half_x, half_y = draw(0.25, 0.5), draw(0.2, 0.4)
        leg = draw(0.012, 0.025)
        low = kind == "low table"
        bottom = draw(0.06, height - 0.005) if low else draw(0.35, 0.75)
        for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
            at = beside(a * (half_x - leg), b * (half_y - leg))
            yield Part(thing, *at, leg, leg, bottom, yaw=yaw)
        yield Part(thing, x, y, half_x, half_y, bottom + 0.02, bottom, yaw)
    elif kind == "bar":  # between two posts, above or below the lidar's plane
        half, post = draw(0.3, 0.6), draw(0.015, 0.03)
        bottom = height - draw(0.004, 0.012) if random.random() < 0.4 else draw(0.05, 0.12)
        for a in (1, -1):
            at = beside(0.0, a * half)
            yield Part(thing, *at, post, post, 0.5, round=True)
        yield Part(thing, x, y, 0.015, half - post, bottom + 0.03, bottom, yaw)
    elif kind == "shelf":  # without legs
        bottom = draw(0.06, 0.12)
        half_x, half_y = draw(0.1, 0.3), draw(0.1, 0.4)
        yield Part(thing, x, y, half_x, half_y, bottom + 0.02, bottom, yaw)
    elif kind == "sill":
        yield Part(thing, x, y, draw(0.015, 0.04), draw(0.25, 0.6), draw(0.03, 0.05), yaw=yaw)
    elif kind == "box":
        yield Part(thing, x, y, draw(0.03, 0.25), draw(0.03, 0.25), draw(0.03, 0.145), yaw=yaw)
    elif kind == "post":
        size = draw(0.015, 0.12)
        yield Part(thing, x, y, size, size, draw(0.3, 1.0), round=True)
    else:  # a cupboard
        yield Part(thing, x, y, draw(0.15, 0.4), draw(0.1, 0.2), draw(0.4, 1.0), yaw=yaw)


class FreeSpace:
    """The free space of a body among a world's true shapes, in cells of CELL_M."""

    def __init__(self, parts: Sequence[Part], pits: Sequence[Pit], body: BodyDescription) -> None:
        obstacles = [one.outline for one in parts if one.bottom < body.body_height + LOW_ROOF_M]
        self._obstacles = obstacles + [one.outline for one in pits]
        middles = np.arange(-HALF_M + CELL_M / 2, HALF_M, CELL_M)
        x, y = np.meshgrid(middles, middles)
        points = np.column_stack((x.ravel(), y.ravel()))
        self._away = distances(self._obstacles, points)
        room = np.minimum(self._away, HALF_M - np.abs(points).max(axis=1))
        self._points, self._room = points, room
        self._side, self._turning = len(middles), radius(body.footprint)
        free = (room >= self._turning + WAY_SPARE_M).reshape(x.shape)
        self._cost = np.where(free, 1.0, LETHAL).astype(np.float32)
        self._search = GridSearch()

    def ways_from(self, place: Point) -> Floats:
        """Return the length of the way from `place` to each cell (n,) [m]; inf without a way."""
        row, column = divmod(self._cell(place), self._side)
        ways = self._search.field(self._cost, (row, column), "from") * CELL_M
        return np.where(self._cost < LETHAL, ways, np.inf).ravel()

    def way(self, begin: Point, end: Point) -> float:
        """Return the length of the way between two places [m]; inf without a way."""
        return float(self.ways_from(begin)[self._cell(end)])

    def _cell(self, place: Point) -> int:
        return int(self._cells(np.array(place)))

    def _cells(self, places: Floats) -> NDArray[np.intp]:
        """Return the numbers of the cells that contain places (..., 2) [m]."""
        at = np.clip((places + HALF_M) / CELL_M, 0, self._side - 1).astype(np.intp)
        return np.asarray(at[..., 1] * self._side + at[..., 0])

    def goals(
        self, random: np.random.Generator, start: Point
    ) -> tuple[tuple[Point, ...], tuple[float, ...]] | None:
        """Return goals, and the lengths of the ways to them [m]; None if there are too few."""
        here, goals, legs = start, list[Point](), list[float]()
        while len(goals) < GOALS:
            ways = self.ways_from(here)
            good = (ways >= LEG_M) & (ways <= MAX_LEG_M)
            good &= self._room >= self._turning + GOAL_SPARE_M
            possible = np.flatnonzero(good)
            if not len(possible):
                return None
            candidates = random.choice(possible, min(len(possible), CANDIDATES), replace=False)
            prefer_barred = random.random() < BARRED_SHARE
            earlier = np.array((start, *goals))
            away = self._points[candidates, None] - earlier
            score = np.hypot(*away.transpose(2, 0, 1)).min(axis=1)
            score += [HALF_M * (self._barred(here, one) == prefer_barred) for one in candidates]
            at = candidates[score.argmax()]
            x, y = self._points[at].tolist()
            here = (round(x, 3), round(y, 3))
            goals.append(here)
            legs.append(round(float(ways[at]), 2))
        spread = float(np.ptp(goals, axis=0).max())
        return (tuple(goals), tuple(legs)) if spread >= SPREAD_M else None

    def _barred(self, here: Point, cell: int) -> bool:
        """Return whether an obstacle blocks the straight line to a cell."""
        share = np.linspace(0.0, 1.0, 40)[:, None]
        line = np.array(here) + share * (self._points[cell] - here)
        away = float(self._away[self._cells(line)].min())
        if abs(away - self._turning / 2) < CELL_M:  # too close for the cells' resolution
            away = float(distances(self._obstacles, line).min())
        return away < self._turning / 2


def write_world(world: ClutteredWorld, folder: Path) -> Path:
    """Write the world file and its model; return the path of the world file."""
    (folder / "things.xml").write_text(mjcf(world), "utf-8")
    path = folder / "cluttered.yaml"
    start = [world.start.x, world.start.y, world.start.yaw]
    path.write_text(  # JSON is YAML
        json.dumps({
            "description": f"cluttered world {world.seed}",
            "size": [2 * HALF_M, 2 * HALF_M],
            "start": start,
            "model": "things.xml",
        }),
        "utf-8",
    )  # fmt: skip
    return path


def mjcf(world: ClutteredWorld) -> str:
    """Return the floor and all things as an MJCF model."""
    geoms = [_geom(f"floor{n}", one, "0.6 0.62 0.6 1") for n, one in enumerate(_slabs(world.pits))]
    for number, one in enumerate(world.parts):
        colour = f"{0.3 + 0.2 * (one.thing % 3):.2f} 0.4 {0.7 - 0.4 * (one.thing % 2):.2f} 1"
        geoms.append(_geom(f"thing{number}", one, colour))
    return f"<mujoco><worldbody>{''.join(geoms)}</worldbody></mujoco>\n"


def _geom(name: str, one: Part, colour: str) -> str:
    half = (one.top - one.bottom) / 2
    kind, size = "box", f"{one.half_x:.5f} {one.half_y:.5f} {half:.5f}"
    if one.round:
        kind, size = "cylinder", f"{one.half_x:.5f} {half:.5f}"
    quat = f"{math.cos(one.yaw / 2):.6f} 0 0 {math.sin(one.yaw / 2):.6f}"
    return (
        f'<geom name="{name}" type="{kind}" size="{size}" quat="{quat}" rgba="{colour}" '
        f'pos="{one.x:.5f} {one.y:.5f} {one.bottom + half:.5f}"/>\n'
    )


def _slabs(pits: Sequence[Pit]) -> Iterator[Part]:
    """Yield the floor: slabs round all pits, and one at the bottom of each."""
    end, under = HALF_M + 0.3, -DEEPEST_M - 0.1
    lows = [one.y - one.half_y for one in pits]
    cuts = sorted({-end, end, *lows, *(one.y + one.half_y for one in pits)})
    for low, high in pairwise(cuts):
        middle_y = (low + high) / 2
        here = sorted(one for one in pits if abs(one.y - middle_y) < one.half_y)
        begin = -end
        for pit in (*here, None):
            until = pit.x - pit.half_x if pit else end
            if until - begin > 1e-6:
                middle, half = (begin + until) / 2, (until - begin) / 2
                yield Part(0, middle, middle_y, half, (high - low) / 2, 0.0, under)
            begin = pit.x + pit.half_x if pit else end
    for pit in pits:
        yield Part(0, pit.x, pit.y, pit.half_x, pit.half_y, -pit.depth, under - 0.1)
