"""Imports numba without optional packages that it looks for and this project does not use.

Where these packages are installed, importing them takes as long as loading all our kernels. They
are scipy's BLAS, coverage's measuring of compiled functions, and cffi with its C parser.
"""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

UNUSED = ("scipy.linalg", "coverage", "cffi")
# the submodules look for BLAS and cffi; unless imported here, they do so at the first call
PARTS = ("numba", "numba.np.arraymath", "numba.core.typing.cffi_utils")


def load() -> Any:
    """Import numba, and return its module."""
    with _as_if_missing(*UNUSED):
        for part in PARTS:
            importlib.import_module(part)
    return sys.modules["numba"]


@contextmanager
def _as_if_missing(*names: str) -> Iterator[None]:
    """Make modules that are not yet imported unimportable inside the block."""
    modules: dict[str, Any] = sys.modules
    hidden = [name for name in names if name not in modules]
    modules.update(dict.fromkeys(hidden))
    try:
        yield
    finally:
        for name in hidden:
            del modules[name]
