"""Reads missions, and refuses those that could not be carried out, with the line that is wrong."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.config import yaml_text as config_yaml
from gigabrain_zenoh.decision.tasks import conditions
from gigabrain_zenoh.decision.tasks.mission import Mission, Patrol, PatrolFile, Place, Step
from gigabrain_zenoh.errors import ConfigError, unknown

LONGEST = 60_000  # bytes of a mission: what a robot takes at once
MOST_STEPS = 2000  # with every `tree` written out
MOST_LEVELS = 50  # of steps within steps, likewise: whoever carries them out goes down all of them
DRIVING = ("goto", "patrol", "explore", "visit", "battery_below")
TOO_DEEP = f"more than {MOST_LEVELS} steps within one another once every tree is written out"
Way = tuple[str | int, ...]  # keys and numbers, from the top of the file


def load(path: Path) -> tuple[Mission, str]:
    """The mission in a file, and its text. Raises ConfigError with file and line."""
    text = config.read(path)
    refuse_long(text, str(path))
    return loads(text, str(path)), text


def refuse_long(text: str, source: str) -> None:
    """Raises ConfigError for a mission that is too long to be sent to a robot."""
    if (size := len(text.encode())) > LONGEST:
        raise ConfigError(f"{source}: {size} bytes; expected at most {LONGEST}")


def loads(text: str, source: str) -> Mission:
    """The mission that a YAML text describes; `source` stands for the file name in errors."""
    mission = config.loads(text, Mission, source)
    for way, problem in _problems(mission):
        raise ConfigError(f"{source}:{_line(text, way)}: {_dotted(way)}: {problem}")
    return mission


def load_patrol(path: Path) -> PatrolFile:
    """The file of a patrol. Raises ConfigError with file and line."""
    text = config.read(path)
    patrol = config.loads(text, PatrolFile, str(path))
    for i, place in enumerate(patrol.points):
        if problem := _unknown_place(place, patrol.places):
            raise ConfigError(f"{path}:{_line(text, ('points', i))}: points[{i}]: {problem}")
    return patrol


def round_of(patrol: PatrolFile, loops: int | None) -> str:
    """The mission that a patrol is, as text."""
    step = Step(patrol=Patrol(points=patrol.points, loops=loops, wait=patrol.wait))
    return msgspec.json.encode(Mission(places=patrol.places, do=(step,))).decode()


def scripts(mission: Mission) -> Iterator[str]:
    """The programs of the host that a mission runs."""
    for _, step in _steps(mission):
        if step.script:
            yield step.script.run


def drives(mission: Mission) -> bool:
    """Whether a mission wants the robot to be anywhere."""
    return any(step.kind in DRIVING for _, step in _steps(mission))


def _problems(mission: Mission) -> Iterator[tuple[Way, str]]:
    for way, step in _steps(mission):
        yield from _in_step(way, step, mission)
    levels: dict[str, int] = {}
    for name in mission.trees:
        if problem := _lead(name, mission, (), levels):
            yield ("trees", name), problem
    if _levels(mission.do, levels) > MOST_LEVELS:
        yield ("do",), TOO_DEEP
    if _size(mission.do, mission, {}) > MOST_STEPS:
        yield ("do",), f"more than {MOST_STEPS} steps once every tree is written out"


def _in_step(way: Way, step: Step, mission: Mission) -> Iterator[tuple[Way, str]]:
    for more, place in _places(step):
        if problem := _unknown_place(place, mission.places):
            yield (*way, *more), problem
    for more, text in _conditions(step):
        try:
            conditions.parse(text)
        except (ValueError, ConfigError) as error:
            yield (*way, *more), str(error)
    if step.tree is not None and step.tree not in mission.trees:
        known = mission.trees or ("none",)
        yield (*way, "tree"), str(unknown("tree", step.tree, known))


def _unknown_place(place: Place, places: dict[str, Any]) -> str:
    if not isinstance(place, str) or place in places:
        return ""
    return str(unknown("place", place, places or ("none",)))


def _places(step: Step) -> Iterator[tuple[Way, Place]]:
    if step.goto is not None:
        yield ("goto",), step.goto
    if step.patrol:
        yield from ((("patrol", "points", i), place) for i, place in enumerate(step.patrol.points))
    if step.battery_below:
        yield ("battery_below", "goto"), step.battery_below.goto


def _conditions(step: Step) -> Iterator[tuple[Way, str]]:
    if step.wait_until is not None:
        yield ("wait_until",), step.wait_until
    if step.check is not None:
        yield ("check",), step.check
    if step.guard:
        yield ("guard", "when"), step.guard.when


def _steps(mission: Mission) -> Iterator[tuple[Way, Step]]:
    """Every step of the file, and the way to it."""
    for name, steps in mission.trees.items():
        yield from _below(("trees", name), steps)
    yield from _below(("do",), mission.do)


def _below(way: Way, steps: tuple[Step, ...]) -> Iterator[tuple[Way, Step]]:
    for i, step in enumerate(steps):
        yield (*way, i), step
        for more, inner in _inner(step):
            yield from _below((*way, i, *more), inner)


def _inner(step: Step) -> Iterator[tuple[Way, tuple[Step, ...]]]:
    """The lists of steps within a step."""
    kind = step.kind
    value = getattr(step, kind)
    if kind in ("sequence", "fallback"):
        yield (kind,), value
    elif isinstance(value, Struct):
        for name in ("then", "do"):
            if hasattr(value, name):
                yield (kind, name), getattr(value, name)


def _lead(name: str, mission: Mission, above: tuple[str, ...], levels: dict[str, int]) -> str:
    """What is wrong with where a tree leads; `levels` has how deep those go that are right."""
    if name in above:
        return f"goes round in a circle: {' → '.join((*above[above.index(name) :], name))}"
    if name in levels:
        return ""
    if len(above) >= MOST_LEVELS:
        return TOO_DEEP
    for _, step in _below((), mission.trees[name]):
        tree = step.tree
        if tree is not None and (problem := _lead(tree, mission, (*above, name), levels)):
            return problem
    levels[name] = _levels(mission.trees[name], levels)
    return TOO_DEEP if levels[name] > MOST_LEVELS else ""


def _levels(steps: tuple[Step, ...], of_trees: dict[str, int]) -> int:
    """How many steps lie within one another at most, with every tree written out."""
    return 1 + max(
        max((_levels(inner, of_trees) for _, inner in _inner(step)), default=0)
        if step.tree is None
        else of_trees[step.tree]
        for step in steps
    )


def _size(steps: tuple[Step, ...], mission: Mission, known: dict[str, int]) -> int:
    """How many steps there are with every tree written out. There is no circle."""
    count = 0
    for _, step in _below((), steps):
        count += 1
        if step.tree is not None:
            if step.tree not in known:
                known[step.tree] = _size(mission.trees[step.tree], mission, known)
            count += known[step.tree]
    return count


def _line(text: str, way: Way) -> int:
    node = config_yaml.read(text)
    line = node.line
    for part in way:
        if isinstance(part, int):
            assert node.items is not None
            node = node.items[part]
            line = node.line
        else:
            assert node.entries is not None
            entry = next(entry for entry in node.entries if entry.key == part)
            node, line = entry.node, entry.line
    return line


def _dotted(way: Way) -> str:
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in way)
    return "".join(parts).lstrip(".")
