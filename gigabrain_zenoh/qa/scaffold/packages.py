"""Writes the package of a new process, perceptor or behaviour; it runs, and its test passes."""

import keyword
import re
from collections.abc import Collection, Mapping
from importlib import resources
from pathlib import Path
from string import Template
from typing import Literal

from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import cannot_write
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.processes import GROUP, PROCESSES
from gigabrain_zenoh.perception import perceptors
from gigabrain_zenoh.plugins import plugin_names
from gigabrain_zenoh.security.acl import check_write

Kind = Literal["process", "perceptor", "behaviour"]
PACKAGE_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}[a-z0-9]")
GROUPS: Mapping[Kind, tuple[str, str]] = {  # group of entry points, and the object that one names
    "process": ("gigabrain.processes", "row:ROW"),
    "perceptor": ("gigabrain.perceptors", "perceptor:${camel}"),
    "behaviour": ("gigabrain.behaviours", "behaviour:${camel}"),
}
COMMON = {"pyproject.toml.txt": "pyproject.toml", "init.py.txt": "${package}/__init__.py"}
FILES: Mapping[Kind, Mapping[str, str]] = {  # source and target of each file
    "process": {
        "process_readme.md.txt": "README.md",
        "row.py.txt": "${package}/row.py",
        "node.py.txt": "${package}/node.py",
        "test_node.py.txt": "tests/test_node.py",
    },
    "perceptor": {
        "perceptor_readme.md.txt": "README.md",
        "perceptor.py.txt": "${package}/perceptor.py",
        "test_perceptor.py.txt": "tests/test_perceptor.py",
    },
    "behaviour": {
        "behaviour_readme.md.txt": "README.md",
        "behaviour.py.txt": "${package}/behaviour.py",
        "test_behaviour.py.txt": "tests/test_behaviour.py",
    },
}


def write_package(kind: Kind, name: str, folder: Path) -> Path:
    """Create the folder NAME-KIND and return it.

    Raises ConfigError if it exists, or if the name is taken.
    """
    camel = "".join(part.capitalize() for part in name.split("_"))
    if not PACKAGE_NAME.fullmatch(name) or {name, camel} & {*keyword.kwlist}:
        raise ConfigError(
            f"{name!r}: expected lower-case letters, digits and underscores, such as my_lamp"
        )
    if name in _taken_names(kind) or (kind == "process" and not _may_write(name)):
        raise ConfigError(f"the name {name!r} is taken; choose another")
    path = folder / f"{name.replace('_', '-')}-{kind}"
    words = {
        "name": name,
        "kind": kind,
        "package": f"{name}_{kind}",
        "dashed": path.name,
        "camel": camel,
    }
    group, where = GROUPS[kind]
    words |= {"group": group, "where": Template(where).substitute(words)}
    try:
        path.mkdir(parents=True)
        for source, target in {**COMMON, **FILES[kind]}.items():
            text = (resources.files(__package__) / "template" / source).read_text(encoding="utf-8")
            file = path / Template(target).substitute(words)
            file.parent.mkdir(exist_ok=True)
            file.write_text(Template(text).substitute(words), encoding="utf-8")
    except FileExistsError:
        raise ConfigError(f"{path} exists; nothing was written") from None
    except OSError as error:
        raise cannot_write(path, error) from None
    return path


def _taken_names(kind: Kind) -> Collection[str]:
    """Return the names that other packages of this kind, or settings, already use."""
    if kind == "behaviour":
        return behaviours.names()
    processes = plugin_names(PROCESSES, GROUP)
    if kind == "perceptor":  # it runs in a process with its name
        return [*processes, *plugin_names(perceptors.SHIPPED, perceptors.GROUP)]
    return [*processes, *Deployment.__struct_fields__]  # its settings are a field of that file


def _may_write(name: str) -> bool:
    """Return whether the keys below `robot/NAME` are free of topics and services."""
    try:
        check_write(f"robot/{name}/**")
    except ValueError:
        return False
    return True
