"""Functions compiled by numba."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """Compile `function` at its first call, without the GIL while it runs.

    What was compiled is kept beside its source, or in NUMBA_CACHE_DIR where that cannot be written.
    """
    return cast("F", numba.njit(cache=True, nogil=True, error_model="numpy")(function))
