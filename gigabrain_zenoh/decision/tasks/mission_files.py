"""Reads mission files, and checks them completely before anything moves.

Checks of more than one step, such as names of places and the depth of trees, come last.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import get_args

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.base import Coordinate
from gigabrain_schemas.zones import Place as MapPlace
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.config import loading, yaml_text
from gigabrain_zenoh.config.yaml_text import Node
from gigabrain_zenoh.decision.tasks import conditions
from gigabrain_zenoh.decision.tasks.arm_steps import thing_meant
from gigabrain_zenoh.decision.tasks.mission import (
    Keys,
    Mission,
    PatrolFile,
    Place,
    Point,
    Step,
    inner_steps,
    map_places,
    places_of,
    steps_below,
    steps_of,
)
from gigabrain_zenoh.errors import ConfigError, unknown

MAX_BYTES = 60_000  # of a mission that is sent to a robot
MAX_STEPS = 2000  # with each `tree` expanded
MAX_DEPTH = 50  # of nested steps with each `tree` expanded: their execution is recursive
TOO_DEEP = f"more than {MAX_DEPTH} nested steps once every tree is written out"
BOUNDS = get_args(Coordinate)[1]  # [m], of x and y


def load(path: Path) -> tuple[Mission, str]:
    """Return the mission in a file, and its text. Raises ConfigError with file and line.

    Places that the file does not define may be in the robot's map; the robot checks them.
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

    Places that the mission uses but does not define are taken from `places` of the map; None skips
    their check.
    """
    root = loading.document(text, source)
    mission = loading.converted(root, Mission, lambda line: f"{source}:{line}")
    for line, problem in _without_value(root):
        raise ConfigError(f"{source}:{line}: {problem}")
    undefined = set(map_places(mission))
    if places is not None:
        used = {place.name: _point(place) for place in places if place.name in undefined}
        mission = replace(mission, places={**used, **mission.places})
    _refuse(_problems(mission, frozenset(undefined if places is None else ())), text, source)
    return mission


def _without_value(node: Node) -> Iterator[tuple[int, str]]:
    """Yield line and problem of each field without a value beside one with a value."""
    for item in node.items or ():
        entries = item.entries or ()
        empty = [entry for entry in entries if entry.node.value is None and not entry.node.text]
        kind = next((entry.key for entry in entries if entry.node.value is not None), None)
        for entry in empty if kind else ():
            text = f"{entry.key!r} has no value, and this step is {kind!r} already; "
            text += "split it into two steps"
            yield entry.line, text
    for inner in (*(node.items or ()), *(entry.node for entry in node.entries or ())):
        yield from _without_value(inner)


def restored(text: str, source: str) -> Mission:
    """Return the mission in a text of `text_of`, read as JSON. Raises ConfigError.

    YAML would refuse or fold some characters of a JSON text.
    """
    try:
        mission = msgspec.json.decode(text, type=Mission)
    except DECODE_ERRORS:
        return loads(text, source)  # raises the error with its line
    return loads(text, source) if any(_problems(mission, frozenset())) else mission


def _point(place: MapPlace) -> Point:
    return (place.x, place.y) if place.yaw is None else (place.x, place.y, place.yaw)


def load_patrol(path: Path) -> PatrolFile:
    """Return the patrol in a file. Raises ConfigError with file and line; see `load`."""
    text = loading.read(path)
    patrol = loading.loads(text, PatrolFile, str(path))
    points: dict[Keys, Place] = {("points", i): place for i, place in enumerate(patrol.points)}
    _refuse(_out_of_range(points | _own_places(patrol)), text, str(path))
    return patrol


def _refuse(problems: Iterable[tuple[Keys, str]], text: str, source: str) -> None:
    """Raise ConfigError for the first problem, if any."""
    for keys, problem in problems:
        raise ConfigError(f"{source}:{_line(text, keys)}: {_dotted(keys)}: {problem}")


def _own_places(file: Mission | PatrolFile) -> dict[Keys, Place]:
    return {("places", name): place for name, place in file.places.items()}


def _out_of_range(places: Mapping[Keys, Place]) -> Iterator[tuple[Keys, str]]:
    """Yield each coordinate that is out of range for any map."""
    for keys, place in places.items():
        for i, value in enumerate(place[:2] if isinstance(place, tuple) else ()):
            if not BOUNDS.ge <= value <= BOUNDS.le:
                expected = f"expected {BOUNDS.ge:.0f} to {BOUNDS.le:.0f} [m], got {value}"
                yield (*keys, i), expected


def _problems(mission: Mission, elsewhere: frozenset[str]) -> Iterator[tuple[Keys, str]]:
    """Yield all problems; names of places in `elsewhere` are not checked."""
    yield from _out_of_range(_own_places(mission))
    for keys, step in steps_of(mission):
        yield from _step_problems(keys, step, mission, elsewhere)
    depths: dict[str, int] = {}
    for name in mission.trees:
        if problem := _tree_problem(name, mission, (), depths):
            yield ("trees", name), problem
    if _depth(mission.do, depths) > MAX_DEPTH:
        yield ("do",), TOO_DEEP
    if _size(mission.do, mission, {}) > MAX_STEPS:
        yield ("do",), f"more than {MAX_STEPS} steps once every tree is written out"


def _step_problems(
    keys: Keys, step: Step, mission: Mission, elsewhere: frozenset[str]
) -> Iterator[tuple[Keys, str]]:
    yield from _out_of_range({(*keys, *more): place for more, place in places_of(step)})
    for more, place in places_of(step):
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


def _conditions(step: Step) -> Iterator[tuple[Keys, str]]:
    if step.wait_until is not None:
        yield ("wait_until",), step.wait_until
    if step.check is not None:
        yield ("check",), step.check
    if step.guard:
        yield ("guard", "when"), step.guard.when


def _tree_problem(
    name: str, mission: Mission, above: tuple[str, ...], depths: dict[str, int]
) -> str:
    """Return the problem of a tree, if any; `depths` has the depth of each valid tree."""
    if name in above:
        return f"is a cycle: {' → '.join((*above[above.index(name) :], name))}; remove a step"
    if name in depths:
        return ""
    if len(above) >= MAX_DEPTH:
        return TOO_DEEP
    for _, step in steps_below((), mission.trees[name]):
        tree = step.tree
        if tree is not None and (problem := _tree_problem(tree, mission, (*above, name), depths)):
            return problem
    depths[name] = _depth(mission.trees[name], depths)
    return TOO_DEEP if depths[name] > MAX_DEPTH else ""


def _depth(steps: tuple[Step, ...], tree_depths: dict[str, int]) -> int:
    """Return the depth of nested steps, with each tree expanded."""
    return 1 + max(
        max((_depth(inner, tree_depths) for _, inner in inner_steps(step)), default=0)
        if step.tree is None
        else tree_depths[step.tree]
        for step in steps
    )


def _size(steps: tuple[Step, ...], mission: Mission, tree_sizes: dict[str, int]) -> int:
    """Return the number of steps with each tree expanded. There must be no cycle."""
    count = 0
    for _, step in steps_below((), steps):
        count += 1
        if step.tree is not None:
            if step.tree not in tree_sizes:
                tree_sizes[step.tree] = _size(mission.trees[step.tree], mission, tree_sizes)
            count += tree_sizes[step.tree]
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
