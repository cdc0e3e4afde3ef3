"""Names the files of compiled kernels, in NUMBA_CACHE_DIR or in the user's cache folder."""

import functools
import hashlib
import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

from platformdirs import user_cache_path

PACKAGE = Path(__file__).parents[1]
KERNEL_PACKAGES = ("kernels", "manipulation", "mapping", "navigation", "qa/bench")
FOLDER = "NUMBA_CACHE_DIR"  # environment variable
CPU_INFO = Path("/proc/cpuinfo")
FEATURES_LABELS = ("flags", "Features")  # of the line with a processor's features: x86, ARM


def kernel_folder() -> Path | None:
    """Return the folder in use; None for a user without a home directory."""
    chosen = os.environ.get(FOLDER)
    return Path(chosen) if chosen else cache_folder()


def cache_folder() -> Path | None:
    """Return the cache folder for exactly these sources; None for a user without a home directory.

    Numba detects changes only in a kernel's own file, not in those of the kernels that it calls.
    It also compiles again if a file's path differs, as in a second checkout, or its time.
    """
    try:
        return user_cache_path("gigabrain") / f"kernels-{digest(PACKAGE)}"
    except RuntimeError:
        return None


def mark_of(warm_up: str) -> Path | None:
    """Return the file that marks all of `warm_up` as compiled for this processor.

    None if the cache folder cannot be created.
    """
    folder = kernel_folder()
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder / f"{warm_up.replace(':', '.')}{suffix()}"


def suffix() -> str:
    """Return the suffix of file names for these sources and this processor."""
    return f"-{digest(PACKAGE)}-{_machine()}"


@functools.cache
def digest(package: Path) -> str:
    """Return a digest of the packages with kernels, computed at the first call."""
    sources = hashlib.sha256()
    for name in KERNEL_PACKAGES:
        for source in sorted((package / name).rglob("*.py")):
            sources.update(source.read_bytes())
            sources.update(f"{source} {source.stat().st_mtime_ns}".encode(errors="replace"))
    return sources.hexdigest()[:16]


@functools.cache
def _machine() -> str:
    """Return a digest of the processor and of the versions of the compilers."""
    parts = [sys.version, version("numba"), version("numpy"), platform.machine()]
    try:
        lines = CPU_INFO.read_text().splitlines()
        parts += [next(line for line in lines if line.startswith(FEATURES_LABELS))]
    except (OSError, StopIteration):
        parts += [platform.processor()]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
