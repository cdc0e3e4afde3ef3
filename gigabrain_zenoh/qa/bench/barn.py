"""BARN and DynaBARN: many worlds, many trials, and what they come to."""

import gc
import statistics
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from msgspec import Struct

from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.navigation import local
from gigabrain_zenoh.qa.bench import barn_drive, barn_nodes
from gigabrain_zenoh.qa.bench.barn_worlds import World
from gigabrain_zenoh.qa.bench.course import Trial
from gigabrain_zenoh.qa.bench.plant import HARD, IDEAL, JACKAL, MUJOCO, Conditions

PLANTS = {"hard": HARD, "ideal": IDEAL, "mujoco": MUJOCO}


class BarnResult(Struct, frozen=True, kw_only=True):
    """All trials, and their means."""

    plant: Conditions
    samples: int  # plans per cycle
    trials: tuple[Trial, ...]

    def share(self, result: str) -> float:
        """Of the trials, how many ended so."""
        return sum(one.result == result for one in self.trials) / len(self.trials)

    @property
    def score(self) -> float:
        """By the rules of 2024 and later, 0.5 at most."""
        return statistics.fmean(one.score for one in self.trials)

    @property
    def seconds(self) -> float | None:
        """Mean time of those that arrived, unclipped."""
        times = [one.seconds for one in self.trials if one.result == "success"]
        return statistics.fmean(times) if times else None

    @property
    def clearances(self) -> tuple[float, float]:
        """Smallest and median of each trial's least clearance [m]."""
        least = [one.least_clearance for one in self.trials]
        return min(least), statistics.median(least)

    def cycle_ms(self, share: float) -> float | None:
        """Percentile of what planning took."""
        return percentile(sorted(ms for one in self.trials for ms in one.cycles_ms), share)


def measure_barn(
    worlds: Iterable[World],
    trials: int,
    plant: str,
    samples: int,
    jobs: int,
    progress: Callable[[Trial], None],
    *,
    nodes: bool,
) -> BarnResult:
    """Drive `trials` times in each of `worlds`, in so many processes.

    With the robot's own `nodes`, or with the functions that they call.
    """
    drive = barn_nodes.drive if nodes else barn_drive.drive
    done = []
    with ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_get_ready) as pool:
        waiting = [
            pool.submit(drive, world, trial, PLANTS[plant], samples)
            for world in worlds
            for trial in range(trials)
        ]
        for one in as_completed(waiting):
            done.append(one.result())
            progress(done[-1])
    done.sort(key=lambda one: (one.world, one.trial))
    return BarnResult(plant=PLANTS[plant], samples=samples, trials=tuple(done))


def _get_ready() -> None:
    """As a robot's process before it drives: all is compiled, and what is there no garbage."""
    local.warm_up(JACKAL)
    gc.collect()
    gc.freeze()
