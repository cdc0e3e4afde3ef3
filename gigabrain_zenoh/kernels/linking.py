"""Links compiled kernels into a shared library that runs without numba; see `linked`.

It needs a C++ compiler and Python's header files. Run it in its own process: a compiler leaves some
200 MB behind.
"""

import gc
import importlib
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.kernels import cache
from gigabrain_zenoh.kernels.jit import Kernel, import_numba
from gigabrain_zenoh.kernels.linked import (
    INDEX,
    LIBRARY,
    MODULE,
    SCALARS,
    ArrayType,
    Overload,
    ScalarType,
    TupleType,
)
from gigabrain_zenoh.plugins import find

numba = import_numba()


def link(name: str, warm_ups: Iterable[str]) -> None:
    """Write a library of all kernels that `warm_ups` call, and its index, unless they exist.

    A warm-up is the "module:name" of a function. Call this before any kernel.
    """
    folder = cache.kernel_folder()
    stem = folder and folder / f"{name}{cache.suffix()}"
    if not folder or not stem or Path(f"{stem}{INDEX}").exists():
        return
    for warm_up in warm_ups:
        find(warm_up)()
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        library = _library()
        library.output_dir = temporary
        overloads = list(_export(library))
        library.compile()
        Path(temporary, library.output_file).replace(f"{stem}{LIBRARY}")
        index = Path(temporary, "index")
        index.write_bytes(msgspec.json.encode(overloads))
        index.replace(f"{stem}{INDEX}")


def _library() -> Any:
    """Return an empty library with the compiler flags of `kernel`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", numba.core.errors.NumbaPendingDeprecationWarning)
        pycc: Any = importlib.import_module("numba.pycc")
    default_flags = pycc.compiler.Flags

    def flags_of_kernels() -> Any:
        flags = default_flags()
        flags.release_gil, flags.error_model = True, "numpy"
        return flags

    pycc.compiler.Flags = flags_of_kernels  # pycc has no parameter for them
    library = pycc.CC(MODULE)
    library.target_cpu = "host"
    return library


def _export(library: Any) -> Iterator[Overload]:
    """Add the called kernels to a library, for each signature, and yield their overloads."""
    called = [item for item in gc.get_objects() if isinstance(item, Kernel) and item.called]
    for kernel in sorted(called, key=lambda item: item.name):
        signatures = [overload.signature for overload in kernel.dispatcher.overloads.values()]
        # "A)" stands for an array of any layout; contiguous ones match first
        for signature in sorted(signatures, key=lambda item: "A)" in str(item)):
            arguments = type_of(numba.types.Tuple(signature.args))
            if isinstance(arguments, TupleType):
                symbol = f"kernel_{len(library._exported_functions)}"
                library.export(symbol, signature)(kernel.function)
                yield Overload(kernel.name, symbol, arguments)


def type_of(numba_type: Any) -> ScalarType | ArrayType | TupleType | None:
    """Convert one of numba's types; return None if only numba can handle it."""
    types = numba.types
    if isinstance(numba_type, types.Array):
        if numba_type.layout == "F" or not (numba_type.mutable and numba_type.aligned):
            return None
        return ArrayType(str(numba_type.dtype), numba_type.ndim, numba_type.layout == "C")
    if isinstance(numba_type, types.BaseTuple):
        items = tuple(type_of(item) for item in numba_type)
        return None if None in items else TupleType(tuple(item for item in items if item))
    return ScalarType(str(numba_type)) if str(numba_type) in SCALARS else None


if __name__ == "__main__":
    library, parent = sys.argv[1:3]
    this_process.die_with_parent(int(parent))
    link(library, sys.argv[3:])
