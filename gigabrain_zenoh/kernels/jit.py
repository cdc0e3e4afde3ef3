"""Compiled functions, from a linked library or else from numba.

Numba is only imported if a kernel is not in a library. It is imported without optional packages
that are not used here (scipy's BLAS, coverage, cffi): their import takes as long as loading all
kernels.
"""

import functools
import importlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numpy as np

from gigabrain_zenoh.kernels import cache, linked

UNUSED = ("scipy.linalg", "coverage", "cffi")
# these submodules look for BLAS and cffi; otherwise that happens at the first call
PARTS = ("numba", "numba.np.arraymath", "numba.core.typing.cffi_utils")

F = TypeVar("F", bound=Callable[..., object])
NONE = np.int64(0)  # a literal would be compiled separately


@functools.cache
def import_numba() -> Any:
    """Import numba, with `cache.kernel_folder` as its cache."""
    if folder := cache.cache_folder():
        os.environ.setdefault(cache.FOLDER, str(folder))
    with _as_if_missing(*UNUSED):
        for part in PARTS:
            importlib.import_module(part)
    numba: Any = sys.modules["numba"]
    numba.core.config.reload_config()
    return numba


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


unsaved: list[OSError] = []  # errors when this process saved compiled kernels


def _if_possible(save: Callable[..., None]) -> Callable[..., None]:
    """Return `save` without its OSErrors, which numba would raise from a kernel."""

    def saved(*arguments: object) -> None:
        try:
            save(*arguments)
        except OSError as error:
            unsaved.append(error)

    return saved


class Kernel:
    """A compiled function. Other kernels may call it as well."""

    def __init__(self, function: Callable[..., Any], *, lean: bool) -> None:
        functools.update_wrapper(self, function)
        self.function, self._lean = function, lean
        self.name = f"{function.__module__}:{function.__qualname__}"
        self.called = False  # from Python, with numba

    def __call__(self, *arguments: Any) -> Any:
        """Call the kernel; it runs without the GIL."""
        for takes, function in self._linked:
            if takes(arguments):
                return function(*arguments)
        self.called = True
        return self.dispatcher(*arguments)

    @property
    def overloads(self) -> int:
        """Number of signatures for which it is compiled, in a library or in this process."""
        here = len(self.dispatcher.signatures) if "dispatcher" in vars(self) else 0
        return len(self._linked) + here

    @functools.cached_property
    def _linked(self) -> tuple[tuple[linked.Takes, Callable[..., Any]], ...]:
        return linked.overloads_of(self.name)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's dispatcher: it compiles the function at the first call with new types.

        The result is kept in NUMBA_CACHE_DIR, or in the user's cache folder. If that cannot be
        written, each process compiles again.
        """
        numba, lean = import_numba(), self._lean
        options = {"nogil": True, "error_model": "numpy", "_nrt": not lean, "forceinline": lean}
        try:
            dispatcher = numba.njit(cache=True, **options)(self.function)
        except RuntimeError:  # numba: no locator available
            return numba.njit(**options)(self.function)
        dispatcher._cache.save_overload = _if_possible(dispatcher._cache.save_overload)
        return dispatcher

    @property
    def _numba_type_(self) -> Any:
        """Numba's type of this function, for kernels that call it."""
        return self.dispatcher._numba_type_


def kernel(function: F) -> F:
    """Return `function` as a kernel, which is compiled."""
    return cast("F", Kernel(function, lean=False))


def lean_kernel(function: F) -> F:
    """Return `function` as a kernel for very frequent calls by other kernels.

    It is inlined into its callers, without reference counts of its arrays: counting took longer
    than the work. Numba refuses a function that creates arrays.
    """
    return cast("F", Kernel(function, lean=True))
