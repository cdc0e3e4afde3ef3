"""Options that several commands share: completion, checks of values, output to the terminal."""

import math
import re
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args

from cyclopts import (
    App,
    Argument,
    ArgumentCollection,
    CoercionError,
    CycloptsError,
    MissingArgumentError,
    Parameter,
    RepeatArgumentError,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from gigabrain_zenoh.errors import ConfigError, GigabrainError
from gigabrain_zenoh.host.escaping import printable, printable_json
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from msgspec import Struct
    from rich.table import Table

    from gigabrain_schemas.requests import Description
    from gigabrain_zenoh.bus.bus import Bus
    from gigabrain_zenoh.client.robot import Robot
    from gigabrain_zenoh.runtime.connect import Where

T = TypeVar("T", bound="Struct")
R = TypeVar("R")

COMPLETION_TIMEOUT_S = 0.3  # a shell waits for the names
MAX_NAME_CHARS = 64
MAX_SEED = 2**32
MAX_SHOWN_CHARS = 60  # of a value in an error
PIPE_COLUMNS = 160  # width of tables in a pipe
UNIT = re.compile("_(s|mb)$")  # suffix of settings that their options do not have


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RobotAddress:
    """The robot that a command is for."""

    connect: str | None = None
    "Zenoh endpoint of the robot's router. Default: the only robot on this machine."
    namespace: str = ""
    "Namespace of the robot, where one router serves several robots."
    keys: Path | None = None
    "Folder of your identity, for a router that requires keys."

    @property
    def folder(self) -> str:
        """Return the folder of the identity; empty for none."""
        return str(self.keys) if self.keys else ""

    def robot(self, source: str = "", *, wait: bool = True) -> AbstractAsyncContextManager["Robot"]:
        """Return a connection to the robot; with `wait` it waits for the robot's state."""
        from gigabrain_zenoh.client.connection import connect

        return connect(
            self.connect, namespace=self.namespace, keys=self.folder, source=source, wait=wait
        )

    def where(self) -> "Where":
        """Return the address for `connect`."""
        from gigabrain_zenoh.runtime.connect import Where

        return Where(connect=self.connect, namespace=self.namespace, keys=self.folder)


LOCAL = RobotAddress()  # the only robot on this machine


def on_bus(at: RobotAddress, do: Callable[["Bus"], Awaitable[R]], name: str = "") -> R:
    """Connect to a robot as `name`, call `do` with the bus, and return its result."""
    from gigabrain_zenoh.diagnostics.listener import CLIENT_NAME
    from gigabrain_zenoh.runtime.connect import connect

    async def run() -> R:
        async with connect(at.where(), name or CLIENT_NAME) as bus:
            return await do(bus)

    return run_async(run())


def completion(shell: Literal["bash", "zsh", "fish"]) -> None:
    """Print the script that completes commands, options and names in a shell.

    Example: eval "$(gigabrain completion bash)"

    Args:
        shell: Shell to write the script for.
    """
    from gigabrain_zenoh.cli.app import PARENTS, make_app

    print(make_app(tuple(PARENTS)).generate_completion(shell=shell))


def _live_topics(_: object) -> list[str]:
    """Return the topics that a running robot publishes; without a robot all known ones."""
    from gigabrain_schemas.topics import TOPICS
    from gigabrain_zenoh.bus.listening import topic_of
    from gigabrain_zenoh.diagnostics.discovery import short_name

    published = {key for each in _live_processes() for key in each.publishes if topic_of(key)}
    return sorted(map(short_name, published or {topic.key for topic in TOPICS}))


def _live_process_names(_: object) -> list[str]:
    return [each.process for each in _live_processes()]


def _live_processes() -> list["Description"]:
    """Return the processes that reply at once; empty on any error."""
    from gigabrain_zenoh.diagnostics.discovery import discover

    try:
        found = on_bus(LOCAL, lambda bus: discover(bus, COMPLETION_TIMEOUT_S), "completion")
        return list(found.values())
    except GigabrainError:
        return []


def _check_seed(_: object, seed: int) -> None:
    """Raise ConfigError for a seed that no generator of random numbers takes."""
    if not 0 <= seed <= MAX_SEED:
        raise ConfigError(f"--seed: expected a whole number >= 0 and <= {MAX_SEED}, got {seed}")


Topic = Annotated[
    str,
    Parameter(
        completer=_live_topics,
        help='Name such as scan or health/driver, key, or key expression such as "robot/*".',
    ),
]
TopicName = Annotated[
    str, Parameter(completer=_live_topics, help="Name of the topic, such as cmd_vel.")
]
Process = Annotated[str, Parameter(completer=_live_process_names, help="Name of the process.")]
ProcessOrAll = Annotated[
    str, Parameter(completer=_live_process_names, help="Name of a process. Default: all.")
]
TopicNames = Annotated[
    list[str] | None,
    Parameter(
        consume_multiple=True,
        help='Names such as scan, or key expressions such as "robot/image/*". Default: all.',
    ),
]
Level = Literal["debug", "info", "warning", "error"]
Count = Annotated[int | None, Parameter(alias="-n", help="End after this many messages.")]
Lines = Annotated[int | None, Parameter(alias="-n", help="End after this many lines.")]
Take = Annotated[bool, Parameter(help="Take over from any commander, the robot's brain too.")]
JsonLines = Annotated[bool, Parameter(help="Print one JSON object per line.")]
JsonFile = Annotated[Path | None, Parameter(help="Write the results as JSON to this file.")]
Output = Annotated[Path | None, Parameter(alias="-o")]
Body = Annotated[
    str, Parameter(help="Name of the robot, or path of its YAML file; see `gigabrain robots`.")
]
World = Annotated[
    str, Parameter(help="Simulated world, or path of a world file; see `gigabrain worlds`.")
]
Seed = Annotated[
    int,
    Parameter(help="Random seed of the start pose and the sensor noise.", validator=_check_seed),
]
AnySeed = Annotated[int, Parameter(validator=_check_seed)]
KeepStuck = Annotated[
    bool,
    Parameter(help="Do not restart a process that makes no progress (for a debugger)."),
]


def checked(
    values: Mapping[str, object],
    type: type[T],
    options: Mapping[str, str] | None = None,
    positional: Collection[str] = (),
) -> T:
    """Convert `values` to a `type`. Raises ConfigError, which names the invalid option.

    Args:
        values: Settings by their names.
        type: Struct of the settings.
        options: Names of options that differ from the names of their settings.
        positional: Settings that are arguments without an option.
    """
    import msgspec

    from gigabrain_zenoh.config.loading import expected
    from gigabrain_zenoh.config.name_words import plain

    try:
        return msgspec.convert(values, type)
    except msgspec.ValidationError as error:
        text = plain(error)
        place, _, reason = text.partition(": ")
        fields = {field.name: field.type for field in msgspec.structs.fields(type)}
        name = re.split(r"[.\[]", place)[0]
        if name not in fields:
            raise ConfigError(text) from None
        if str(error).endswith(f" - at `$.{name}`"):
            reason = f"expected {expected(fields[name])}, got {_short(values[name])}"
        option = (options or {}).get(name, UNIT.sub("", name))
        shown = name.upper() if name in positional else f"--{option.replace('_', '-')}"
        raise ConfigError(f"{shown}: {reason}") from None


def check_name(argument: str, name: str, most_chars: int = MAX_NAME_CHARS) -> None:
    """Raise ConfigError for a name that is empty or too long."""
    if not 1 <= len(name) <= most_chars:
        raise ConfigError(
            f"{argument}: expected a name of 1 to {most_chars} characters, got {_short(name)!r}"
        )


def _short(value: object) -> str:
    """Return a value as text; a long one ends with dots."""
    text = str(value)
    return text if len(text) <= MAX_SHOWN_CHARS else f"{text[:MAX_SHOWN_CHARS]}..."


def check_positive(**options: float | None) -> None:
    """Raise ConfigError for the first option that is not above 0 or too large; None is allowed."""
    for name, value in options.items():
        if value is not None and not 0 < value < 1e9:
            shown = name.replace("_", "-")
            bound = "below 1e+09" if value > 0 else "above 0"
            raise ConfigError(f"--{shown}: expected a number {bound}, got {value:g}")


def check_names(robots: Iterable[str] = (), worlds: Iterable[str] = ()) -> None:
    """Raise ConfigError or UnknownName for a robot or a simulated world that does not exist."""
    from gigabrain_drivers.driver.catalog import load_robot
    from gigabrain_drivers.sim.worlds import load_world

    for robot in robots:
        load_robot(robot)
    for world in worlds:
        load_world(world, 0)


def usage_error(error: CycloptsError) -> str:
    """Return an error in one line for arguments that cannot be parsed, with what is expected."""
    from gigabrain_zenoh.config.loading import expected, nearest

    command = " ".join(("gigabrain", *(error.command_chain or ())))
    see = f"; see `{command} --help`"
    match error:
        case UnknownCommandError(unused_tokens=[str(name), *_], app=app):
            kind = "option" if name.startswith("-") else "command"
            return f"no {kind} {name!r}{nearest(name, app or ()) or see}"
        case UnknownOptionError(token=token, argument_collection=known):
            name = token.keyword or token.value
            names = [each for argument in known for each in argument.names]
            return f"no option {name!r}{nearest(name, names) or see}"
        case UnusedCliTokensError(unused_tokens=[str(name), *_], app=app):
            return f"unexpected argument {name!r}{nearest(name, app or ()) or see}"
        case MissingArgumentError(argument=Argument() as argument):
            given = error.keyword or next((token.keyword for token in argument.tokens), None)
            missing = f"{given}: a value is missing" if given else f"missing {_shown(argument)}"
            return missing + see
        case RepeatArgumentError(token=token):
            return f"{token.keyword}: given twice; give it once"
        case CoercionError(argument=Argument() as argument, token=token) if token:
            type_, got = error.target_type, token.value
            choices = [each for each in get_args(type_) if isinstance(each, str)]
            text = f"expected {expected(type_)}, got {got!r}{nearest(got, choices)}"
            return f"{_shown(argument)}: {text}"
    return " ".join(str(error).split())


def _shown(argument: Argument) -> str:
    """Return an argument as the help shows it: `--seed`, or `FILE` for a positional one."""
    name = argument.name
    return name.lstrip("-").upper() if argument.field_info.is_positional else name


def check_numbers(_app: App, _command: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Raise ConfigError for NaN and infinity, and for fractions that cyclopts would round."""
    for argument in arguments:
        whole = _holds(argument.hint, int)
        if not whole and not _holds(argument.hint, float):
            continue
        for token in argument.tokens:
            value = _number(token.value)
            if not math.isfinite(value) or (whole and not value.is_integer()):
                expected = "a whole number" if whole else "a number"
                raise ConfigError(f"{_shown(argument)}: expected {expected}, got {token.value}")


def default_text(value: object) -> str | None:
    """Return a default as the help shows it; None for False or an empty value."""
    if value is None or value is False or value in ("", ()):
        return None
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _holds(hint: Any, number: type) -> bool:
    """Return whether a type is `number`, or a union or a collection of it."""
    return hint is number or any(_holds(part, number) for part in get_args(hint))


def _number(text: str) -> float:
    """Return the number in a text; 0 for one that only cyclopts can parse, such as 0x10."""
    try:
        return float(text)
    except ValueError:
        return 0.0


def print_line(line: str) -> None:
    """Print a line with control characters escaped, and flush it."""
    print(printable(line), flush=True)


def print_json(value: object, *, indent: int = -1) -> None:
    """Print a value as JSON, on one line unless `indent` is 0 or more."""
    import msgspec

    line = printable_json(msgspec.json.encode(value).decode())
    print(msgspec.json.format(line, indent=indent), flush=True)


def print_progress(line: str) -> None:
    """Print a line to stderr, so that stdout contains only the result."""
    import sys

    print(printable(line), file=sys.stderr, flush=True)


def print_table(table: "Table") -> None:
    """Print a table in the width of the terminal; in a pipe in PIPE_COLUMNS."""
    import sys

    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else PIPE_COLUMNS).print(table)
