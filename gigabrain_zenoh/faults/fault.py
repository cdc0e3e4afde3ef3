"""What a fault test is: what it does, by what it is judged, and what came of it."""

import math
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple

from msgspec import Struct

from gigabrain_zenoh.errors import GigabrainError

if TYPE_CHECKING:
    from gigabrain_zenoh.faults.rig import Rig

Stage = Literal["sim", "auto", "line", "serial", "tcp", ""]
Verdict = Literal["passed", "FAILED", "skipped"]
Measured = Mapping[str, float]  # a figure for each limit of the criterion
Test = Callable[["Rig"], Awaitable[Measured]]

LIMIT = re.compile(r"(?P<name>[^<>]+?) <= (?P<at_most>\d+(\.\d+)?)( (?P<unit>\S+))?")


class Failed(GigabrainError):
    """The robot did not do what it promises, or what was waited for never came."""


class Skipped(GigabrainError):
    """The test cannot be run here; the text says why."""


class Limit(NamedTuple):
    """One figure that must not be exceeded."""

    name: str
    at_most: float
    unit: str


@dataclass(frozen=True)
class Fault:
    """One row of the table. Its test is the function of its name in the module of its group."""

    number: int
    name: str  # kebab-case
    group: str  # the module that holds it: process, deaths, body_link, network ...
    stage: Stage  # which running robot it needs; none for one that brings its own
    criterion: str  # `zero after <= 120 ms, travel <= 0.10 m`: what the test has to measure
    needs: tuple[str, ...] = ()  # root, netns, keys, recorder: what not every machine has

    @property
    def path(self) -> str:
        """Where its test is, as "module:name"."""
        return f"gigabrain_zenoh.faults.{self.group}:{self.name.replace('-', '_')}"

    @cached_property
    def limits(self) -> tuple[Limit, ...]:
        """The criterion, figure by figure."""
        return tuple(map(_limit, self.criterion.split(", ")))


def _limit(text: str) -> Limit:
    found = LIMIT.fullmatch(text)
    if not found:
        raise ValueError(f"{text!r} is no limit; expected one like 'travel <= 0.10 m'")
    return Limit(found["name"], float(found["at_most"]), found["unit"] or "")


class Result(Struct, frozen=True, kw_only=True):
    """What came of all runs of one fault test."""

    number: int
    name: str
    criterion: str
    verdict: Verdict
    reason: str = ""  # why it failed or was skipped
    worst: dict[str, float] = {}  # the greatest of all runs, by figure
    runs: int = 0
    seconds: float = 0.0  # of wall time, all runs together
    stalls: int = 0  # runs that were thrown away because this machine stood still meanwhile
    stall_ms: float = 0.0  # the longest that it stood still in a run that counts


def judge(fault: Fault, runs: list[Measured]) -> tuple[Verdict, str, dict[str, float]]:
    """Verdict, reason and the worst figures of several runs."""
    for measured in runs:
        if set(measured) != {limit.name for limit in fault.limits}:
            raise ValueError(f"{fault.name} is judged by {fault.criterion!r}, not by {measured}")
    worst = {
        limit.name: max((measured[limit.name] for measured in runs), key=_badness)
        for limit in fault.limits
    }
    missed = [limit for limit in fault.limits if not worst[limit.name] <= limit.at_most]
    reason = ", ".join(f"{name} is {worst[name]:g} {unit}".strip() for name, _, unit in missed)
    return ("FAILED" if missed else "passed"), reason, worst


def _badness(value: float) -> float:
    """What is no number is worse than any."""
    return math.inf if math.isnan(value) else value


def in_words(fault: Fault, worst: Mapping[str, float]) -> str:
    """`zero after 100 ms, travel 0.06 m`."""
    shown = (limit for limit in fault.limits if limit.name in worst)
    return ", ".join(f"{name} {worst[name]:.3g} {unit}".strip() for name, _, unit in shown)
