"""Imports objects by "module:name" or from entry points; and returns this package's version."""

import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

from gigabrain_zenoh.errors import ConfigError, unknown

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints


def find(path: str) -> Any:
    """Import and return the object at "module:name". Raises ImportError or AttributeError."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


@cache
def package_version() -> str:
    """Return the version of the installed package. The first call takes 25 ms."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("gigabrain-zenoh")
    except PackageNotFoundError:  # a checkout without an installation
        return "0+unknown"


def offered(group: str) -> "EntryPoints":
    """Return the entry points of a group that installed packages offer."""
    folders = tuple((folder, _changed_ns(folder or ".")) for folder in sys.path)
    points: EntryPoints = _entry_points(folders).select(group=group)
    return points


def _changed_ns(folder: str) -> int:
    try:
        return os.stat(folder).st_mtime_ns
    except OSError:
        return 0


@lru_cache(maxsize=1)
def _entry_points(_folders: tuple[tuple[str, int], ...]) -> Any:  # its type depends on Python
    """Return all entry points, cached while no package changes. Takes 20 ms for 100 packages."""
    from importlib.metadata import entry_points  # takes 1 MB, and few processes need it

    return entry_points()


def plugin_names(shipped: Mapping[str, Any], group: str) -> list[str]:
    """Return the names of the shipped objects and of the entry points of a group."""
    return list(dict.fromkeys((*shipped, *(point.name for point in offered(group)))))


def load_plugin(
    kind: str, name: str, shipped: Mapping[str, Any], group: str, parts: Sequence[str] = ()
) -> Any:
    """Return the object called `name`: a shipped one, or an entry point of `group`.

    The values of `shipped` are objects, or strings "module:name". Raises UnknownName with all
    names, and ConfigError if the import fails, or if the object lacks an attribute of `parts`.
    """
    if name in shipped:
        found = shipped[name]
        return find(found) if isinstance(found, str) else found
    points = {point.name: point for point in offered(group)}
    if name not in points:
        raise unknown(kind, name, plugin_names(shipped, group))
    where = f"{kind} {name!r} of {points[name].value}"
    try:
        found = points[name].load()
    except Exception as error:  # noqa: BLE001 - a package may raise anything
        text = error if isinstance(error, ImportError | AttributeError) else repr(error)
        raise ConfigError(f"{where}: {text}") from None
    if missing := [part for part in parts if not hasattr(found, part)]:
        text = f"a {type(found).__name__} without {missing[0]}; see docs/how-to/your_own_process.md"
        raise ConfigError(f"{where}: {text}")
    return found
