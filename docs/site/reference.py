"""Reference pages that are made from the code."""

import inspect
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec

import gigabrain_zenoh
from docs.site.structs import anchor, cell, header, nested, section
from gigabrain_drivers import DRIVERS, LIDARS
from gigabrain_drivers.driver.catalog import driver_class
from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_drivers.lidars.base import source_class
from gigabrain_drivers.sim.world_file import WorldFile
from gigabrain_schemas.topics import SERVICES, TOPICS, messages
from gigabrain_zenoh.cli.app import COMMANDS, make_app
from gigabrain_zenoh.cli.options import default_text
from gigabrain_zenoh.config.map_image import MapYaml
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision.tasks.mission import Mission, PatrolFile
from gigabrain_zenoh.launch.deployment import Deployment

Lines = Iterator[str]
EXAMPLES = Path(__file__).parents[2] / "examples"
LANGUAGES = {
    ".py": "python", ".ipynb": "python", ".yaml": "yaml", ".toml": "toml", ".c": "c", ".js": "js",
    ".mjs": "js",
    ".html": "html", ".md": "markdown", ".sh": "sh",
}  # fmt: skip


# ---- the command line ----


def cli() -> Lines:
    """Yield the page of all commands, with arguments, options and defaults."""
    yield from ("# Command line", "", "Every command has `--help`.", "")
    yield from ("| command | what it does |", "|---|---|")
    for command, (_, summary) in COMMANDS.items():
        name = f"gigabrain {command}"
        yield f"| [`{name}`](#{anchor(name)}) | {cell(summary)} |"
    app = make_app([word for command in COMMANDS for word in command.split()])
    for command in COMMANDS:
        yield from ("", f"## gigabrain {command}", "", *_command(app, command))


def _command(app: Any, command: str) -> Lines:
    for word in command.split():
        app = app[word]
    text = inspect.cleandoc(app.default_command.__doc__ or "").partition("\nArgs:\n")[0]
    yield re.sub(r"^Example: (.*)$", r"```text\n\1\n```", text, flags=re.MULTILINE)
    arguments = [one for one in app.assemble_argument_collection(parse_docstring=True) if one.show]
    if not arguments:
        return
    yield from ("", "| argument | type | default | meaning |", "|---|---|---|---|")
    for one in arguments:
        negative = one.parameter.negative or ()
        names = ", ".join(
            f"`{cell(name)}`"
            for name in one.names
            if name in negative or not name.startswith(("--no-", "--empty-"))
        )
        default = "required" if one.required else _default_of(one)
        about = " ".join((one.parameter.help or "").split())
        yield f"| {names} | {cell(_type_name(one.hint))} | {default} | {cell(about)} |"


def _default_of(argument: Any) -> str:
    value = argument.field_info.default
    text = None if value is inspect.Parameter.empty else default_text(value)
    return "" if text is None else f"`{cell(text)}`"


def _type_name(hint: Any) -> str:
    choices = getattr(hint, "__args__", ())
    if choices and all(isinstance(one, str) for one in choices):
        return ", ".join(f"`{one}`" for one in choices)
    if choices:
        return " or ".join(_type_name(one) for one in choices if one not in (type(None), ...))
    words = {"str": "text", "float": "number", "int": "integer", "bool": "yes or no"}
    name = getattr(hint, "__name__", str(hint))
    return words.get(name, name.lower())


# ---- topics and messages ----


def topics() -> Lines:
    """Yield the page of all topics and services."""
    yield from (
        "# Topics and services",
        "",
        "Keys are below the robot's namespace, if it has one. Readers call a value fresh while its",
        "rate is kept. `kept` values are sent again to those who ask later.",
        "",
        "## Topics",
        "",
        "| key | message | rate [Hz] | largest [kB] | kept | published by | meaning |",
        "|---|---|---|---|---|---|---|",
    )
    for topic in sorted(TOPICS, key=lambda one: one.key):
        kept = "yes" if topic.keep else ""
        key = f"{topic.key}/*" if topic.many else topic.key
        roles = ", ".join(topic.publishers) if topic.publishers else ""
        yield (
            f"| `{key}` | {_link(topic.type)} | {topic.hz:g} | {topic.max_bytes / 1024:g} "
            f"| {kept} | {roles} | {_first_sentence(topic.type)} |"
        )
    yield from ("", "## Services", "", "| key | request | reply | asked by |", "|---|---|---|---|")
    for one in sorted(SERVICES, key=lambda one: one.key):
        key = f"{one.key}/*" if one.many else one.key
        roles = ", ".join(one.callers)
        yield f"| `{key}` | {_link(one.request)} | {_link(one.reply)} | {roles} |"


def message_page() -> Lines:
    """Yield the page of every message and its fields."""
    yield from (
        "# Messages",
        "",
        "Messages are MessagePack maps of these fields; readers accept JSON too. Every message",
        "also has the header below, which the bus fills in. `gigabrain schema export DIR` writes",
        "JSON Schemas.",
    )
    yield from ("", "## Header", "", "| field | type | meaning |", "|---|---|---|")
    for one in header():
        yield f"| `{one.name}` | {cell(one.kind)} | {cell(one.about)} |"
    yield from _sections(messages())


def _sections(kinds: Iterable[type[msgspec.Struct]]) -> Lines:
    wanted: dict[type[msgspec.Struct], None] = {}
    for kind in kinds:
        wanted |= dict.fromkeys([kind, *nested(kind)])
    for kind in sorted(wanted, key=lambda one: one.__name__):
        yield from section(kind)


def _link(kind: type) -> str:
    return f"[{kind.__name__}](messages.md#{anchor(kind.__name__)})"


def _first_sentence(kind: type) -> str:
    return cell(" ".join((kind.__doc__ or "").split()).partition(". ")[0].rstrip("."))


# ---- files ----


def deployment_file() -> Lines:
    """Yield the page of the fields of a deployment file, with the settings of behaviours."""
    yield from ("# Fields of a deployment file", "", "For `gigabrain up FILE`.")
    yield from section(Deployment, "The file")
    for kind in nested(Deployment):
        yield from section(kind)
    for name in behaviours.SHIPPED:
        kind = behaviours.load(name).Config
        yield from section(kind, f"decision.settings of {name}")


def robot_file() -> Lines:
    """Yield the page of the fields of a robot.yaml, with the options of each driver and lidar."""
    yield from ("# Fields of robot.yaml", "")
    yield "The [guide](../how-to/your_own_robot.md) shows how to write one."
    yield from section(RobotFile, "The file")
    parts = dict.fromkeys(nested(RobotFile))
    for kind in parts:
        yield from section(kind)
    for name in DRIVERS:
        kind = driver_class(name).Options
        yield from section(kind, f"A link with driver: {name}")
        for part in nested(kind):
            if part not in parts:
                parts[part] = None
                yield from section(part)
    for name in LIDARS:
        yield from section(source_class(name).Options, f"A scan with driver: {name}")


def world_file() -> Lines:
    """Yield the page of the fields of a world file."""
    yield from ("# Fields of a world file", "")
    yield "[Worlds of your own](../how-to/worlds.md) shows how to write one."
    yield from section(WorldFile, "The file")
    for kind in nested(WorldFile):
        yield from section(kind)


def mission_file() -> Lines:
    """Yield the page of the fields of missions, patrols and saved maps."""
    yield from ("# Fields of missions, patrols and maps", "")
    yield "[Goals and missions](../how-to/missions.md) says what each step does."
    for kind, title in ((Mission, "A mission"), (PatrolFile, "A patrol"), (MapYaml, "A map")):
        yield from section(kind, title)
    for kind in nested(Mission):
        yield from section(kind)


# ---- Python ----

NAMES = ("connect", "SyncRobot", "Robot", "Reached", "Connection")
PYTHON = {
    "Connect and drive": [f"gigabrain_zenoh.{name}" for name in NAMES],
    "Errors": sorted(f"gigabrain_zenoh.{name}" for name in set(gigabrain_zenoh.__all__) - {*NAMES}),
    "Tasks": ["gigabrain_zenoh.client.tasks.Tasks"],
    "Arrays": ["gigabrain_schemas.sensors.LaserScan", "gigabrain_schemas.brain.OccupancyGrid"],
    "Recordings": [
        "gigabrain_zenoh.recording.bag_reader.samples",
        "gigabrain_zenoh.recording.bag_reader.Sample",
    ],
    "Behaviours": [
        f"gigabrain_zenoh.decision.behaviours.{name}"
        for name in ("Behaviour", "Inputs", "StepOutcome", "NavigationConfig")
    ],
    "Drivers": ["gigabrain_drivers.driver.base.Driver"],
}
INHERITING = {"gigabrain_zenoh.Robot": ("    options:", "      inherited_members: true")}


def python() -> Lines:
    """Yield the page of the Python API, for mkdocstrings to fill in."""
    yield from ("# Python API", "")
    yield "`import gigabrain_zenoh` gives the names of the first two parts."
    for title, names in PYTHON.items():
        yield from ("", f"## {title}", "")
        for name in names:
            yield from (f"::: {name}", *INHERITING.get(name, ()), "")


# ---- examples ----


def examples() -> Lines:
    """Yield the page of the programs, notebooks and folders in `examples/`."""
    yield from ("# Examples", "", "Each runs beside `gigabrain demo`, and is run by the tests.")
    for path in sorted(EXAMPLES.glob("*.py")):
        about, _, code = path.read_text("utf-8").removeprefix('"""').partition('"""\n')
        yield from ("", f"## {path.stem}", "", about.strip(), "", *_code(path.name, code))
    for path in sorted(EXAMPLES.glob("*.ipynb")):
        yield from ("", f"## {path.name}")
        for one in json.loads(path.read_text("utf-8"))["cells"]:
            text = "".join(one["source"])
            code = one["cell_type"] == "code"
            yield from ("", *(_code(path.name, text) if code else [re.sub("^#", "###", text)]))
    for folder in sorted(path for path in EXAMPLES.iterdir() if path.is_dir()):
        files = sorted(path for path in folder.rglob("*") if path.suffix in LANGUAGES)
        for path in files:
            name = str(path.relative_to(EXAMPLES))
            yield from ("", f"## {name}", "", *_code(name, path.read_text("utf-8")))


def _code(title: str, text: str) -> Lines:
    language = LANGUAGES[Path(title).suffix]
    yield from (f"````{language} title='{title}'", text.strip(), "````")


PAGES = {
    "cli": cli,
    "topics": topics,
    "messages": message_page,
    "deployment_file": deployment_file,
    "robot_file": robot_file,
    "world_file": world_file,
    "mission_file": mission_file,
    "python": python,
    "examples": examples,
}
