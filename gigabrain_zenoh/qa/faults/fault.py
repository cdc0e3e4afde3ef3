"""What a fault test is: what it does, by what it is judged, and what came of it."""

import math
import re
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple

from msgspec import Struct

from gigabrain_zenoh.errors import GigabrainError

if TYPE_CHECKING:
    from gigabrain_zenoh.qa.faults.rig import Rig

Stage = Literal["sim", "auto", "line", "serial", "tcp", ""]
Verdict = Literal["passed", "FAILED", "skipped"]
Measured = Mapping[str, float]  # a figure for each limit of the criterion
Test = Callable[["Rig"], Awaitable[Measured]]

LIMIT = re.compile(
    r"(?P<name>[^<>]+?) <= (?P<at_most>\d+(\.\d+)?)"
    r"(?: (?P<unit>(?!wall|long)\S+))?(?P<wall> wall)?(?P<long> long)?"
)


class Failed(GigabrainError):
    """The robot did not do what it promises, or what was waited for never came."""


class Skipped(GigabrainError):
    """The test cannot be run here; the text says why."""


class Limit(NamedTuple):
    """One figure that must not be exceeded."""

    name: str
    at_most: float
    unit: str
    wall: bool = False  # of wall time, which a busy or slow machine makes more
    long: bool = False  # measured in the long form only


@dataclass(frozen=True)
class Fault:
    """One row of the table. Its test is the function of its name in the module of its group."""

    number: int
    name: str  # kebab-case
    group: str  # the module that holds it: process, deaths, body_link, network ...
    stage: Stage  # which running robot it needs; none for one that brings its own
    criterion: str  # `brakes after <= 6 ticks, travel <= 0.1 m`: what the test has to measure
    needs: tuple[str, ...] = ()  # root, netns, keys, recorder: what not every machine has
    loads: bool = False  # the fault itself keeps the cores busy, so waiting for one is part of it

    @property
    def path(self) -> str:
        """Where its test is, as "module:name"."""
        return f"gigabrain_zenoh.qa.faults.{self.group}:{self.name.replace('-', '_')}"

    @cached_property
    def limits(self) -> tuple[Limit, ...]:
        """The criterion, figure by figure."""
        return tuple(map(_limit, self.criterion.split(", ")))


def _limit(text: str) -> Limit:
    found = LIMIT.fullmatch(text)
    if not found:
        raise ValueError(f"{text!r} is no limit; expected one like 'travel <= 0.10 m'")
    unit, wall, long = found["unit"] or "", bool(found["wall"]), bool(found["long"])
    return Limit(found["name"], float(found["at_most"]), unit, wall, long)


class Try(Struct, frozen=True, kw_only=True):
    """One run of one fault test."""

    verdict: Verdict
    reason: str = ""  # why it failed or was skipped
    measured: dict[str, float] = {}
    waited_ms: float = 0.0  # the longest that a thread of the robot waited for a core, in 0.1 s
    disturbed: bool = False  # it waited for so long that the run says nothing, passed or failed
    seconds: float = 0.0  # of wall time


class Result(Struct, frozen=True, kw_only=True):
    """What came of all runs of one fault test."""

    number: int
    name: str
    criterion: str
    verdict: Verdict
    reason: str = ""  # why it failed or was skipped
    worst: dict[str, float] = {}  # the greatest of all runs that count, by figure
    tries: tuple[Try, ...] = ()

    @property
    def seconds(self) -> float:
        """Wall time of all runs together [s]."""
        return sum(one.seconds for one in self.tries)


def conclude(fault: Fault, tries: Sequence[Try]) -> Result:
    """Judge the runs that were not disturbed; all of them where each was."""
    counted = [one for one in tries if not one.disturbed] or list(tries)
    decisive = next((one for one in counted if one.verdict != "passed"), counted[-1])
    measured = [one.measured for one in counted if one.measured]
    return Result(
        number=fault.number,
        name=fault.name,
        criterion=fault.criterion,
        verdict=decisive.verdict,
        reason=decisive.reason,
        worst=worst_of(fault, measured) if measured else {},
        tries=tuple(tries),
    )


def judge(
    fault: Fault, measured: Measured, *, wall: bool = True, long: bool = False
) -> tuple[Verdict, str]:
    """Return the verdict on one run, and why it failed; without `wall`, not by the wall clock."""
    limits = [limit for limit in fault.limits if long or not limit.long]
    if set(measured) != {limit.name for limit in limits}:
        raise ValueError(f"{fault.name} is judged by {fault.criterion!r}, not by {measured}")
    judged = [limit for limit in limits if wall or not limit.wall]
    missed = [limit for limit in judged if not measured[limit.name] <= limit.at_most]
    reason = ", ".join(f"{one.name} is {measured[one.name]:g} {one.unit}".strip() for one in missed)
    return ("FAILED" if missed else "passed"), reason


def worst_of(fault: Fault, runs: Sequence[Measured]) -> dict[str, float]:
    """Return the greatest of each figure."""
    return {
        limit.name: max((measured[limit.name] for measured in runs), key=_badness)
        for limit in fault.limits
        if limit.name in runs[0]
    }


def _badness(value: float) -> float:
    """What is no number is worse than any."""
    return math.inf if math.isnan(value) else value


def in_words(fault: Fault, worst: Mapping[str, float]) -> str:
    """`brakes after 5 ticks, travel 0.06 m`."""
    shown = (limit for limit in fault.limits if limit.name in worst)
    return ", ".join(f"{one.name} {worst[one.name]:.3g} {one.unit}".strip() for one in shown)
