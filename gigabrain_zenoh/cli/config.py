"""`gigabrain config`, and the settings that `up` and `demo` merge."""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from gigabrain_zenoh.cli.node import ask_params
from gigabrain_zenoh.cli.options import LOCAL, RobotAddress, print_line
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.host.files import expanded

if TYPE_CHECKING:
    from msgspec import Struct

    from gigabrain_schemas.body import BodyDescription
    from gigabrain_zenoh.config.layers import Row
    from gigabrain_zenoh.config.settings import LinkName
    from gigabrain_zenoh.launch.deployment import Deployment
    from gigabrain_zenoh.launch.merging import MergedDeployment

Sets = Annotated[
    tuple[str, ...],
    Parameter(help="Any setting, as KEY=VALUE, such as stop_margin=0.1; may be given again."),
]
SettingsFiles = Annotated[
    tuple[Path, ...],
    Parameter(help="File with further settings, as `param save` writes; may be given again."),
]
MAX_COLUMN_CHARS = 60


def config(
    deployment: str = "",
    *,
    settings: SettingsFiles = (),
    set: Sets = (),
    at: RobotAddress = LOCAL,
) -> None:
    """Print all settings of a deployment, and where each value comes from.

    Example: gigabrain config demo --set seed=3

    Without a deployment it prints the settings of the robot that runs on this machine, with its
    parameters as they are now.

    Args:
        deployment: Deployment file, or the name of a known one.
    """
    if deployment:
        merged = merged_file(deployment, settings, set)
        merged.check_behaviour()
        rows: Iterable[Row] = rows_of(merged)
    elif settings or set:
        raise ConfigError("--set and --settings need a deployment file; expected its name first")
    else:
        rows = _running_rows(at)
    cells = [
        (row.key, json.dumps(row.value, ensure_ascii=False), _relative(row.source))
        for row in sorted(rows, key=lambda row: row.key)
    ]
    widths = [min(MAX_COLUMN_CHARS, max(len(cell[i]) for cell in cells)) for i in range(2)]
    for key, value, source in cells:
        print_line(f"{key:<{widths[0]}}  {value:<{widths[1]}}  {source}")


def _relative(source: str) -> str:
    """Return a source, with a file in the current folder as a relative path."""
    path = Path(source)
    if path.is_absolute() and path.is_relative_to(Path.cwd()):
        return str(path.relative_to(Path.cwd()))
    return source


def merged_file(
    name: str, files: Sequence[Path], sets: Sequence[str], keys: Path | None = None
) -> "MergedDeployment":
    """Merge a deployment file with settings files and `--set`. Raises ConfigError."""
    from gigabrain_zenoh.launch.deployment import deployment_path
    from gigabrain_zenoh.launch.merging import file_layers, merge

    path = deployment_path(name)
    folder = str(expanded(keys).absolute()) if keys else ""
    return merge(file_layers(path), files, sets, robot_type, folder)


def merged_values(
    values: Mapping[str, Any], files: Sequence[Path], sets: Sequence[str]
) -> "MergedDeployment":
    """Merge the deployment of a demo with settings files and `--set`. Raises ConfigError."""
    from gigabrain_zenoh.launch.merging import merge, value_layers

    merged = merge(value_layers(values, "gigabrain demo"), files, sets, robot_type)
    merged.check_behaviour()
    return merged


def rows_of(
    merged: "MergedDeployment", deployment: "Deployment | None" = None, *, robot: bool = True
) -> tuple["Row", ...]:
    """Return all settings of a deployment and of the robot's file, with their sources.

    Raises ConfigError, also for invalid settings of the robot, or ones that its body cannot use.
    """
    from gigabrain_drivers.driver.catalog import (
        link_type,
        load_layers,
        robot_layers,
        robot_path,
    )
    from gigabrain_drivers.driver.robot import Run
    from gigabrain_zenoh.config.layers import DEFAULT
    from gigabrain_zenoh.config.loading import part
    from gigabrain_zenoh.decision import behaviours
    from gigabrain_zenoh.launch.merging import SETTINGS

    layers, final = merged.layers, deployment or merged.deployment
    rows = [row for row in layers.rows(final) if not row.key.startswith("robot")]
    with suppress(UnknownName):  # its package may be on another host
        kind = behaviours.load(final.decision.behaviour).Config
        settings = layers.convert(kind, SETTINGS.split("."))
        rows = [row for row in rows if not row.key.startswith(SETTINGS)]
        rows += layers.rows(settings, SETTINGS.split("."))
    if not robot:
        return tuple(rows)
    path = robot_path(final.body)
    own = robot_layers(path)
    if final.robot:
        own.add(part(layers.root, ("robot",)), layers.place)
    # raises for unsafe settings
    found, *_ = load_layers(path, own, Run(folder=Path(), link=final.link))
    chosen = any(row.key == "decision.behaviour" and row.source != DEFAULT for row in rows)
    _check_fits(final, found.description(), chosen=chosen)
    whole = own.convert(link_type(final.body, final.link))
    rows += [row._replace(key=f"robot.{row.key}") for row in own.rows(whole)]
    return tuple(rows)


def _check_fits(deployment: "Deployment", body: "BodyDescription", *, chosen: bool) -> None:
    """Raise ConfigError for a map, or a `chosen` behaviour, that the body cannot use."""
    if deployment.perception.map and not body.has_base:
        raise ConfigError(
            f"perception.map: {body.robot_type} has no base, so it cannot localize in a map; leave "
            "the map out",
            value=deployment.perception.map,
        )
    decides = any("decision" in processes for processes in deployment.hosts.values())
    avoids = chosen and deployment.decision.behaviour == "avoid"
    if decides and avoids and body.turning_radius:
        raise ConfigError(
            f"behaviour avoid turns on the spot, and {body.robot_type} cannot: its tightest turn "
            f"has a radius of {body.turning_radius:.2f} m; use the behaviour navigate",
            value="avoid",
        )


def robot_type(body: str, link: "LinkName") -> "type[Struct]":
    """Return the type of a robot's file, with the options of a link. Raises ConfigError."""
    from gigabrain_drivers.driver.catalog import link_type

    return link_type(body, link)


def _running_rows(at: RobotAddress) -> list["Row"]:
    from gigabrain_zenoh.launch.merging import read_rows
    from gigabrain_zenoh.runtime.running import find_running

    if at.connect:
        raise ConfigError(
            "--connect: only the robot's host knows all settings; run this there, or see `param`"
        )
    robot = find_running(at.namespace)
    if not robot.run_dir:
        raise ConfigError(f"{robot.label} was not started by `up` or `demo`; see `param list`")
    rows = {row.key: row for row in read_rows(Path(robot.run_dir))}
    for reply in ask_params(at).values():
        for param in reply.params:
            if param.key in rows and param.value != param.initial:
                source = f"param, was {param.initial}"
                row = rows[param.key]
                rows[param.key] = row._replace(value=_value(param.value), source=source)
    return list(rows.values())


def with_values(path: Path, values: Mapping[str, str]) -> str:
    """Return the YAML of a settings file with some `values` replaced (texts by dotted key).

    Raises ConfigError for a file without settings, or with comments, which would be lost.
    """
    import yaml

    from gigabrain_zenoh.config.layers import Layers, assignment
    from gigabrain_zenoh.config.loading import document, read
    from gigabrain_zenoh.config.yaml_text import comment_line

    layers = Layers(str(path))
    if path.exists():
        text = read(path)
        root = document(text, str(path))
        if root.entries is None:
            raise ConfigError(f"{path}:{root.line}: expected a mapping of settings")
        if line := comment_line(text):
            raise ConfigError(
                f"{path}:{line}: has a comment, which would be lost; save to another file"
            )
        layers.add(root, lambda line: f"{path}:{line}")
    for key, value in values.items():
        layers.add(assignment(f"{key}={value}").nested(), lambda _: "param")
    return yaml.safe_dump(layers.root.value, sort_keys=False)


def _value(text: str) -> Any:
    from gigabrain_zenoh.config.layers import assignment

    return assignment(f"value={text}").node.value
