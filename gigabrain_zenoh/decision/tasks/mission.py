"""Missions: a YAML file becomes a behaviour tree of frozen Structs, or a ConfigError.

Checks that need more than one step, such as names of places and the depth of trees, come last.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, get_args

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from gigabrain_schemas.base import Angle, Coordinate, Name, Percentage
from gigabrain_schemas.objects import Label, TagId
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.zones import Place as MapPlace
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.config import loading, yaml_text
from gigabrain_zenoh.config.yaml_text import Node
from gigabrain_zenoh.decision.tasks import conditions
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
    thing_meant,
)
from gigabrain_zenoh.errors import ConfigError, unknown

MAX_LOOPS = 1_000_000
MAX_BYTES = 60_000  # of a mission that is sent to a robot
MAX_STEPS = 2000  # with each `tree` written out
MAX_DEPTH = 50  # of nested steps, likewise; carrying them out is recursive
TOO_DEEP = f"more than {MAX_DEPTH} nested steps once every tree is written out"

# x, y [m] and maybe yaw [rad]; see `_beyond`
Point = Annotated[tuple[Angle, ...], Meta(min_length=2, max_length=3)]
BOUNDS = get_args(Coordinate)[1]  # [m], of x and y


class Part(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A part of a mission file."""


class AtTag(Part, frozen=True, kw_only=True):
    """Before a tag, such as one at a charger."""

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
    wait: Pause = 0.0  # [s] at each


class Explore(Part, frozen=True, kw_only=True):
    """Drive until nothing unknown is reachable."""


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
    until: Percentage | None = None  # charge to continue at; None: the mission ends there
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
    find: Wanted | None = None  # a thing by its class: look for one, and drive before it
    explore: Explore | None = None
    visit: Visit | None = None
    reach: Point3 | Reach | None = None  # with the arm's tool
    posture: Posture | None = None  # of the arm's joints
    gripper: GripperPlace | None = None
    pick: Name | None = None  # one of the mission's `things`
    place: Spot | None = None  # where the middle of what is held shall be; on the floor without z
    press: PointOrThing | Press | None = None  # a place, or one of the mission's `things`
    hand_over: Point3 | HandOver | None = None  # what is held, to a person
    wait: Seconds | None = None
    wait_until: Comparison | None = None
    check: Comparison | None = None  # fails if it does not hold
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
        kinds = self.__struct_fields__
        given = [kind for kind in kinds if getattr(self, kind) is not None]
        if len(given) > 1:
            raise ValueError(f"{given[1]}: this step is {given[0]!r} already; split it in two")
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
    things: dict[Name, Solid] = {}  # what stands round the arm at the beginning
    trees: dict[Name, Steps] = {}  # names of steps that are used several times
    do: Steps  # in order

    def goal(self, place: Name | Point) -> Goal:
        """Return the goal of a place, given by name or coordinates."""
        x, y, *yaw = self.places[place] if isinstance(place, str) else place
        return Goal(x=x, y=y, yaw=yaw[0] if yaw else None)

    @property
    def scripts(self) -> Iterator[str]:
        """Names of the host's programs that it runs."""
        return (step.script.run for _, step in _steps(self) if step.script)

    @property
    def drives(self) -> bool:
        """Return whether any step drives."""
        return any(step.kind in DRIVING for _, step in _steps(self))

    @property
    def arm_actions(self) -> list[ArmAction]:
        """The arm's actions in all steps."""
        return [step.arm for _, step in _steps(self) if step.arm]

    @property
    def looks(self) -> bool:
        """Return whether any step needs a camera that recognises things or tags."""
        return any(
            step.find is not None or any(isinstance(place, AtTag) for _, place in _places(step))
            for _, step in _steps(self)
        )


class PatrolFile(Part, frozen=True, kw_only=True):
    """The file of `gigabrain patrol`."""

    places: dict[Name, Point] = {}  # names of places: x, y [m] and optionally yaw [rad]
    points: Places  # names, or x, y and optionally yaw
    wait: Pause = 0.0  # [s] at each


def explore_mission() -> Mission:
    """Return the mission that explores, and then visits one place after the other."""
    visit = Step(fallback=(Step(visit=Visit()), Step(wait=5.0)))
    return Mission(do=(Step(explore=Explore()), Step(repeat=Repeat(do=(visit,)))))


def goal_mission(goal: Goal) -> Mission:
    """Return the mission that drives to one goal."""
    point = (goal.x, goal.y) if goal.yaw is None else (goal.x, goal.y, goal.yaw)
    return Mission(do=(Step(goto=point),))


def find_mission(wanted: str | int) -> Mission:
    """Return the mission that drives before a thing of a class, or before a tag."""
    return Mission(do=(Step(find=AtTag(tag=wanted) if isinstance(wanted, int) else wanted),))


def patrol_mission(patrol: PatrolFile, loops: int | None) -> str:
    """Return the text of the mission for a patrol file."""
    step = Step(patrol=Patrol(points=patrol.points, loops=loops, wait=patrol.wait))
    return text_of(Mission(places=patrol.places, do=(step,)))


def text_of(mission: Mission) -> str:
    """Return a mission as the text that a robot takes."""
    return msgspec.json.encode(mission).decode()


def load(path: Path) -> tuple[Mission, str]:
    """Return the mission in a file, and its text. Raises ConfigError with file and line.

    Names of places that are not in the file may be those of the robot's map: it checks them.
    """
    text = loading.read(path)
    refuse_long(text, str(path))
    return loads(text, str(path), None), text


def refuse_long(text: str, source: str) -> None:
    """Raise ConfigError for a mission that is too long to be sent to a robot."""
    if (size := len(text.encode())) > MAX_BYTES:
        raise ConfigError(f"{source}: {size} bytes; expected at most {MAX_BYTES}")


def loads(text: str, source: str, places: Iterable[MapPlace] | None = ()) -> Mission:
    """Return the mission in a YAML text; `source` names it in errors. Raises ConfigError.

    The `places` of the map that it names are added to its own, which come first; None if they are
    not known.
    """
    root = loading.document(text, source)
    mission = loading.converted(root, Mission, lambda line: f"{source}:{line}")
    for line, problem in _without_value(root):
        raise ConfigError(f"{source}:{line}: {problem}")
    named = set(map_places(mission))
    if places is not None:
        used = {one.name: _point(one) for one in places if one.name in named}
        mission = replace(mission, places={**used, **mission.places})
    _refuse(_problems(mission, frozenset(named if places is None else ())), text, source)
    return mission


def _without_value(node: Node) -> Iterator[tuple[int, str]]:
    """Yield each field of a step that would be dropped, as it stands without a value by another."""
    for item in node.items or ():
        entries = item.entries or ()
        empty = [one for one in entries if one.node.value is None and not one.node.text]
        kind = next((one.key for one in entries if one.node.value is not None), None)
        for one in empty if kind else ():
            text = f"{one.key!r} has no value, and this step is {kind!r} already; split it in two"
            yield one.line, text
    for inner in (*(node.items or ()), *(one.node for one in node.entries or ())):
        yield from _without_value(inner)


def restored(text: str, source: str) -> Mission:
    """Return the mission in a text of `text_of`, read as JSON. Raises ConfigError.

    YAML allows fewer characters in a JSON text, and folds some of them.
    """
    try:
        mission = msgspec.json.decode(text, type=Mission)
    except DECODE_ERRORS:
        return loads(text, source)  # raises the error with its place
    return loads(text, source) if any(_problems(mission, frozenset())) else mission


def map_places(mission: Mission) -> Iterator[str]:
    """Yield the names of places that are not the mission's own, so must be the map's."""
    for _, step in _steps(mission):
        for _, place in _places(step):
            if isinstance(place, str) and place not in mission.places:
                yield place


def _point(place: MapPlace) -> Point:
    return (place.x, place.y) if place.yaw is None else (place.x, place.y, place.yaw)


def load_patrol(path: Path) -> PatrolFile:
    """Return the patrol in a file. Raises ConfigError with file and line; see `load`."""
    text = loading.read(path)
    patrol = loading.loads(text, PatrolFile, str(path))
    points: dict[Keys, Place] = {("points", i): place for i, place in enumerate(patrol.points)}
    _refuse(_beyond(points | _own_places(patrol)), text, str(path))
    return patrol


def _refuse(problems: Iterable[tuple[Keys, str]], text: str, source: str) -> None:
    """Raise ConfigError for the first problem, if any."""
    for keys, problem in problems:
        raise ConfigError(f"{source}:{_line(text, keys)}: {_dotted(keys)}: {problem}")


def _own_places(file: Mission | PatrolFile) -> dict[Keys, Place]:
    return {("places", name): place for name, place in file.places.items()}


def _beyond(places: Mapping[Keys, Place]) -> Iterator[tuple[Keys, str]]:
    """Yield each coordinate that is in no map."""
    for keys, place in places.items():
        for i, value in enumerate(place[:2] if isinstance(place, tuple) else ()):
            if not BOUNDS.ge <= value <= BOUNDS.le:
                expected = f"expected {BOUNDS.ge:.0f} to {BOUNDS.le:.0f} [m], got {value}"
                yield (*keys, i), expected


def _problems(mission: Mission, elsewhere: frozenset[str]) -> Iterator[tuple[Keys, str]]:
    """Yield all problems; the places `elsewhere` are not checked."""
    yield from _beyond(_own_places(mission))
    for keys, step in _steps(mission):
        yield from _in_step(keys, step, mission, elsewhere)
    depths: dict[str, int] = {}
    for name in mission.trees:
        if problem := _tree_problem(name, mission, (), depths):
            yield ("trees", name), problem
    if _depth(mission.do, depths) > MAX_DEPTH:
        yield ("do",), TOO_DEEP
    if _size(mission.do, mission, {}) > MAX_STEPS:
        yield ("do",), f"more than {MAX_STEPS} steps once every tree is written out"


def _in_step(
    keys: Keys, step: Step, mission: Mission, elsewhere: frozenset[str]
) -> Iterator[tuple[Keys, str]]:
    yield from _beyond({(*keys, *more): place for more, place in _places(step)})
    for more, place in _places(step):
        if isinstance(place, str) and place not in mission.places and place not in elsewhere:
            yield (*keys, *more), str(unknown("place", place, mission.places or ("none",)))
    for more, text in _conditions(step):
        try:
            conditions.parse(text)
        except (ValueError, ConfigError) as error:
            yield (*keys, *more), str(error)
    if (thing := thing_meant(step.arm)) is not None and thing not in mission.things:
        yield (*keys, step.kind), str(unknown("thing", thing, mission.things or ("none",)))
    if step.tree is not None and step.tree not in mission.trees:
        known = mission.trees or ("none",)
        yield (*keys, "tree"), str(unknown("tree", step.tree, known))


def _places(step: Step) -> Iterator[tuple[Keys, Place]]:
    if step.goto is not None:
        yield ("goto",), step.goto
    if step.patrol:
        yield from ((("patrol", "points", i), place) for i, place in enumerate(step.patrol.points))
    if step.battery_below:
        yield ("battery_below", "goto"), step.battery_below.goto


def _conditions(step: Step) -> Iterator[tuple[Keys, str]]:
    if step.wait_until is not None:
        yield ("wait_until",), step.wait_until
    if step.check is not None:
        yield ("check",), step.check
    if step.guard:
        yield ("guard", "when"), step.guard.when


def _steps(mission: Mission) -> Iterator[tuple[Keys, Step]]:
    """Yield every step of the file with the keys that lead to it."""
    for name, steps in mission.trees.items():
        yield from _below(("trees", name), steps)
    yield from _below(("do",), mission.do)


def _below(keys: Keys, steps: tuple[Step, ...]) -> Iterator[tuple[Keys, Step]]:
    for i, step in enumerate(steps):
        yield (*keys, i), step
        for more, inner in _inner(step):
            yield from _below((*keys, i, *more), inner)


def _inner(step: Step) -> Iterator[tuple[Keys, tuple[Step, ...]]]:
    """Yield the lists of steps within a step."""
    kind = step.kind
    value = getattr(step, kind)
    if kind in ("sequence", "fallback"):
        yield (kind,), value
    elif isinstance(value, Struct):
        for name in ("then", "do"):
            if hasattr(value, name):
                yield (kind, name), getattr(value, name)


def _tree_problem(
    name: str, mission: Mission, above: tuple[str, ...], depths: dict[str, int]
) -> str:
    """Return the problem of a tree, if any; `depths` has the depth of each valid tree."""
    if name in above:
        return f"is a cycle: {' → '.join((*above[above.index(name) :], name))}"
    if name in depths:
        return ""
    if len(above) >= MAX_DEPTH:
        return TOO_DEEP
    for _, step in _below((), mission.trees[name]):
        tree = step.tree
        if tree is not None and (problem := _tree_problem(tree, mission, (*above, name), depths)):
            return problem
    depths[name] = _depth(mission.trees[name], depths)
    return TOO_DEEP if depths[name] > MAX_DEPTH else ""


def _depth(steps: tuple[Step, ...], of_trees: dict[str, int]) -> int:
    """Return the greatest depth of nested steps, with every tree written out."""
    return 1 + max(
        max((_depth(inner, of_trees) for _, inner in _inner(step)), default=0)
        if step.tree is None
        else of_trees[step.tree]
        for step in steps
    )


def _size(steps: tuple[Step, ...], mission: Mission, known: dict[str, int]) -> int:
    """Return the number of steps with every tree written out. There must be no cycle."""
    count = 0
    for _, step in _below((), steps):
        count += 1
        if step.tree is not None:
            if step.tree not in known:
                known[step.tree] = _size(mission.trees[step.tree], mission, known)
            count += known[step.tree]
    return count


def _line(text: str, keys: Keys) -> int:
    node = yaml_text.read(text)
    line = node.line
    for part in keys:
        if isinstance(part, int):
            assert node.items is not None
            node = node.items[part]
            line = node.line
        else:
            assert node.entries is not None
            entry = next(entry for entry in node.entries if entry.key == part)
            node, line = entry.node, entry.line
    return line


def _dotted(keys: Keys) -> str:
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in keys)
    return "".join(parts).lstrip(".")
