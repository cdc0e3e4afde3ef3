"""Perception: a scan becomes what is round the robot, and whether the scan can be believed."""

import math
from collections.abc import Callable
from contextlib import closing
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import hits_bytes, ranges
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Body, BodyDescription, Lidar, RobotState
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY, SCAN, STATE, WORLD
from gigabrain_zenoh.bus import Bus, Latest
from gigabrain_zenoh.compiling import FINDING, MAPPING, compiled
from gigabrain_zenoh.heartbeat import Progress
from gigabrain_zenoh.obstacles.surroundings import Surroundings
from gigabrain_zenoh.placed_scans import PlacedScans
from gigabrain_zenoh.settings import PerceptionConfig

if TYPE_CHECKING:
    from gigabrain_zenoh.mapper import Mapper

Floats = NDArray[np.float64]

EDGE = 1e-9  # [rad], [m], so that rounding does not decide what lies on an edge
STUCK_BEAMS = 8  # so many beams that all agree to the last bit come from a stuck lidar


def step(config: PerceptionConfig, body: BodyDescription, scan: LaserScan) -> WorldModel:
    """One scan, with numpy throughout: about 65 µs for 360 beams."""
    lidar = body.lidar
    if lidar is None:
        return _unknown("the body has no lidar")
    values = ranges(scan)
    problem = scan_problem(lidar, values, config.ignore_below)
    problem = problem or blind_ahead(lidar, scan, config.ignore_below, config.sector_deg)
    if problem:
        return _unknown(problem)
    x, y = hits(lidar, scan, config.ignore_below)
    squares, bearings = x * x + y * y, np.arctan2(y, x)
    ahead = squares[_ahead(config, body, x, y, squares, bearings)]
    return WorldModel(
        scan_ok=True,
        obstacle_ahead=ahead.size > 0,
        distance_ahead=math.sqrt(ahead.min()) if ahead.size else None,
        sectors=_nearest_per_sector(config.sectors, squares, bearings),
        hits=b"" if config.mapping == "off" else hits_bytes(x, y),
    )


def scan_problem(lidar: Lidar, values: NDArray[np.float32], nearest: float) -> str:
    """Why a scan must not be believed, or an empty text. A blind lidar is not free space.

    `values` are the ranges (n,) [m]; those below `nearest` [m] are the lidar's own housing.
    """
    count = len(values)
    if count != lidar.beams:
        return f"the scan has {count} beams, the body's lidar {lidar.beams}"
    seen = values >= nearest  # nan is not, nor is -inf (REP-117: too close to measure)
    if lidar.no_return == "unknown":
        seen &= values < np.inf
    found = int(np.count_nonzero(seen))
    if found == 0:
        return "the lidar sees nothing at all"
    if 2 * found <= count:
        return f"{count - found} of {count} beams are missing"
    alike = count >= STUCK_BEAMS and values[0] == values[1] < np.inf
    if alike and (values == values[0]).all():
        return "all beams report the same distance"
    return ""


def blind_ahead(lidar: Lidar, scan: LaserScan, nearest: float, cone_deg: float) -> str:
    """Why nothing is known of the cone ahead (whole angle [deg]), or an empty text."""
    values = ranges(scan)
    cone = _beams_ahead(len(values), scan.angle_min, scan.angle_increment, lidar.yaw, cone_deg)
    seen = int(np.count_nonzero(values[cone] >= nearest))
    if 2 * seen <= len(cone):
        return f"{len(cone) - seen} of {len(cone)} beams ahead are missing"
    return ""


def hits(lidar: Lidar, scan: LaserScan, nearest: float) -> tuple[Floats, Floats]:
    """Where the beams of `scan` hit something: x and y in the body's frame [m], (n,) each."""
    values = ranges(scan)
    farthest = min(scan.range_max, lidar.range_max)
    hit = (values >= nearest) & (values <= farthest)  # nan and inf are neither
    cosines, sines = beams(len(values), scan.angle_min, scan.angle_increment, lidar.yaw)
    reached = values[hit]
    return lidar.x + reached * cosines[hit], lidar.y + reached * sines[hit]


@lru_cache(maxsize=8)
def beams(
    count: int, angle_min: float, angle_increment: float, yaw: float
) -> tuple[Floats, Floats]:
    """Cosines and sines of the beams' angles in the body's frame, (count,) each."""
    angles = yaw + angle_min + angle_increment * np.arange(count)
    return np.cos(angles), np.sin(angles)


@lru_cache(maxsize=8)
def _reach(footprint: tuple[tuple[float, float], ...]) -> tuple[float, float]:
    """How far the footprint reaches ahead, and when it turns on the spot [m]."""
    return max(x for x, _ in footprint), max(math.hypot(x, y) for x, y in footprint)


@lru_cache(maxsize=8)
def _beams_ahead(
    count: int, angle_min: float, angle_increment: float, yaw: float, cone_deg: float
) -> NDArray[np.intp]:
    """Indices of the beams that look into the cone ahead, as the lidar sees it."""
    cosines, _ = beams(count, angle_min, angle_increment, yaw)
    return np.flatnonzero(cosines >= math.cos(math.radians(cone_deg) / 2) - EDGE)


def _ahead(
    config: PerceptionConfig,
    body: BodyDescription,
    x: Floats,
    y: Floats,
    squares: Floats,
    bearings: Floats,
) -> NDArray[np.bool_]:
    """Hits in the cone ahead, or in the strip that the body needs to drive on and still turn.

    `squares` are those of the distances [m2], for only one of them needs its root.
    """
    half_angle = math.radians(config.sector_deg) / 2 + EDGE
    cone = (np.abs(bearings) <= half_angle) & (squares <= (config.ahead + EDGE) ** 2)
    front, radius = _reach(body.footprint)
    strip = (x > 0) & (x <= front + config.corridor) & (np.abs(y) <= radius + config.turning_room)
    return cone | strip


def _nearest_per_sector(count: int, squares: Floats, bearings: Floats) -> tuple[float | None, ...]:
    # shifted by a whole turn, so that cutting off the fraction rounds down
    index = (bearings * (count / math.tau) + (count + 0.5 + EDGE)).astype(np.intp) % count
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, index, squares)
    return tuple(math.sqrt(d) if d < math.inf else None for d in nearest.tolist())


def _unknown(problem: str) -> WorldModel:
    return WorldModel(scan_ok=False, scan_problem=problem, obstacle_ahead=True)


async def run(config: PerceptionConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """A world per scan, as soon as it comes; until the process ends."""
    body = bus.latest(BODY)
    needs = (SCAN.key,) if config.mapping == "off" else (SCAN.key, STATE.key)

    def came() -> tuple[object, ...]:
        return tuple(map(bus.arrived.get, needs)) if body.current else ()

    bus.progress = Progress(came, lambda: bus.sent[WORLD.key])

    def see(scan: LaserScan) -> None:
        if body.current:
            bus.publish(WORLD, step(config, body.current.description, scan), basis=scan.basis)

    if config.mapping == "off":
        bus.latest(SCAN, see)
        ready()
        await bus.failed
        return
    await compiled(MAPPING if config.mapping == "slam" else FINDING)
    from gigabrain_zenoh.mapper import Mapper  # and numba: only who has a map pays

    with closing(Mapper(config, bus, body)) as mapper:
        _follow(config, bus, body, mapper)
        ready()
        await bus.failed


def _follow(config: PerceptionConfig, bus: Bus, body: Latest[Body], mapper: "Mapper") -> None:
    """Worlds with the obstacles in them, each in its place by the odometry; then the map."""
    surroundings = Surroundings()

    def see(scan: LaserScan, pose: Pose | None) -> None:
        if body.current:
            description = body.current.description
            world = step(config, description, scan)
            world = surroundings.add(world, description.lidar, scan, pose)
            bus.publish(WORLD, world, basis=scan.basis)
            mapper.see(scan, world.scan_problem)

    def hear(state: RobotState) -> None:
        mapper.hear(state)
        placed.state(state)

    placed = PlacedScans(see, lambda scan: mapper.miss(scan, bus.time.tick))
    bus.latest(STATE, hear)
    bus.latest(SCAN, placed.scan)
