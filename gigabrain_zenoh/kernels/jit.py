"""Compiles functions with numba, and keeps the result on disk.

Numba is imported without optional packages that are not used here (scipy's BLAS, coverage, cffi):
importing those takes as long as loading all kernels.
"""

import hashlib
import importlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from platformdirs import user_cache_path

UNUSED = ("scipy.linalg", "coverage", "cffi")
# the submodules look for BLAS and cffi; unless imported here, they do so at the first call
PARTS = ("numba", "numba.np.arraymath", "numba.core.typing.cffi_utils")

F = TypeVar("F", bound=Callable[..., object])
PACKAGE = Path(__file__).parents[1]
NONE, ONE, TWO = np.int64(0), np.int64(1), np.int64(2)  # as literals they are compiled for apart
HOLDERS = ("kernels", "manipulation", "mapping", "navigation", "qa/bench")  # packages with kernels


def _import_numba() -> Any:
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


numba = _import_numba()


def kernel(function: F) -> F:
    """Compile `function` at its first call; it runs without the GIL.

    The result is kept in NUMBA_CACHE_DIR, or in the user's cache folder. If neither can be written,
    each process compiles again.
    """
    return _compiled(function, lean=False)


def lean_kernel(function: F) -> F:
    """Compile a `function` that makes no arrays and is called very often by kernels.

    It is inlined into its callers, and does not count references to its arrays: counting took
    longer than the work. Numba refuses one that makes arrays.
    """
    return _compiled(function, lean=True)


def _compiled(function: F, *, lean: bool) -> F:
    options = {"nogil": True, "error_model": "numpy", "_nrt": not lean, "forceinline": lean}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba: no locator available
        compiled = numba.njit(**options)(function)
    return cast("F", compiled)


def cache_folder() -> Path | None:
    """Return the cache folder for kernels of exactly these sources; None for a user without a home.

    Numba notices changes in a kernel's own file only, not in those of the kernels it calls. It
    finds nothing for the same file at another place, as in a second checkout, or of another time.
    """
    try:
        return user_cache_path("gigabrain") / f"kernels-{_digest()}"
    except RuntimeError:
        return None


def mark_of(warm_up: str) -> Path | None:
    """Return the file that marks all of `warm_up` as compiled for this processor.

    None if nothing can be kept.
    """
    from llvmlite.binding import get_host_cpu_name

    folder = Path(os.environ.get("NUMBA_CACHE_DIR", os.devnull))
    machine = f"{numba.__version__}-{get_host_cpu_name()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder / f"{warm_up.replace(':', '.')}-{_digest()}-{machine}"


def _digest() -> str:
    digest = hashlib.sha256()
    for holder in HOLDERS:
        for source in sorted((PACKAGE / holder).rglob("*.py")):
            digest.update(source.read_bytes())
            digest.update(f"{source} {source.stat().st_mtime_ns}".encode(errors="replace"))
    return digest.hexdigest()[:16]


if folder := cache_folder():
    os.environ.setdefault("NUMBA_CACHE_DIR", str(folder))
    numba.core.config.reload_config()
