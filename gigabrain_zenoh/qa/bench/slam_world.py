"""SLAM in a simulated world against the physics' truth, on what perception itself calls."""

import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from msgspec import Struct

from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.se2 import Floats, between, compose, inverse
from gigabrain_zenoh.mapping.fusion import Fusion, Moment, way
from gigabrain_zenoh.mapping.growing import GrowingMap
from gigabrain_zenoh.perception.mapper import view_of
from gigabrain_zenoh.qa.bench.figures import Figures, figures
from gigabrain_zenoh.qa.bench.growth import Growth, Watch
from gigabrain_zenoh.runtime.services import rss_bytes

PATIENCE_S = 60.0  # so that a slow machine makes the same map
COLD = 20  # scans before anything is timed
TICKS_A_MINUTE = round(60e9 / TICK_NS)

Progress = Callable[[], None]  # called after each minute


class Off(Struct, frozen=True, kw_only=True):
    """How far poses are from the truth, both having begun in the same place."""

    mean_m: float
    max_m: float
    mean_deg: float
    max_deg: float


class WorldResult(Struct, frozen=True, kw_only=True):
    """One world. Times are of the CPU, which is what a free core would take."""

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
    fused: Off  # odometry with gyro
    slam: Off
    last_minute: Off
    scan: Figures
    growth: Growth  # of this process, simulation included


class WorldsResult(Struct, frozen=True, kw_only=True):
    """All worlds."""

    worlds: tuple[WorldResult, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Toured:
    """A world that was mapped, with all that it takes to draw it."""

    result: WorldResult
    grid: OccupancyGrid
    poses: Floats  # (n, 3), as mapped, in the map
    truth: Floats  # (n, 3), in the map


def tour(body: str, world: str, seed: int, minutes: float, progress: Progress) -> Toured:
    """Let the body roam the world for so long. Raises ConfigError."""
    from gigabrain_zenoh.qa.tour import Tour  # MuJoCo, which a bench of logs has no need of

    roaming = Tour(body, world, seed)
    if (lidar := roaming.body.lidar) is None:
        raise ConfigError(f"{body} has no lidar, and so makes no map")
    run = _Run(GrowingMap(PATIENCE_S))
    watch = Watch()
    for count, moment in enumerate(roaming.moments(round(minutes * TICKS_A_MINUTE)), 1):
        run.fusion.add(moment.state, roaming.body)
        if moment.scan:
            run.scan(lidar, moment.scan, np.array(moment.truth))
        if count % TICKS_A_MINUTE == 0:
            watch.minute(rss_bytes(), run.chart.grid())
            progress()
    if not len(run.poses):
        raise ConfigError(f"--minutes: {minutes:g} is too short for a scan")
    truth, report = roaming.simulation.truth, run.chart.report()
    grid = run.chart.grid()
    run.chart.close()
    poses, seen, fused = run.poses, run.in_map(), run.fused
    off = between(seen, poses)
    begun = compose(poses[0], inverse(fused[0]))
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
        fused=_off(between(seen, compose(begun, fused))),
        slam=_off(off),
        last_minute=_off(off[-600:]),
        scan=figures(run.took_ms[COLD:]),
        growth=watch.growth(grid),
    )
    return Toured(result=result, grid=grid, poses=poses, truth=seen)


class _Run:
    """What perception does with scans and states, and what came of it."""

    def __init__(self, chart: GrowingMap) -> None:
        self.chart, self.fusion, self.not_localized = chart, Fusion(), 0
        # flat, so that an hour of them is next to nothing in the memory that is measured
        self.took_ms, self._poses, self._fused = array("d"), array("d"), array("d")
        self._truth = array("d")  # in the world
        self._last: Moment | None = None

    def scan(self, lidar: Lidar, scan: LaserScan, truth: Floats) -> None:
        """One scan, taken at `truth` (3,)."""
        moment = self.fusion.at(scan.basis)
        if moment is None:
            return
        began = time.thread_time()
        view = view_of(lidar, scan, PerceptionConfig().ignore_below)
        place = self.chart.step(view, *way(self._last or moment, moment))
        self.took_ms.append((time.thread_time() - began) * 1e3)
        self._last = moment
        self.not_localized += not place.localized
        self._poses.extend(place.pose)
        self._fused.extend(moment.fused)
        self._truth.extend(truth)

    @property
    def poses(self) -> Floats:
        """As mapped (n, 3)."""
        return np.array(self._poses).reshape(-1, 3)

    @property
    def fused(self) -> Floats:
        """By odometry and gyro (n, 3)."""
        return np.array(self._fused).reshape(-1, 3)

    def in_map(self) -> Floats:
        """The truth (n, 3), as seen from where the map began."""
        truth = np.array(self._truth).reshape(-1, 3)
        return compose(compose(self.poses[0], inverse(truth[0])), truth)


def _off(off: Floats) -> Off:
    away, turn = np.hypot(off[:, 0], off[:, 1]), np.degrees(np.abs(off[:, 2]))
    return Off(
        mean_m=float(away.mean()),
        max_m=float(away.max()),
        mean_deg=float(turn.mean()),
        max_deg=float(turn.max()),
    )
