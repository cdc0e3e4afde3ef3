"""Figures, limits, verdicts and tables of faults, benchmarks and driver checks."""

import math
import statistics
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

from msgspec import Struct

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host.bounded import percentile

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from gigabrain_zenoh.qa.faults.rig import Rig

Verdict = Literal["passed", "FAILED", "skipped"]
COLOURS: dict[Verdict, str] = {"passed": "green", "FAILED": "bold red", "skipped": "yellow"}
Stage = Literal["sim", "auto", "line", "serial", "tcp", "arm", ""]


class Failed(GigabrainError):
    """The robot or driver broke a promise, or an expected event did not happen."""


class Skipped(GigabrainError):
    """The test does not apply here; the text is the reason. It never counts as passed."""


@dataclass(frozen=True)
class Figure:
    """A measured quantity: the key for measured values and their limits."""

    name: str
    unit: str = ""
    wall: bool = False  # wall time, which grows on a busy or slow machine
    long: bool = False  # measured only in the long form of a test

    def at_most(self, value: float) -> "Limit":
        """Return the limit `value` [unit] of this figure."""
        return Limit(self, value)


class Limit(NamedTuple):
    """A figure and the value that it must not exceed."""

    figure: Figure
    at_most: float

    def __str__(self) -> str:
        words = f"{self.figure.name} <= {self.at_most:g} {self.figure.unit}".rstrip()
        return words + " wall" * self.figure.wall + " long" * self.figure.long

    def allows(self, value: float) -> bool:
        """Return whether `value` is within the limit; NaN never is."""
        return value <= self.at_most


Measured = Mapping[Figure, float]
FaultTest = Callable[["Rig"], Awaitable[Measured]]


def coloured(verdict: Verdict) -> str:
    """Return a verdict with its colour, as markup."""
    return f"[{COLOURS[verdict]}]{verdict}[/]"


def worse_of(one: Measured, other: Measured) -> dict[Figure, float]:
    """Return the figures of both; the larger value if both have one."""
    return {
        figure: max(m[figure] for m in (one, other) if figure in m) for figure in {**one, **other}
    }


class Latencies(Struct, frozen=True, kw_only=True):
    """Latencies of one run, or of several."""

    n: int  # number of measured latencies
    p50_ms: float
    p99_ms: float


def latencies(times_ms: Sequence[float]) -> Latencies:
    """Summarize single latencies [ms]. Raises GigabrainError when there are none."""
    ordered = sorted(times_ms)
    p50, p99 = percentile(ordered, 0.50), percentile(ordered, 0.99)
    if p50 is None or p99 is None:
        raise GigabrainError("nothing came back: there is nothing to measure")
    return Latencies(n=len(ordered), p50_ms=p50, p99_ms=p99)


def over_rounds(rounds: Sequence[Latencies]) -> Latencies:
    """Return the median over rounds for each figure, so that a disturbed round does not count."""
    return Latencies(
        n=sum(one.n for one in rounds),
        p50_ms=statistics.median(one.p50_ms for one in rounds),
        p99_ms=statistics.median(one.p99_ms for one in rounds),
    )


def table_of(*columns: str, title: str | None = None, left: int = 1) -> "Table":
    """Return an empty table whose first `left` columns hold text and the others figures."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title)
    for number, name in enumerate(columns):
        is_text = number < left  # headers of figures may take two lines
        table.add_column(Text(name), justify="left" if is_text else "right", no_wrap=is_text)
    return table


def limited(value: float, at_most: float, digits: int) -> "Text":
    """Return `1.40 (≤ 1.5)`, green within the limit and yellow beyond it."""
    from rich.text import Text

    style = "green" if value <= at_most else "yellow"
    return Text(f"{value:.{digits}f} (≤ {at_most:g})", style=style)


class Finding(NamedTuple):
    """The outcome of one run of a driver check."""

    ok: bool
    measured: str
    times_ms: Mapping[str, float] = {}  # since the fault, for a repeatable check
    late_ms: float = 0.0  # excess over a time limit, if nothing else is wrong


class DriverCheckResult(NamedTuple):
    """One line of a driver's table."""

    check: str
    criterion: str
    measured: str
    verdict: Verdict


def summary(findings: Sequence[Finding]) -> str:
    """Return the worst and the median of each time, over repetitions of one check."""
    if len(findings) == 1:
        return findings[0].measured
    bad = [finding for finding in findings if not finding.ok]
    times = [_spread(name, findings) for name in findings[0].times_ms]
    worst = f"worst of {len(findings)}: {'; '.join(times)}"
    return f"failed {len(bad)} times: {bad[0].measured}; {worst}" if bad else worst


def _spread(name: str, findings: Sequence[Finding]) -> str:
    times = [finding.times_ms[name] for finding in findings if name in finding.times_ms]
    return f"{name} after {max(times):.0f}, median {statistics.median(times):.0f} ms"


@dataclass(frozen=True)
class FaultRow:
    """One row of the fault suite."""

    number: int
    test: FaultTest
    stage: Stage  # shared robot that it needs; empty for a test that boots its own
    limits: tuple[Limit, ...]
    needs: tuple[str, ...] = ()  # optional extras: keys, recorder, nav
    loads: bool = False  # True if the fault itself keeps the cores busy

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


def fault_row(
    number: int, stage: Stage, *limits: Limit, needs: tuple[str, ...] = (), loads: bool = False
) -> Callable[[FaultTest], FaultRow]:
    """Make the decorated function a row. The suite finds all rows in the package `rows`."""

    def row(test: FaultTest) -> FaultRow:
        return FaultRow(number, test, stage, limits, needs, loads)

    return row


class FaultRun(Struct, frozen=True, kw_only=True):
    """One run of a fault test."""

    verdict: Verdict
    reason: str = ""  # why it failed or was skipped
    measured: dict[str, float] = {}
    waited_ms: float = 0.0  # longest wait of a thread of the robot for a core, per 0.1 s
    disturbed: bool = False  # True if that wait was too long for the run to count
    seconds: float = 0.0  # of wall time


class FaultResult(Struct, frozen=True, kw_only=True):
    """The verdict over all runs of a fault test."""

    number: int
    name: str
    criterion: str
    verdict: Verdict
    reason: str = ""  # why it failed or was skipped
    worst: dict[str, float] = {}  # the largest value of all counted runs, by figure
    tries: tuple[FaultRun, ...] = ()


def conclude(row: FaultRow, runs: Sequence[FaultRun]) -> FaultResult:
    """Judge the undisturbed runs; if there are none, judge all."""
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
    """Return a run's verdict and the reason of a failure; `wall` includes wall-time figures."""
    limits = [limit for limit in row.limits if long or not limit.figure.long]
    if set(measured) != {limit.figure for limit in limits}:
        raise ValueError(f"{row.name} is judged by {row.criterion!r}, not by {measured}")
    judged = [limit for limit in limits if wall or not limit.figure.wall]
    missed = [limit.figure for limit in judged if not limit.allows(measured[limit.figure])]
    reason = ", ".join(f"{one.name} is {measured[one]:g} {one.unit}".strip() for one in missed)
    return ("FAILED" if missed else "passed"), reason


def worst_of(row: FaultRow, runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the largest value of each figure, by name; NaN is worse than any number."""
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
