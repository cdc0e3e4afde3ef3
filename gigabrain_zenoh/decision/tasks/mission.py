"""Missions: a YAML file becomes a behaviour tree of frozen Structs, or one line says why not."""

from typing import Annotated

from msgspec import Meta, Struct

from gigabrain_schemas.base import Finite, Name, Percentage
from gigabrain_schemas.tasks import Goal

Point = Annotated[tuple[Finite, ...], Meta(min_length=2, max_length=3)]  # [m], [m], [rad]
Place = Name | Point
Steps = Annotated[tuple["Step", ...], Meta(min_length=1)]
Seconds = Annotated[float, Meta(gt=0, le=1e7)]
MOST_LOOPS = 1_000_000
Times = Annotated[int, Meta(ge=1, le=MOST_LOOPS)]
Comparison = Annotated[str, Meta(max_length=200)]  # see conditions.py
KINDS = (
    "goto", "patrol", "explore", "visit", "wait", "wait_until", "check", "script", "tree",
    "sequence", "fallback", "retry", "repeat", "timeout", "guard", "battery_below",
)  # fmt: skip


class Part(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A part of a mission file."""


class Patrol(Part, frozen=True, kw_only=True):
    """One place after the other, over and over."""

    points: Annotated[tuple[Place, ...], Meta(min_length=1, max_length=1000)]
    loops: Times | None = None  # None: for ever
    wait: Annotated[float, Meta(ge=0, le=1e7)] = 0.0  # [s] at each


class Explore(Part, frozen=True, kw_only=True):
    """Drive until nothing is left to be seen."""


class Visit(Part, frozen=True, kw_only=True):
    """Drive to a place that can be reached, chosen at random."""


class Script(Part, frozen=True, kw_only=True):
    """Run a program of the host, out of the folder that its deployment file allows."""

    run: Name  # its file name
    arguments: tuple[Name, ...] = ()
    seconds: Seconds = 60.0  # after which it is ended, which is a failure


class Retry(Part, frozen=True, kw_only=True):
    """Try again when it has failed."""

    times: Times  # attempts in all
    do: Steps


class Repeat(Part, frozen=True, kw_only=True):
    """Do it again when it has succeeded."""

    times: Times | None = None  # None: for ever
    do: Steps


class Timeout(Part, frozen=True, kw_only=True):
    """Fail when it takes longer."""

    seconds: Seconds
    do: Steps


class Guard(Part, frozen=True, kw_only=True):
    """Do something else first whenever a condition holds, then go on where it was."""

    when: Comparison
    then: Steps
    do: Steps


class BatteryBelow(Part, frozen=True, kw_only=True):
    """Drive to a place whenever the charge is low, and go on once it is charged."""

    percentage: Percentage
    goto: Place
    until: Percentage | None = None  # charge to go on at; None: the mission ends there
    do: Steps

    def __post_init__(self) -> None:
        if self.until is not None and self.until < self.percentage:
            raise ValueError(
                f"until: expected at least the {self.percentage:g} % below which it goes there, "
                f"got {self.until:g}"
            )


class Step(Part, frozen=True, kw_only=True):
    """One node of the tree. Exactly one field says what it is."""

    goto: Place | None = None
    patrol: Patrol | None = None
    explore: Explore | None = None
    visit: Visit | None = None
    wait: Seconds | None = None
    wait_until: Comparison | None = None
    check: Comparison | None = None  # fails where it does not hold
    script: Script | None = None
    tree: Name | None = None  # one of the mission's `trees`
    sequence: Steps | None = None
    fallback: Steps | None = None  # the first that succeeds
    retry: Retry | None = None
    repeat: Repeat | None = None
    timeout: Timeout | None = None
    guard: Guard | None = None
    battery_below: BatteryBelow | None = None

    def __post_init__(self) -> None:
        said = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(said) > 1:
            raise ValueError(f"{said[1]}: a step is one thing, and this one is {said[0]} already")
        if not said:
            raise ValueError(f"a step that does nothing; expected one of {', '.join(KINDS)}")

    @property
    def kind(self) -> str:
        """Which field says what it is."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)


class Mission(Part, frozen=True, kw_only=True):
    """A whole mission file."""

    places: dict[Name, Point] = {}
    trees: dict[Name, Steps] = {}
    do: Steps

    def goal(self, place: str | tuple[float, ...]) -> Goal:
        """Where a place is."""
        x, y, *yaw = self.places[place] if isinstance(place, str) else place
        return Goal(x=x, y=y, yaw=yaw[0] if yaw else None)


class PatrolFile(Part, frozen=True, kw_only=True):
    """The file of `gigabrain patrol`."""

    places: dict[Name, Point] = {}
    points: Annotated[tuple[Place, ...], Meta(min_length=1, max_length=1000)]
    wait: Annotated[float, Meta(ge=0, le=1e7)] = 0.0  # [s] at each


def roaming() -> Mission:
    """The mission that is to explore, and then to visit one place after the other."""
    visit = Step(fallback=(Step(visit=Visit()), Step(wait=5.0)))
    return Mission(do=(Step(explore=Explore()), Step(repeat=Repeat(do=(visit,)))))


def goal_mission(goal: Goal) -> Mission:
    """The mission that is to be at one place."""
    point = (goal.x, goal.y) if goal.yaw is None else (goal.x, goal.y, goal.yaw)
    return Mission(do=(Step(goto=point),))
