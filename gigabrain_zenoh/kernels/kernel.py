"""Functions compiled by numba, and where what was compiled is kept."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

import numpy as np
from platformdirs import user_cache_path

from gigabrain_zenoh.kernels import numba_alone

F = TypeVar("F", bound=Callable[..., object])

numba = numba_alone.load()
PACKAGE = Path(__file__).parents[1]
NONE, ONE, TWO = np.int64(0), np.int64(1), np.int64(2)  # as literals they are compiled for apart
HOLDERS = ("mapping", "navigation", "qa/bench")  # packages with kernels


def kernel(function: F) -> F:
    """Compile `function` at its first call, without the GIL while it runs.

    What was compiled is kept in NUMBA_CACHE_DIR, or in the user's cache folder; where neither can
    be written it is compiled anew in each process.
    """
    return _compiled(function, lean=False)


def lean_kernel(function: F) -> F:
    """Compile a `function` that makes no arrays and is called very often, by kernels.

    It is compiled into those that call it, and does not count references to the arrays that it is
    given: with some of them in tuples both took longer than the work. One that makes arrays is
    refused by numba.
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
    """A folder for kernels of exactly these sources; None for a user without a home.

    Numba notices a change in a kernel's own file and none in those that it calls.
    """
    try:
        return user_cache_path("gigabrain") / f"kernels-{_digest()}"
    except RuntimeError:
        return None


def mark_of(warm_up: str) -> Path | None:
    """The file that says that all of `warm_up` is kept, for this processor.

    None where nothing can be kept.
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
        for source in sorted((PACKAGE / holder).glob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


if folder := cache_folder():
    os.environ.setdefault("NUMBA_CACHE_DIR", str(folder))
    numba.core.config.reload_config()
