"""Missions: trees of steps, as frozen Structs with the fields of mission files."""

from collections.abc import Iterator
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from gigabrain_schemas.base import Angle, Name, Percentage
from gigabrain_schemas.objects import Label, TagId
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.tasks.arm_steps import (
    ArmAction,
    GripperPlace,
    HandOver,
    Point3,
    PointOrThing,
    Posture,
    Press,
    Reach,
    Solid,
    Spot,
    action_of,
)

MAX_LOOPS = 1_000_000
# x, y [m] and optionally yaw [rad]; see mission_files._out_of_range
Point = Annotated[tuple[Angle, ...], Meta(min_length=2, max_length=3)]


class Part(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A part of a mission file."""


class AtTag(Part, frozen=True, kw_only=True):
    """A place in front of a tag, such as one at a charger."""

    tag: TagId


Place = Name | Point | AtTag
Wanted = Label | AtTag
Places = Annotated[tuple[Place, ...], Meta(min_length=1, max_length=1000)]
Steps = Annotated[tuple["Step", ...], Meta(min_length=1)]
Seconds = Annotated[float, Meta(gt=0, le=1e7)]
Pause = Annotated[float, Meta(ge=0, le=1e7)]
Times = Annotated[int, Meta(ge=1, le=MAX_LOOPS)]
Comparison = Annotated[str, Meta(max_length=200)]  # see conditions.py
DRIVING = ("goto", "patrol", "find", "explore", "visit", "battery_below")
Keys = tuple[str | int, ...]  # from the top of the file


class Patrol(Part, frozen=True, kw_only=True):
    """Visit places in order, repeatedly."""

    points: Places
    loops: Times | None = None  # None: for ever
    wait: Pause = 0.0  # [s] at each place


class Explore(Part, frozen=True, kw_only=True):
    """Drive until no unknown space is reachable."""


class Visit(Part, frozen=True, kw_only=True):
    """Drive to a random reachable place."""


class Script(Part, frozen=True, kw_only=True):
    """Run a program of the host, from the folder that its deployment file allows."""

    run: Name  # file name
    arguments: tuple[Name, ...] = ()
    seconds: Seconds = 60.0  # time limit


class Retry(Part, frozen=True, kw_only=True):
    """Repeat after a failure."""

    times: Times  # attempts in all
    do: Steps


class Repeat(Part, frozen=True, kw_only=True):
    """Repeat after a success."""

    times: Times | None = None  # None: for ever
    do: Steps


class Timeout(Part, frozen=True, kw_only=True):
    """Fail after some seconds."""

    seconds: Seconds
    do: Steps


class Guard(Part, frozen=True, kw_only=True):
    """Run `then` whenever a condition holds; afterwards `do` continues."""

    when: Comparison
    then: Steps
    do: Steps


class BatteryBelow(Part, frozen=True, kw_only=True):
    """Drive to a place whenever the charge is low, and continue once charged."""

    percentage: Percentage
    goto: Place
    until: Percentage | None = None  # continue at this charge; None: the mission ends at the place
    do: Steps

    def __post_init__(self) -> None:
        if self.until is not None and self.until < self.percentage:
            raise ValueError(
                f"until: expected at least the percentage {self.percentage:g}, got {self.until:g}"
            )


class Step(Part, frozen=True, kw_only=True):
    """One node of the tree. Exactly one field is set."""

    goto: Place | None = None
    patrol: Patrol | None = None
    find: Wanted | None = None  # search for an object of a class, or a tag, and drive to it
    explore: Explore | None = None
    visit: Visit | None = None
    reach: Point3 | Reach | None = None  # with the arm's tool
    posture: Posture | None = None  # of the arm's joints
    gripper: GripperPlace | None = None
    pick: Name | None = None  # one of the mission's `things`
    place: Spot | None = None  # target of the held thing's centre; without z, on the floor
    press: PointOrThing | Press | None = None  # a point, or one of the mission's `things`
    hand_over: Point3 | HandOver | None = None  # the held thing, to a person
    wait: Seconds | None = None
    wait_until: Comparison | None = None
    check: Comparison | None = None  # fails if it does not hold
    script: Script | None = None
    tree: Name | None = None  # one of the mission's `trees`
    sequence: Steps | None = None
    fallback: Steps | None = None  # until one succeeds
    retry: Retry | None = None
    repeat: Repeat | None = None
    timeout: Timeout | None = None
    guard: Guard | None = None
    battery_below: BatteryBelow | None = None

    def __post_init__(self) -> None:
        kinds = self.__struct_fields__
        given = [kind for kind in kinds if getattr(self, kind) is not None]
        if len(given) > 1:
            raise ValueError(
                f"{given[1]}: this step is {given[0]!r} already; split it into two steps"
            )
        if not given:
            raise ValueError(f"an empty step; expected one of {', '.join(kinds)}")

    @property
    def kind(self) -> str:
        """Name of the field that is set."""
        return next(kind for kind in self.__struct_fields__ if getattr(self, kind) is not None)

    @property
    def arm(self) -> ArmAction | None:
        """The arm's action; None for a step that does not move it."""
        return action_of(self.kind, getattr(self, self.kind))


class Mission(Part, frozen=True, kw_only=True):
    """A mission file."""

    places: dict[Name, Point] = {}  # names of places: x, y [m] and optionally yaw [rad]
    things: dict[Name, Solid] = {}  # around the arm at the start
    trees: dict[Name, Steps] = {}  # named steps, to be used several times
    do: Steps  # in order

    def goal(self, place: Name | Point) -> Goal:
        """Return the goal of a place, given by name or coordinates."""
        x, y, *yaw = self.places[place] if isinstance(place, str) else place
        return Goal(x=x, y=y, yaw=yaw[0] if yaw else None)

    @property
    def scripts(self) -> Iterator[str]:
        """Names of the programs that the mission runs."""
        return (step.script.run for _, step in steps_of(self) if step.script)

    @property
    def drives(self) -> bool:
        """Return whether any step drives."""
        return any(step.kind in DRIVING for _, step in steps_of(self))

    @property
    def arm_actions(self) -> list[ArmAction]:
        """The arm's actions in all steps."""
        return [step.arm for _, step in steps_of(self) if step.arm]

    @property
    def looks(self) -> bool:
        """Return whether any step needs a camera that recognises objects or tags."""
        return any(
            step.find is not None or any(isinstance(place, AtTag) for _, place in places_of(step))
            for _, step in steps_of(self)
        )

    @property
    def labels(self) -> Iterator[str]:
        """Classes of objects that cameras have to recognise."""
        yield from (step.find for _, step in steps_of(self) if isinstance(step.find, str))
        yield from (thing.label for thing in self.things.values() if thing.label)


class PatrolFile(Part, frozen=True, kw_only=True):
    """The file of `gigabrain patrol`."""

    places: dict[Name, Point] = {}  # names of places: x, y [m] and optionally yaw [rad]
    points: Places  # names, or x, y and optionally yaw
    wait: Pause = 0.0  # [s] at each


def explore_mission() -> Mission:
    """Return a mission that explores, and then visits one place after another."""
    visit = Step(fallback=(Step(visit=Visit()), Step(wait=5.0)))
    return Mission(do=(Step(explore=Explore()), Step(repeat=Repeat(do=(visit,)))))


def goal_mission(goal: Goal) -> Mission:
    """Return the mission that drives to one goal."""
    point = (goal.x, goal.y) if goal.yaw is None else (goal.x, goal.y, goal.yaw)
    return Mission(do=(Step(goto=point),))


def find_mission(wanted: str | int) -> Mission:
    """Return the mission that searches for an object of a class or a tag, and drives to it."""
    return Mission(do=(Step(find=AtTag(tag=wanted) if isinstance(wanted, int) else wanted),))


def patrol_mission(patrol: PatrolFile, loops: int | None) -> str:
    """Return the text of the mission for a patrol file."""
    step = Step(patrol=Patrol(points=patrol.points, loops=loops, wait=patrol.wait))
    return text_of(Mission(places=patrol.places, do=(step,)))


def text_of(mission: Mission) -> str:
    """Return a mission as the text that is sent to a robot."""
    return msgspec.json.encode(mission).decode()


def map_places(mission: Mission) -> Iterator[str]:
    """Yield the names of places that the mission does not define, so the map has to."""
    for _, step in steps_of(mission):
        for _, place in places_of(step):
            if isinstance(place, str) and place not in mission.places:
                yield place


def places_of(step: Step) -> Iterator[tuple[Keys, Place]]:
    """Yield the places of a step with the keys that lead to them."""
    if step.goto is not None:
        yield ("goto",), step.goto
    if step.patrol:
        yield from ((("patrol", "points", i), place) for i, place in enumerate(step.patrol.points))
    if step.battery_below:
        yield ("battery_below", "goto"), step.battery_below.goto


def steps_of(mission: Mission) -> Iterator[tuple[Keys, Step]]:
    """Yield every step of the file with the keys that lead to it."""
    for name, steps in mission.trees.items():
        yield from steps_below(("trees", name), steps)
    yield from steps_below(("do",), mission.do)


def steps_below(keys: Keys, steps: tuple[Step, ...]) -> Iterator[tuple[Keys, Step]]:
    """Yield every step below `keys` with the keys that lead to it."""
    for i, step in enumerate(steps):
        yield (*keys, i), step
        for more, inner in inner_steps(step):
            yield from steps_below((*keys, i, *more), inner)


def inner_steps(step: Step) -> Iterator[tuple[Keys, tuple[Step, ...]]]:
    """Yield the lists of steps within a step."""
    kind = step.kind
    value = getattr(step, kind)
    if kind in ("sequence", "fallback"):
        yield (kind,), value
    elif isinstance(value, Struct):
        for name in ("then", "do"):
            if hasattr(value, name):
                yield (kind, name), getattr(value, name)
