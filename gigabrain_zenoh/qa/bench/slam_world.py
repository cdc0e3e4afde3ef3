"""`gigabrain bench slam --world`: maps simulated worlds, and compares poses with the true ones."""

import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.scan import hits
from gigabrain_zenoh.geometry.se2 import between, compose, inverse
from gigabrain_zenoh.mapping.likelihood_field import OCCUPIED
from gigabrain_zenoh.mapping.odometry import OdometryFusion, OdometrySample, way
from gigabrain_zenoh.mapping.slam_map import SlamMap
from gigabrain_zenoh.perception.mapper import view_of
from gigabrain_zenoh.qa.bench.slam_logs import DRIVEN, REFERENCE, draw_side_by_side
from gigabrain_zenoh.qa.judging import Latencies, latencies
from gigabrain_zenoh.runtime.services import rss_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CLOSE_LOOPS_S = 60.0  # long enough that a slow machine makes the same map
COLD_SCANS = 20  # without timing, at the start
TICKS_PER_MINUTE = round(60e9 / TICK_NS)

Progress = Callable[[], None]  # called after each minute


UNKNOWN = 55  # grey of unknown cells, in percent of black
WARM_UP_SHARE = 0.25  # of the time at the start, which the slope leaves out
MINUTES_PER_HOUR = 60


class MapGrowth(Struct, frozen=True, kw_only=True):
    """Memory of a mapping process, and size of its map."""

    memory_mb: tuple[float, ...]  # once a minute of the robot's time
    mb_an_hour: float  # slope of the memory after the first quarter
    walls: tuple[int, ...]  # occupied cells after each hour, and at the end

    @property
    def most_mb(self) -> float:
        """The largest memory [MB]."""
        return max(self.memory_mb, default=0.0)


class GrowthSampler:
    """Samples memory and map, minute by minute."""

    def __init__(self) -> None:
        self._memory: list[float] = []
        self._walls: list[int] = []

    @property
    def minutes(self) -> int:
        """Number of minutes sampled."""
        return len(self._memory)

    def minute(self, rss_mb: float, grid: OccupancyGrid) -> None:
        """Add the sample of a minute."""
        self._memory.append(rss_mb)
        if self.minutes % MINUTES_PER_HOUR == 0:
            self._walls.append(occupied(grid))

    def growth(self, grid: OccupancyGrid) -> MapGrowth:
        """Return the figures of all samples; `grid` is the map at the end."""
        return MapGrowth(
            memory_mb=tuple(round(one, 1) for one in self._memory),
            mb_an_hour=slope(self._memory[int(len(self._memory) * WARM_UP_SHARE) :])
            * MINUTES_PER_HOUR,
            walls=(*self._walls, occupied(grid)),
        )


def slope(values: Sequence[float]) -> float:
    """Return the growth per value, by linear regression."""
    return float(np.polyfit(np.arange(len(values)), values, 1)[0]) if len(values) > 1 else 0.0


def occupied(grid: OccupancyGrid) -> int:
    """Count the occupied cells; a wall that is drawn twice has more of them."""
    return int((grid.array() >= OCCUPIED).sum())


class PoseErrors(Struct, frozen=True, kw_only=True):
    """Errors of poses; the true ones begin at the same start."""

    mean_m: float
    max_m: float
    mean_deg: float
    max_deg: float


class WorldResult(Struct, frozen=True, kw_only=True):
    """Figures of one world. Times are CPU times."""

    world: str
    body: str
    seed: int
    minutes: float
    driven_m: float
    contacts: int
    scans: int
    not_localized: int  # scans
    keyframes: int
    loops: int
    drawn_anew: int
    fused: PoseErrors  # odometry with gyro
    slam: PoseErrors
    last_minute: PoseErrors
    scan: Latencies
    growth: MapGrowth  # of this process, with its simulation


class WorldsResult(Struct, frozen=True, kw_only=True):
    """Figures of all worlds."""

    worlds: tuple[WorldResult, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class MappedWorld:
    """A mapped world, with the data for drawing it."""

    result: WorldResult
    grid: OccupancyGrid
    poses: Floats  # (n, 3), estimated, in the map
    truth: Floats  # (n, 3), true, in the map


def map_world(body: str, world: str, seed: int, minutes: float, progress: Progress) -> MappedWorld:
    """Let the body explore the world for `minutes`. Raises ConfigError."""
    from gigabrain_zenoh.qa.simulated_drives import ExploreRun  # needs MuJoCo

    roaming = ExploreRun(body, world, seed)
    if (lidar := roaming.body.lidar) is None:
        raise ConfigError(f"{body} has no lidar, and so makes no map")
    run = _MappingRun(SlamMap(CLOSE_LOOPS_S))
    sampler = GrowthSampler()
    for count, one in enumerate(roaming.ticks(round(minutes * TICKS_PER_MINUTE)), 1):
        run.fusion.add(one.state, roaming.body)
        if one.scan:
            run.scan(lidar, one.scan, np.array(one.truth))
        if count % TICKS_PER_MINUTE == 0:
            sampler.minute(rss_bytes() / 1e6, run.slam_map.grid())
            progress()
    if not len(run.poses):
        raise ConfigError(f"--minutes: {minutes:g} is too short for a scan")
    truth, report = roaming.simulation.truth, run.slam_map.report()
    grid = run.slam_map.grid()
    run.slam_map.close()
    poses, true_poses, fused = run.poses, run.in_map(), run.fused
    off = between(true_poses, poses)
    map_from_odometry = compose(poses[0], inverse(fused[0]))
    result = WorldResult(
        world=world,
        body=body,
        seed=seed,
        minutes=minutes,
        driven_m=round(truth.distance_m, 1),
        contacts=truth.contacts,
        scans=len(poses),
        not_localized=run.not_localized,
        keyframes=report["keyframes"],
        loops=report["loops"],
        drawn_anew=report["drawn_anew"],
        fused=_errors(between(true_poses, compose(map_from_odometry, fused))),
        slam=_errors(off),
        last_minute=_errors(off[-600:]),
        scan=latencies(run.took_ms[COLD_SCANS:]),
        growth=sampler.growth(grid),
    )
    return MappedWorld(result=result, grid=grid, poses=poses, truth=true_poses)


class _MappingRun:
    """Maps scans and states like perception, and keeps the poses."""

    def __init__(self, slam_map: SlamMap) -> None:
        self.slam_map, self.fusion, self.not_localized = slam_map, OdometryFusion(), 0
        # flat arrays: an hour of poses hardly changes the measured memory
        self.took_ms, self._poses, self._fused = array("d"), array("d"), array("d")
        self._truth = array("d")  # in the world
        self._last: OdometrySample | None = None

    def scan(self, lidar: Lidar, scan: LaserScan, truth: Floats) -> None:
        """Add a scan from the true pose `truth` (3,)."""
        sample = self.fusion.at(scan.basis)
        if sample is None:
            return
        ends = np.column_stack(hits(lidar, scan, PerceptionConfig().ignore_below))
        begin_s = time.thread_time()
        view = view_of(lidar, scan, ends)
        place = self.slam_map.step(view, *way(self._last or sample, sample))
        self.took_ms.append((time.thread_time() - begin_s) * 1e3)
        self._last = sample
        self.not_localized += not place.localized
        self._poses.extend(place.pose)
        self._fused.extend(sample.fused)
        self._truth.extend(truth)

    @property
    def poses(self) -> Floats:
        """Poses in the map (n, 3)."""
        return np.array(self._poses).reshape(-1, 3)

    @property
    def fused(self) -> Floats:
        """Poses by odometry and gyro (n, 3)."""
        return np.array(self._fused).reshape(-1, 3)

    def in_map(self) -> Floats:
        """Return the true poses (n, 3) in the map's frame."""
        truth = np.array(self._truth).reshape(-1, 3)
        return compose(compose(self.poses[0], inverse(truth[0])), truth)


def _errors(off: Floats) -> PoseErrors:
    away, turn = np.hypot(off[:, 0], off[:, 1]), np.degrees(np.abs(off[:, 2]))
    return PoseErrors(
        mean_m=float(away.mean()),
        max_m=float(away.max()),
        mean_deg=float(turn.mean()),
        max_deg=float(turn.max()),
    )


def draw_worlds(worlds: Sequence[MappedWorld], to: Path) -> None:
    """Draw the maps side by side. Raises ConfigError."""
    draw_side_by_side(worlds, len(worlds), _draw_world, to)


def _draw_world(axes: "Axes", one: MappedWorld) -> None:
    grid, shown = one.grid, one.grid.array().astype(np.int16)
    shown[shown < 0] = UNKNOWN
    left, low = grid.origin_x, grid.origin_y
    right, high = left + grid.width * grid.resolution, low + grid.height * grid.resolution
    axes.imshow(
        100 - shown, "gray", origin="lower", extent=(left, right, low, high), vmin=0, vmax=100
    )
    axes.plot(*one.truth[:, :2].T, color=REFERENCE, linewidth=1.2, label="true")
    axes.plot(*one.poses[:, :2].T, color=DRIVEN, linewidth=0.8, label="as mapped")
    axes.set_title(one.result.world)
