"""Merges a deployment file, settings files and `--set` into one deployment."""

import contextlib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct, structs

from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.config import loading
from gigabrain_zenoh.config.layers import Layers, Row, assignment, full_key, keys_of
from gigabrain_zenoh.config.settings import DecisionConfig, LinkName
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.host.files import read_bounded, replace_file
from gigabrain_zenoh.host.network import host_shown
from gigabrain_zenoh.launch.deployment import (
    Deployment,
    deployment_type,
    own_names,
    with_files,
)

log = logging.getLogger(__name__)
ROWS_FILE, MAX_ROWS_BYTES = "config.json", 1_000_000
SETTINGS = "decision.settings"
SET_FIRST = "body", "link"  # they depend on each other, and other keys depend on them
# returns the type of a robot's file, for its name or path and the link
RobotType = Callable[[str, LinkName], type[Struct]]


class MergedDeployment(NamedTuple):
    """A deployment, and the sources of its values."""

    layers: Layers
    deployment: Deployment

    def check_behaviour(self) -> None:
        """Raise ConfigError or UnknownName, with the place, for a behaviour that cannot run."""
        kind = behaviours.load(self.deployment.decision.behaviour).Config
        self.layers.convert(kind, SETTINGS.split("."))
        behaviours.check(self.deployment.decision)


def file_layers(path: Path) -> Layers:
    """Return the settings of a deployment file. Raises ConfigError."""
    layers = Layers(str(path))
    _add_file(layers, path)
    return layers


def value_layers(values: Mapping[str, Any], source: str) -> Layers:
    """Return settings given by a command."""
    layers = Layers(source)
    layers.add_values(values, source)
    return layers


def merge(
    layers: Layers,
    files: Sequence[Path],
    sets: Iterable[str],
    robot_type: RobotType,
    keys: str = "",
) -> MergedDeployment:
    """Merge settings files and `--set KEY=VALUE` into a deployment; `keys` replaces its keys.

    Raises ConfigError and UnknownName, with the place of the value.
    """
    for file in files:
        _add_file(layers, file)
    for text in sorted(sets, key=lambda text: assignment(text).key not in SET_FIRST):
        given = assignment(text)
        first = given.key in SET_FIRST
        key = given.key if first else full_key(given.key, _keys(layers, robot_type), SETTINGS)
        value = with_files(given._replace(key=key).nested(), Path())
        place = f"--set {host_shown(text)}"
        layers.add(value, lambda _, place=place: place)  # type: ignore[misc]
    deployment = layers.convert(_type_of(layers))
    return MergedDeployment(layers, structs.replace(deployment, keys=keys or deployment.keys))


def write_rows(run_dir: Path, rows: Sequence[Row]) -> None:
    """Write the settings of a run and their sources into its folder.

    Only `gigabrain config` reads them, so on a full disk the robot starts without the file.
    """
    try:
        if rows:
            replace_file(run_dir / ROWS_FILE, msgspec.json.encode(rows), 0o600)
    except OSError as error:
        log.warning("cannot write %s: %s", run_dir / ROWS_FILE, error.strerror)


def read_rows(run_dir: Path) -> list[Row]:
    """Return the settings of a run. Raises ConfigError without a valid file."""
    path = run_dir / ROWS_FILE
    try:
        return msgspec.json.decode(read_bounded(path, MAX_ROWS_BYTES), type=list[Row])
    except (OSError, *DECODE_ERRORS):
        raise ConfigError(f"{path} cannot be read; name the robot's deployment file") from None


def _add_file(layers: Layers, path: Path) -> None:
    root = loading.document(loading.read(path), str(path))
    if root.entries is None:
        raise ConfigError(f"{path}:{root.line}: expected a mapping of settings")
    layers.add(with_files(root, path.absolute().parent), lambda line: f"{path}:{line}")


def _type_of(layers: Layers) -> type[Deployment]:
    return deployment_type(own_names(layers.root))


class _Choices(Struct, frozen=True, kw_only=True):
    """The settings that determine which other settings exist."""

    body: str = Deployment().body
    link: LinkName = Deployment().link
    decision: DecisionConfig = DecisionConfig()


def _keys(layers: Layers, robot_type: RobotType) -> list[str]:
    """Return all keys that may be set; the settings may still contradict each other."""
    kind, choices = _type_of(layers), layers.convert(_Choices)
    known = {"robot": robot_type(choices.body, choices.link)}
    with contextlib.suppress(UnknownName):  # its package may be on another host
        known[SETTINGS] = behaviours.load(choices.decision.behaviour).Config
    return list(keys_of(kind, known))
