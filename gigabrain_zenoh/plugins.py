"""Finds what is named by a string, "module:name", and imports it only then."""

import importlib
from typing import Any


def find(path: str) -> Any:
    """Return the object at "module:name". Raises ImportError, and AttributeError."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)
