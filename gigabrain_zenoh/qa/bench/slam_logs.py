"""`gigabrain bench slam --log`: maps recorded laser logs, and compares them with reference poses.

R. Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 2009: the
relative poses of nearby scans are compared, not the poses themselves. The reference of some logs is
partly wrong, so crispness judges a map by its own scans: a wall that is drawn twice fills twice as
many cells.
"""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.se2 import between, compose, inverse, transform
from gigabrain_zenoh.host.posix import resource
from gigabrain_zenoh.mapping import map_file
from gigabrain_zenoh.mapping.keyframes import Scan, from_beams
from gigabrain_zenoh.mapping.slam import Estimate, Slam
from gigabrain_zenoh.qa.judging import Latencies, latencies

T = TypeVar("T")
RANGE_MIN, RANGE_MAX = 0.1, 25.0  # [m], of valid beams
NEAR_M = 3.0  # largest distance of the two poses of a relation
DENSE_M = 0.3  # a log with a smaller median step is dense
GAP, DENSE_GAP = 30, 300  # least number of scans between the poses of a relation
MAX_RELATIONS = 2000
SEED = 0
FIELDS = ("ranges", "ref", "odom")


@dataclass(frozen=True, slots=True)
class LaserLog:
    """Scans and odometry in the order of recording, and corrected reference poses."""

    name: str
    ranges: Floats  # [m], (n, beams)
    reference: Floats  # (n, 3)
    odometry: Floats  # (n, 3)

    def scan(self, at: int) -> Scan:
        """Return one scan; beam i points to -90° + i 180°/beams."""
        beams = self.ranges.shape[1]
        angles = np.radians(-90.0 + np.arange(beams) * 180.0 / beams)
        return from_beams(angles, self.ranges[at], RANGE_MIN, RANGE_MAX)


class RelationErrors(Struct, frozen=True, kw_only=True):
    """Errors of relations against the reference."""

    mean_m: float
    std_m: float
    mean_deg: float
    std_deg: float


def load(path: Path) -> LaserLog:
    """Load an .npz file: `ranges` [cm], `ref` and `odom`. Raises ConfigError."""
    arrays = map_file.read_arrays(path, "no laser log")
    if missing := set(FIELDS) - arrays.keys():
        raise ConfigError(f"{path}: no {', '.join(sorted(missing))}; expected {', '.join(FIELDS)}")
    ranges, reference, odometry = (arrays[name] for name in FIELDS)
    count = len(ranges) if ranges.ndim == 2 else 0
    if count < 2 or ranges.shape[1] < 2 or not np.issubdtype(ranges.dtype, np.integer):
        raise ConfigError(f"{path}: ranges: expected whole centimetres, (scans, beams)")
    for name, poses in (("ref", reference), ("odom", odometry)):
        if poses.shape != (count, 3) or not np.issubdtype(poses.dtype, np.floating):
            raise ConfigError(f"{path}: {name}: expected poses of shape ({count}, 3)")
    return LaserLog(path.stem, ranges / 100.0, reference.astype(float), odometry.astype(float))


def relations(log: LaserLog, seed: int = SEED) -> NDArray[np.intp]:
    """Return pairs of scans (k, 2) at places passed twice. Raises ConfigError without any."""
    places = log.reference[:, :2]
    step = float(np.median(np.hypot(*np.diff(places, axis=0).T)))
    gap = DENSE_GAP if step < DENSE_M else GAP
    pairs = [
        np.column_stack((np.full_like(later, first), later))
        for first in range(len(places) - gap - 1)
        if len(later := _near(places, first, first + gap + 1))
    ]
    if not pairs:
        raise ConfigError(f"{log.name}: no place is passed twice, so there is nothing to compare")
    every = np.concatenate(pairs)
    if len(every) <= MAX_RELATIONS:
        return every
    return every[np.random.default_rng(seed).choice(len(every), MAX_RELATIONS, replace=False)]


def _near(places: Floats, first: int, start: int) -> NDArray[np.intp]:
    away = np.hypot(*(places[start:] - places[first]).T)
    return np.flatnonzero(away < NEAR_M) + start


def errors(log: LaserLog, poses: Floats, pairs: NDArray[np.intp]) -> RelationErrors:
    """Return the errors of `poses` (n, 3) over `pairs` (k, 2) of scans."""
    first, second = pairs.T
    wanted = between(log.reference[first], log.reference[second])
    off = between(wanted, between(poses[first], poses[second]))
    away, turn = np.hypot(off[:, 0], off[:, 1]), np.degrees(np.abs(off[:, 2]))
    return RelationErrors(
        mean_m=float(away.mean()),
        std_m=float(away.std()),
        mean_deg=float(turn.mean()),
        std_deg=float(turn.std()),
    )


def laid_onto(poses: Floats, reference: Floats) -> Floats:
    """Return `poses` (n, 3) after the rigid motion that fits them best to `reference` (Umeyama)."""
    one, other = poses[:, :2], reference[:, :2]
    spread = (one - one.mean(axis=0)).T @ (other - other.mean(axis=0))
    turn = float(np.arctan2(spread[0, 1] - spread[1, 0], spread[0, 0] + spread[1, 1]))
    about = np.array((*one.mean(axis=0), 0.0))
    return compose(np.array((*other.mean(axis=0), turn)), compose(inverse(about), poses))


CELL_M = 0.1
NEAREST, FARTHEST = 0.3, 15.0  # [m], ranges of hits that count
GRID_TURNS = 8  # spread over a right angle, as the result of a single one errs by 3 %
KEY = 1 << 20  # cells per row (100 km), to number cells


def crispness(log: LaserLog, poses: Floats) -> float:
    """Return the ratio of filled cells at `poses` (n, 3) to those at the log's reference poses.

    First, a rigid motion fits `poses` to the reference. Below 1 is crisper than the reference. The
    ratio is the mean over turns of the grid.
    """
    bodies = [hits(log, at) for at in range(len(log.ranges))]
    turns: Floats = np.linspace(0, np.pi / 2, GRID_TURNS, endpoint=False)
    ours = cells_filled(bodies, laid_onto(poses, log.reference), turns)
    reference = cells_filled(bodies, log.reference, turns)
    return float(np.mean(ours / reference))


def hits(log: LaserLog, at: int) -> Floats:
    """Return the hits of one scan (n, 2) [m] in the body's frame, within the ranges that count."""
    points = log.scan(at).points.astype(np.float64)
    away = np.hypot(*points.T)
    return np.asarray(points[(away > NEAREST) & (away < FARTHEST)])


def cells_filled(bodies: list[Floats], poses: Floats, turns: Floats) -> Floats:
    """Return the number of cells that the scans fill at `poses` (n, 3), for each turn [rad]."""
    return np.array(
        [_count_filled(bodies, compose(np.array((0, 0, turn)), poses)) for turn in turns]
    )


def _count_filled(bodies: list[Floats], poses: Floats) -> float:
    counts = np.array([len(body) for body in bodies])
    points = np.concatenate(bodies)
    x, y, yaw = np.repeat(poses, counts, axis=0).T
    cos, sin = np.cos(yaw), np.sin(yaw)
    columns = np.floor((x + cos * points[:, 0] - sin * points[:, 1]) / CELL_M).astype(np.int64)
    rows = np.floor((y + sin * points[:, 0] + cos * points[:, 1]) / CELL_M).astype(np.int64)
    return float(len(np.unique(rows * KEY + columns)))


COLD_SCANS = 20  # without timing, at the start

Progress = Callable[[], None]  # called after each scan


class LogResult(Struct, frozen=True, kw_only=True):
    """Figures of one log. Times are CPU times."""

    log: str
    scans: int
    beams: int
    keyframes: int
    loops: int
    relations: int
    odometry: RelationErrors
    front_end: RelationErrors
    graph: RelationErrors
    crispness: float  # filled cells, as a ratio to the reference's
    unmatched: int  # scans that were placed by odometry or by a search
    breaks: int  # scans without a connection to the one before
    scan: Latencies
    loop: Latencies
    loop_max_ms: float


class SlamResult(Struct, frozen=True, kw_only=True):
    """Figures of all logs."""

    logs: tuple[LogResult, ...]
    mean_m: float  # mean of the graphs' errors over the logs
    peak_mb: float  # memory of this process, with its imports


@dataclass(frozen=True, slots=True, kw_only=True)
class MappedLog:
    """A log's map and poses, and the CPU times to make them."""

    slam: Slam
    estimates: list[Estimate]
    smooth: Floats  # (n, 3), poses of the front end alone
    scan_ms: list[float]
    loop_ms: list[float]
    loops: int

    def poses(self) -> Floats:
        """Return the poses of all scans in the final graph (n, 3)."""
        keyframes = self.slam.poses[[estimate.keyframe for estimate in self.estimates]]
        return compose(keyframes, np.array([estimate.relative for estimate in self.estimates]))


def map_log(log: LaserLog, progress: Progress) -> MappedLog:
    """Map the log, and search loops after each scan."""
    steps = between(log.odometry[:-1], log.odometry[1:])
    steps = np.concatenate((np.zeros((1, 3)), steps))
    slam, loops = Slam(), 0
    estimates: list[Estimate] = []
    smooth: list[Floats] = []
    scan_ms: list[float] = []
    loop_ms: list[float] = []
    for at, step in enumerate(steps):
        begin_s = time.thread_time()
        estimates.append(slam.add(log.scan(at), step))
        scan_ms.append((time.thread_time() - begin_s) * 1e3)
        smooth.append(slam.smooth)
        while slam.behind:
            begin_s = time.thread_time()
            correction = slam.close_loops()
            loop_ms.append((time.thread_time() - begin_s) * 1e3)
            if correction:
                slam.apply(correction)
                loops += len(correction.loops)
        progress()
    return MappedLog(
        slam=slam,
        estimates=estimates,
        smooth=np.array(smooth),
        scan_ms=scan_ms,
        loop_ms=loop_ms,
        loops=loops,
    )


def judge_log(log: LaserLog, driven: MappedLog) -> LogResult:
    """Judge the map of a log. Raises ConfigError if the log passes no place twice."""
    pairs, poses = relations(log), driven.poses()
    kinds = [estimate.kind for estimate in driven.estimates]
    return LogResult(
        log=log.name,
        scans=len(log.ranges),
        beams=log.ranges.shape[1],
        keyframes=len(driven.slam.keyframes),
        loops=driven.loops,
        relations=len(pairs),
        odometry=errors(log, log.odometry, pairs),
        front_end=errors(log, driven.smooth, pairs),
        graph=errors(log, poses, pairs),
        crispness=crispness(log, poses),
        unmatched=sum(kind in ("odometry", "searched") for kind in kinds),
        breaks=kinds.count("broken"),
        scan=latencies(driven.scan_ms[COLD_SCANS:]),
        loop=latencies(driven.loop_ms[COLD_SCANS:]),
        loop_max_ms=max(driven.loop_ms[COLD_SCANS:], default=0.0),
    )


def total(logs: list[LogResult]) -> SlamResult:
    """Return the figures of all logs together."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return SlamResult(
        logs=tuple(logs),
        mean_m=float(np.mean([log.graph.mean_m for log in logs])),
        peak_mb=peak / (1e6 if sys.platform == "darwin" else 1e3),
    )


if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIDE_INCHES = 7.0  # of each map
DOTS_PER_INCH = 130
WALLS, DRIVEN, REFERENCE = "#1d2733", "#d9480f", "#1c7ed6"


def draw_side_by_side(
    items: Sequence[T], columns: int, draw: Callable[["Axes", T], None], to: Path
) -> None:
    """Draw each item into its own picture in a PNG file. Raises ConfigError."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ConfigError(
            "pictures need matplotlib: pip install 'gigabrain-zenoh[record]'"
        ) from None
    rows = -(-len(items) // columns)
    figure = Figure(figsize=(SIDE_INCHES * columns, SIDE_INCHES * rows), layout="constrained")
    cells = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes, item in zip(cells, items, strict=False):
        draw(axes, item)
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        axes.legend(loc="best")
    for axes in cells[len(items) :]:
        axes.set_axis_off()
    try:
        figure.savefig(to, format="png", dpi=DOTS_PER_INCH)
    except OSError as error:
        raise ConfigError(f"cannot write {to}: {error.strerror}") from None


def draw_logs(drives: Sequence[tuple[LaserLog, MappedLog]], to: Path) -> None:
    """Draw each map with its path, two per row. Raises ConfigError."""
    draw_side_by_side(drives, min(len(drives), 2), _draw_log, to)


def _draw_log(axes: "Axes", drive: tuple[LaserLog, MappedLog]) -> None:
    log, driven = drive
    keyframes = zip(driven.slam.poses, driven.slam.keyframes, strict=True)
    walls = np.concatenate([transform(pose, keyframe.points) for pose, keyframe in keyframes])
    poses = driven.poses()
    reference = laid_onto(log.reference, poses)
    axes.plot(*walls.T, ",", color=WALLS, alpha=0.3)
    axes.plot(*reference[:, :2].T, color=REFERENCE, linewidth=1.2, label="reference")
    axes.plot(*poses[:, :2].T, color=DRIVEN, linewidth=0.8, label="as mapped")
    axes.set_title(log.name)
    axes.set_aspect("equal")
