"""Numba without what it looks for and we do not use.

Where these packages happen to be installed, their import takes as long as loading all our kernels:
scipy's BLAS, coverage's measuring of compiled functions, and cffi with its parser of C.
"""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

UNUSED = ("scipy.linalg", "coverage", "cffi")
# the others look for BLAS and for cffi, at the first call otherwise
PARTS = ("numba", "numba.np.arraymath", "numba.core.typing.cffi_utils")


def load() -> Any:
    """Import numba."""
    with _as_if_missing(*UNUSED):
        for part in PARTS:
            importlib.import_module(part)
    return sys.modules["numba"]


@contextmanager
def _as_if_missing(*names: str) -> Iterator[None]:
    """Modules that are not imported yet cannot be imported meanwhile."""
    modules: dict[str, Any] = sys.modules
    hidden = [name for name in names if name not in modules]
    modules.update(dict.fromkeys(hidden))
    try:
        yield
    finally:
        for name in hidden:
            del modules[name]
