"""What a measurement came to, and how two of them compare."""

import statistics
from collections.abc import Sequence

from msgspec import Struct

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host.bounded import percentile


class Figures(Struct, frozen=True, kw_only=True):
    """Latencies of one run, or of several."""

    n: int  # how many were measured
    p50_ms: float
    p99_ms: float


def figures(times_ms: Sequence[float]) -> Figures:
    """The figures of single latencies [ms]. Raises GigabrainError when there are none."""
    ordered = sorted(times_ms)
    p50, p99 = percentile(ordered, 0.50), percentile(ordered, 0.99)
    if p50 is None or p99 is None:
        raise GigabrainError("nothing came back: there is nothing to measure")
    return Figures(n=len(ordered), p50_ms=p50, p99_ms=p99)


def over_rounds(rounds: Sequence[Figures]) -> Figures:
    """The median round, figure by figure: one round that others disturbed does not count."""
    return Figures(
        n=sum(one.n for one in rounds),
        p50_ms=statistics.median(one.p50_ms for one in rounds),
        p99_ms=statistics.median(one.p99_ms for one in rounds),
    )
