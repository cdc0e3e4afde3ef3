"""Figures, limits, verdicts and tables: what faults, benchmarks and driver checks are judged by."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

from msgspec import Struct

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host.bounded import percentile

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

Verdict = Literal["passed", "FAILED", "skipped"]
COLOURS: dict[Verdict, str] = {"passed": "green", "FAILED": "bold red", "skipped": "yellow"}


class Failed(GigabrainError):
    """The robot or driver broke a promise, or an awaited event never came."""


class Skipped(GigabrainError):
    """The test does not apply here; the text says why. Never counts as passed."""


@dataclass(frozen=True)
class Figure:
    """A measured quantity. Functions return values by figure, rows limit them by figure."""

    name: str
    unit: str = ""
    wall: bool = False  # in wall time, which grows on a busy or slow machine
    long: bool = False  # measured in the long form only

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


def worse_of(one: Measured, other: Measured) -> dict[Figure, float]:
    """Return all figures of both; the greater value where both have one."""
    return {
        figure: max(m[figure] for m in (one, other) if figure in m) for figure in {**one, **other}
    }


class Latencies(Struct, frozen=True, kw_only=True):
    """Latencies of one run, or of several."""

    n: int  # how many were measured
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
    """Return the median round, figure by figure, so that one disturbed round does not count."""
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
        table.add_column(Text(name), justify="left" if number < left else "right", no_wrap=True)
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
    times_ms: Mapping[str, float] = {}  # since the fault, of a check that can be repeated
    late_ms: float = 0.0  # by how much it missed a time, where nothing else is wrong


class CheckResult(NamedTuple):
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
