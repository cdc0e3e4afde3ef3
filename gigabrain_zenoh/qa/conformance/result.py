"""What a check found."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

Verdict = Literal["pass", "fail", "n/a"]


class NotApplicable(Exception):
    """The check says nothing about this link; the text says why. Never counted as passed."""


class Failed(Exception):
    """The driver did not come as far as the check needs; the text says where it stopped."""


class Finding(NamedTuple):
    """What was measured, and whether that is good enough."""

    ok: bool
    measured: str
    times_ms: Mapping[str, float] = {}  # from the fault on, of a check that can be repeated
    late_ms: float = 0.0  # by how much it missed a time, where nothing else is wrong


class Result(NamedTuple):
    """One line of the table."""

    check: str
    criterion: str
    measured: str
    verdict: Verdict


def summary(findings: Sequence[Finding]) -> str:
    """What several repetitions of one check found: the worst and the median of each time."""
    if len(findings) == 1:
        return findings[0].measured
    bad = [finding for finding in findings if not finding.ok]
    told = [_spread(name, findings) for name in findings[0].times_ms]
    worst = f"worst of {len(findings)}: {'; '.join(told)}"
    return f"{len(bad)} times not so: {bad[0].measured}; {worst}" if bad else worst


def _spread(name: str, findings: Sequence[Finding]) -> str:
    """The worst and the median of those that have this time."""
    times = [finding.times_ms[name] for finding in findings if name in finding.times_ms]
    return f"{name} after {max(times):.0f}, median {statistics.median(times):.0f} ms"
