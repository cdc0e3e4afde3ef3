"""Lazy import of an object named by a string, "module:name"."""

import importlib
from typing import Any


def find(path: str) -> Any:
    """Import and return the object at "module:name". Raises ImportError or AttributeError."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)
