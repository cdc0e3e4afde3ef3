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
# without its submodules here, numba would look for BLAS and cffi at the first call
NUMBA_MODULES = ("numba", "numba.np.arraymath", "numba.core.typing.cffi_utils")

F = TypeVar("F", bound=Callable[..., object])
NONE = np.int64(0)  # a literal would be compiled separately


@functools.cache
def import_numba() -> Any:
    """Import numba, with `cache.kernel_folder` as its cache."""
    if folder := cache.cache_folder():
        os.environ.setdefault(cache.FOLDER, str(folder))
    with _unimportable(*UNUSED):
        for module in NUMBA_MODULES:
            importlib.import_module(module)
    numba: Any = sys.modules["numba"]
    numba.core.config.reload_config()
    return numba


@contextmanager
def _unimportable(*names: str) -> Iterator[None]:
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


def _noting_errors(save: Callable[..., None]) -> Callable[..., None]:
    """Return `save` with its OSErrors put into `unsaved`; numba would raise them from a kernel."""

    def save_or_note(*arguments: object) -> None:
        try:
            save(*arguments)
        except OSError as error:
            unsaved.append(error)

    return save_or_note


class Kernel:
    """A compiled function. Other kernels may call it as well."""

    def __init__(self, function: Callable[..., Any], *, lean: bool) -> None:
        functools.update_wrapper(self, function)
        self.function, self._lean = function, lean
        self.name = f"{function.__module__}:{function.__qualname__}"
        self.called = False  # True once numba has run it for a caller in Python

    def __call__(self, *arguments: Any) -> Any:
        """Call the kernel; it runs without the GIL."""
        for matches, function in self._linked:
            if matches(arguments):
                return function(*arguments)
        self.called = True
        return self.dispatcher(*arguments)

    @property
    def overloads(self) -> int:
        """Number of signatures for which it is compiled, in a library or in this process."""
        by_numba = len(self.dispatcher.signatures) if "dispatcher" in vars(self) else 0
        return len(self._linked) + by_numba

    @functools.cached_property
    def _linked(self) -> linked.Overloads:
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
        dispatcher._cache.save_overload = _noting_errors(dispatcher._cache.save_overload)
        return dispatcher

    @property
    def _numba_type_(self) -> Any:
        """Numba's type of this function, for kernels that call it."""
        return self.dispatcher._numba_type_


def kernel(function: F) -> F:
    """Return `function` as a compiled kernel."""
    return cast("F", Kernel(function, lean=False))


def lean_kernel(function: F) -> F:
    """Return `function` as a kernel for very frequent calls by other kernels.

    It is inlined into its callers, without reference counts of its arrays: counting took longer
    than the work. Numba refuses a function that creates arrays.
    """
    return cast("F", Kernel(function, lean=True))
