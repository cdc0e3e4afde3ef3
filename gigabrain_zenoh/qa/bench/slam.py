"""SLAM over recorded logs: how good the maps are, and what they cost."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from msgspec import Struct

from gigabrain_zenoh.geometry.se2 import Floats, between, compose
from gigabrain_zenoh.host.posix import resource
from gigabrain_zenoh.mapping.slam import Estimate, Slam
from gigabrain_zenoh.qa.bench.figures import Figures, figures
from gigabrain_zenoh.qa.bench.slam_crispness import crispness
from gigabrain_zenoh.qa.bench.slam_logs import Errors, Log, errors, relations

COLD = 20  # scans before anything is timed

Progress = Callable[[], None]  # called after each scan


class LogResult(Struct, frozen=True, kw_only=True):
    """One log. Times are of the CPU, which is what a free core would take."""

    log: str
    scans: int
    beams: int
    keyframes: int
    loops: int
    relations: int
    odometry: Errors
    front_end: Errors
    graph: Errors
    crispness: float  # cells filled, per cell that the reference fills
    unmatched: int  # scans that were put where odometry or a search had them
    breaks: int  # in the sequence
    scan: Figures
    loop: Figures
    loop_max_ms: float


class SlamResult(Struct, frozen=True, kw_only=True):
    """All logs."""

    logs: tuple[LogResult, ...]
    mean_m: float  # of the graphs' errors, over the logs
    peak_mb: float  # of this process, with everything that it has imported


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """A log mapped."""

    slam: Slam
    estimates: list[Estimate]
    smooth: Floats  # (n, 3), where the front end alone puts the scans
    scan_ms: list[float]
    loop_ms: list[float]
    loops: int

    def poses(self) -> Floats:
        """Where the graph has put all scans in the end, (n, 3)."""
        keyframes = self.slam.poses[[estimate.keyframe for estimate in self.estimates]]
        return compose(keyframes, np.array([estimate.relative for estimate in self.estimates]))


def drive(log: Log, progress: Progress) -> Drive:
    """Map the log, loops being searched after each scan."""
    steps = between(log.odometry[:-1], log.odometry[1:])
    steps = np.concatenate((np.zeros((1, 3)), steps))
    slam, loops = Slam(), 0
    estimates: list[Estimate] = []
    smooth: list[Floats] = []
    scan_ms: list[float] = []
    loop_ms: list[float] = []
    for at, step in enumerate(steps):
        began = time.thread_time()
        estimates.append(slam.add(log.scan(at), step))
        scan_ms.append((time.thread_time() - began) * 1e3)
        smooth.append(slam.smooth)
        while slam.behind:
            began = time.thread_time()
            correction = slam.close_loops()
            loop_ms.append((time.thread_time() - began) * 1e3)
            if correction:
                slam.apply(correction)
                loops += len(correction.loops)
        progress()
    return Drive(
        slam=slam,
        estimates=estimates,
        smooth=np.array(smooth),
        scan_ms=scan_ms,
        loop_ms=loop_ms,
        loops=loops,
    )


def judged(log: Log, driven: Drive) -> LogResult:
    """What the drive is worth. Raises ConfigError for a log that passes no place twice."""
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
        scan=figures(driven.scan_ms[COLD:]),
        loop=figures(driven.loop_ms[COLD:]),
        loop_max_ms=max(driven.loop_ms[COLD:], default=0.0),
    )


def total(logs: list[LogResult]) -> SlamResult:
    """The logs together."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return SlamResult(
        logs=tuple(logs),
        mean_m=float(np.mean([log.graph.mean_m for log in logs])),
        peak_mb=peak / (1e6 if sys.platform == "darwin" else 1e3),
    )
