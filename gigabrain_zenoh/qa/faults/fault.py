"""A fault row: what breaks, by which limits it is judged, and the results of its runs."""

import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from msgspec import Struct

from gigabrain_zenoh.qa.judging import Limit, Measured, Verdict

if TYPE_CHECKING:
    from gigabrain_zenoh.qa.faults.rig.rig import Rig

Stage = Literal["sim", "auto", "line", "serial", "tcp", ""]
FaultTest = Callable[["Rig"], Awaitable[Measured]]


@dataclass(frozen=True)
class FaultRow:
    """One row of the fault suite."""

    number: int
    test: FaultTest
    stage: Stage  # which shared robot it needs; none for a test that boots its own
    limits: tuple[Limit, ...]
    needs: tuple[str, ...] = ()  # keys, recorder, nav: extras that may be missing
    loads: bool = False  # the fault itself keeps the cores busy

    @property
    def name(self) -> str:
        """The test's name with dashes."""
        return self.test.__name__.replace("_", "-")

    @property
    def group(self) -> str:
        """The module of the test."""
        return self.test.__module__.rpartition(".")[2].replace("_", " ")

    @property
    def criterion(self) -> str:
        """All limits in words: `brakes after <= 120 ms, travel <= 0.1 m`."""
        return ", ".join(map(str, self.limits))


class FaultRun(Struct, frozen=True, kw_only=True):
    """One run of a fault test."""

    verdict: Verdict
    reason: str = ""  # why it failed or was skipped
    measured: dict[str, float] = {}
    waited_ms: float = 0.0  # longest wait of one of the robot's threads for a core, within 0.1 s
    disturbed: bool = False  # it waited so long that the run does not count, passed or failed
    seconds: float = 0.0  # of wall time


class FaultResult(Struct, frozen=True, kw_only=True):
    """The verdict over all runs of a fault test."""

    number: int
    name: str
    criterion: str
    verdict: Verdict
    reason: str = ""  # why it failed or was skipped
    worst: dict[str, float] = {}  # the greatest of all runs that count, by figure
    tries: tuple[FaultRun, ...] = ()

    @property
    def seconds(self) -> float:
        """Wall time of all runs together [s]."""
        return sum(one.seconds for one in self.tries)


def conclude(row: FaultRow, runs: Sequence[FaultRun]) -> FaultResult:
    """Judge the undisturbed runs; all of them where each was disturbed."""
    counted = [one for one in runs if not one.disturbed] or list(runs)
    decisive = next((one for one in counted if one.verdict != "passed"), counted[-1])
    measured = [one.measured for one in counted if one.measured]
    return FaultResult(
        number=row.number,
        name=row.name,
        criterion=row.criterion,
        verdict=decisive.verdict,
        reason=decisive.reason,
        worst=worst_of(row, measured) if measured else {},
        tries=tuple(runs),
    )


def judge(
    row: FaultRow, measured: Measured, *, wall: bool = True, long: bool = False
) -> tuple[Verdict, str]:
    """Return the verdict on one run, and why it failed; without `wall`, not by the wall clock."""
    limits = [limit for limit in row.limits if long or not limit.figure.long]
    if set(measured) != {limit.figure for limit in limits}:
        raise ValueError(f"{row.name} is judged by {row.criterion!r}, not by {measured}")
    judged = [limit for limit in limits if wall or not limit.figure.wall]
    missed = [limit.figure for limit in judged if not limit.allows(measured[limit.figure])]
    reason = ", ".join(f"{one.name} is {measured[one]:g} {one.unit}".strip() for one in missed)
    return ("FAILED" if missed else "passed"), reason


def worst_of(row: FaultRow, runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the greatest value of each figure, by name; NaN is worse than any number."""
    names = [limit.figure.name for limit in row.limits]
    return {
        name: max((run[name] for run in runs if name in run), key=_badness)
        for name in names
        if any(name in run for run in runs)
    }


def _badness(value: float) -> float:
    return math.inf if math.isnan(value) else value


def in_words(row: FaultRow, worst: Mapping[str, float]) -> str:
    """Return `brakes after 5 ticks, travel 0.06 m`."""
    shown = (limit.figure for limit in row.limits if limit.figure.name in worst)
    return ", ".join(f"{one.name} {worst[one.name]:.3g} {one.unit}".strip() for one in shown)
