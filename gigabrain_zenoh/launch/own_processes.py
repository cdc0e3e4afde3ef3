"""The user's own processes: modules and perceptors that a deployment file names.

They run in the same frame as ours. Only their own process imports their code, so a module that
raises or hangs affects no other process.
"""

import functools
import importlib
import inspect
from collections.abc import Callable, Collection, Mapping
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from gigabrain_schemas.topics import PERCEIVED
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config import loading
from gigabrain_zenoh.config.settings import OwnPerceptor, OwnProcess, ProcessConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.process import ProcessType
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.security.acl import check_write

if TYPE_CHECKING:
    from gigabrain_zenoh.launch.deployment import Deployment

MAX_OWN = 32  # of one robot
MODULES, PERCEPTORS = "processes", "perceptors"  # parts of a deployment file
OWN = ProcessType("")
Ready = Callable[[], None]


def check_entries(
    processes: Mapping[str, OwnProcess],
    perceptors: Mapping[str, OwnPerceptor],
    known: Collection[str],
) -> None:
    """Raise ValueError, which begins with the place in the file, for invalid entries."""
    names = [*processes, *perceptors]
    if len(names) > MAX_OWN:
        raise ValueError(f"processes: {len(names)} of your own; expected at most {MAX_OWN}")
    for part, entries in ((MODULES, processes), (PERCEPTORS, perceptors)):
        for name in entries:
            if name in known or names.count(name) > 1:
                raise ValueError(f"{part}.{name}: a process has that name already; choose another")
    for name, entry in processes.items():
        for i, key in enumerate(entry.writes):
            try:
                check_write(key)
            except ValueError as error:
                raise ValueError(f"{MODULES}.{name}.writes[{i}]: {error}") from None


def own_type(deployment: "Deployment", name: str) -> ProcessType | None:
    """Return the row of one of the user's own processes; None for another name."""
    if entry := deployment.processes.get(name):
        return ProcessType(entry.module, writes=entry.writes)
    if name in deployment.perceptors:
        return ProcessType("", writes=(PERCEIVED.at(name),))
    return None


def own_config(deployment: "Deployment", name: str, file: str) -> dict[str, Any]:
    """Return the fields of a ProcessConfig for one of the user's own processes; else none."""
    if entry := deployment.processes.get(name):
        return {"module": entry.module, "settings": entry.settings, "file": file}
    if perceptor := deployment.perceptors.get(name):
        return {
            "perceptor": perceptor.perceptor or name,
            "settings": perceptor.settings,
            "file": file,
        }
    return {}


def unknown_to_router(deployment: "Deployment", host: str, shipped: Collection[str]) -> str:
    """Return a warning for processes that the router may not know, or an empty text."""
    here = [name for name in deployment.hosts[host] if name not in shipped]
    routes = any("router" in names for names in deployment.hosts.values())
    if routes or not deployment.keys or not here:
        return ""
    return (
        f"{', '.join(here)}: the router at {deployment.router} is not in this file, and drops "
        "their messages if it does not know them; declare them in its file too, or install their "
        "package on its host"
    )


def check_installed(deployment: "Deployment", host: str, file: str) -> None:
    """Raise ConfigError for a module or perceptor that this host lacks, without importing it."""
    from gigabrain_zenoh.perception.perceptors import check_known

    for name in deployment.hosts[host]:
        if entry := deployment.processes.get(name):
            module = entry.module.partition(":")[0]
            if not _exists(module):
                text = f"no module {module!r} is installed; `pip install` its package"
                raise _at(file, (MODULES, name, "module"), text)
        elif perceptor := deployment.perceptors.get(name):
            try:
                check_known(perceptor.perceptor or name)
            except ConfigError as error:
                raise _at(file, (PERCEPTORS, name, "perceptor"), str(error)) from None


def _exists(module: str) -> bool:
    """Return whether a module exists, without importing its package."""
    top, *parts = module.split(".")
    try:
        spec = find_spec(top)
    except (ImportError, ValueError):
        return False
    path = top
    for part in parts:
        if spec is None or spec.submodule_search_locations is None:
            return False
        path = f"{path}.{part}"
        spec = PathFinder.find_spec(path, list(spec.submodule_search_locations))
    return spec is not None


def load_own(config: ProcessConfig) -> tuple[ProcessType, Node]:
    """Return the row and the node of one of the user's own processes. Raises ConfigError."""
    if config.perceptor:
        from gigabrain_zenoh.perception import perceptors

        perceptor = perceptors.load(config.perceptor)
        settings = _settings(config, perceptor.Config, (PERCEPTORS, config.name, "settings"))
        return OWN, functools.partial(perceptors.run, perceptor(settings))
    path, _, function = config.module.partition(":")
    function = function or "run"
    place = (MODULES, config.name, "module")
    try:
        module = importlib.import_module(path)
    except ImportError as error:
        raise _at(config.file, place, f"cannot import {path}: {error}") from None
    node = getattr(module, function, None)
    expected = f"expected async def {function}(config, bus, ready)"
    wrong = _at(config.file, place, f"{path} has no coroutine {function!r}; {expected}")
    if not callable(node):
        raise wrong
    kind = getattr(module, "Config", NoSettings)
    settings = _settings(config, kind, (MODULES, config.name, "settings"))
    return OWN, functools.partial(_run, settings, node, wrong)


async def _run(
    config: Struct, node: Callable[..., Any], wrong: ConfigError, bus: Bus, ready: Ready
) -> None:
    """Run the node of a module; raise `wrong` if it is not a coroutine function."""
    running = node(config, bus, ready)
    if not inspect.isawaitable(running):
        raise wrong
    await running


def failing_on_bus(load: Callable[[], Node]) -> Node:
    """Return the node from `load`, or a node that raises the error of `load`.

    The process is then on the bus before the error, so that `why` and `doctor` can show it.
    """
    try:
        return load()
    except Exception as error:  # noqa: BLE001 - the node raises it
        return functools.partial(_fail, error)


async def _fail(error: Exception, _bus: Bus, _ready: Ready) -> None:
    raise error


class NoSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a module without a Config."""


def _settings(config: ProcessConfig, kind: type[Struct], place: tuple[str, ...]) -> Struct:
    """Return settings as the Struct `kind`. Raises ConfigError with file and line."""
    try:
        return msgspec.convert(config.settings, kind)
    except msgspec.ValidationError as error:
        text = f"{'.'.join(place)}: {error}"
    if config.file:  # raises the same error with its line
        loading.loads(loading.read(Path(config.file)), kind, config.file, at=place)
    raise ConfigError(text)


def _at(file: str, place: tuple[str, ...], text: str) -> ConfigError:
    """Return an error with the line of `place` in the deployment file."""
    line = loading.line_in(Path(file), place) if file else None
    return ConfigError(f"{f'{file}:{line}: ' if line else ''}{'.'.join(place)}: {text}")
