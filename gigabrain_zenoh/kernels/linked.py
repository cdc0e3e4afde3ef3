"""Kernels in shared libraries, which run without numba: numba takes 70 MB and 0.4 s.

`linking` writes a library, and an index of its functions with their argument types.
"""

import functools
import importlib.util
import logging
import operator
from collections.abc import Callable
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from gigabrain_zenoh.kernels import cache

log = logging.getLogger(__name__)
MODULE = "linked_kernels"  # name of each library as a Python module
LIBRARY, INDEX = ".so", ".json"
SCALARS: dict[str, tuple[type, ...]] = {
    "bool": (bool, np.bool_),
    "int64": (int, np.int64),
    "float64": (float, np.float64),
    "int32": (np.int32,),
    "uint8": (np.uint8,),
    "float32": (np.float32,),
}
Matcher = Callable[[Any], bool]
Overloads = tuple[tuple[Matcher, Callable[..., Any]], ...]  # check of arguments, and function


class ScalarType(Struct, frozen=True, tag="scalar"):
    """A number."""

    name: str  # one of SCALARS


class ArrayType(Struct, frozen=True, tag="array"):
    """An array that may be written to."""

    dtype: str
    ndim: int
    contiguous: bool  # in C order; otherwise any layout


class TupleType(Struct, frozen=True, tag="tuple"):
    """A tuple, named or not."""

    items: tuple["ScalarType | ArrayType | TupleType", ...]


class Overload(Struct, frozen=True):
    """A kernel for arguments of certain types."""

    kernel: str  # "module:name"
    symbol: str  # name in the library
    arguments: TupleType


def matcher(kind: ScalarType | ArrayType | TupleType) -> Matcher:
    """Return a function that checks whether a value has exactly this type."""
    if isinstance(kind, ScalarType):
        types = SCALARS[kind.name]
        return lambda value: type(value) in types
    if isinstance(kind, ArrayType):
        return _array_matcher(np.dtype(kind.dtype), kind.ndim, kind.contiguous)
    matchers = tuple(matcher(item) for item in kind.items)

    def matches_tuple(value: Any) -> bool:
        if not isinstance(value, tuple) or len(value) != len(matchers):
            return False
        return all(map(operator.call, matchers, value))  # a generator takes twice as long

    return matches_tuple


def _array_matcher(dtype: np.dtype[Any], ndim: int, contiguous: bool) -> Matcher:
    def matches_array(value: Any) -> bool:
        if type(value) is not np.ndarray or value.dtype != dtype or value.ndim != ndim:
            return False
        return value.flags.carray if contiguous else value.flags.behaved

    return matches_array


def overloads_of(kernel: str) -> Overloads:
    """Return the overloads of a kernel; none if it is in no library."""
    return load_all().get(kernel, ())


@functools.cache
def load_all() -> dict[str, Overloads]:
    """Load the existing libraries, and return their overloads by kernel."""
    folder, found = cache.kernel_folder(), dict[str, Overloads]()
    for index in sorted(folder.glob(f"*{cache.suffix()}{INDEX}")) if folder else ():
        try:
            overloads = msgspec.json.decode(index.read_bytes(), type=list[Overload])
            library = _load(index.with_name(index.name.removesuffix(INDEX) + LIBRARY))
        except (ImportError, OSError, msgspec.MsgspecError) as error:
            log.warning("linked kernels are left to numba: %s; remove %s", error, index)
            continue
        for overload in overloads:
            entry = matcher(overload.arguments), getattr(library, overload.symbol)
            found[overload.kernel] = (*found.get(overload.kernel, ()), entry)
    return found


def _load(path: Path) -> ModuleType:
    loader = ExtensionFileLoader(MODULE, str(path))
    spec = importlib.util.spec_from_loader(MODULE, loader)
    assert spec
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module
