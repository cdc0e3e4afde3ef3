"""Compiles kernels before a process uses them, in a child process if a cache can be written.

A compiler leaves some 200 MB behind in its process.
"""

import asyncio
import contextlib
import gc
import logging
import os
import shutil
import sys
import sysconfig
from collections.abc import Awaitable
from importlib.util import find_spec
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.files import replace_file
from gigabrain_zenoh.host.this_process import join_in
from gigabrain_zenoh.host.threads import InTime, Job
from gigabrain_zenoh.kernels import cache, jit
from gigabrain_zenoh.plugins import find

log = logging.getLogger(__name__)
LOG_AFTER_S = 5.0  # longer compiling is logged
GC_THRESHOLD = 100_000  # objects; with the default of 700, compiling takes a tenth longer
MAX_TRIES = 2  # if the child process that compiles is killed
COMPILER_VARIABLES = "CC", "CXX"  # environment variables of the compilers for linking
LINKING_MODULE = "gigabrain_zenoh.kernels.linking"  # imports a compiler, so not imported here
LOWEST_NICE = 19  # runs only while no process of the robot needs the processor


class Kernels:
    """The kernels that the function at "module:name" calls, for a process that works without them.

    `in_time` decides which scan is the first to use them, so that a replay does the same.
    """

    def __init__(self, warm_up: str, in_time: InTime) -> None:
        self._warm_up, self._in_time = warm_up, in_time
        self._job: Job = Job()
        self._loading: asyncio.Future[None] | None = None
        self._loaded = False
        self.beside = False  # True if the process works while they are compiled

    async def load(self, *, wait: bool) -> None:
        """Load the kernels. If they must be compiled, return at once unless `wait`.

        Raises ConfigError if a package for them is not installed.
        """
        try:
            self.beside = not wait and await asyncio.to_thread(_is_missing, self._warm_up)
        except ModuleNotFoundError as error:
            raise missing_package(error) from None
        if self.beside:
            self.begin()
        else:
            await ensure_compiled(self._warm_up)
            self._job.set_result(None)

    def begin(self) -> None:
        """Start to load them in the background, and compile missing ones first. Works only once."""
        if not self._loading and not self._job.done():
            self._loading = asyncio.ensure_future(self._load_in_background())

    async def finish(self) -> None:
        """Wait until they are loaded. Raises ConfigError like `load`."""
        if self._loading:
            await self._loading

    async def close(self) -> None:
        """Stop compiling."""
        if self._loading:
            self._loading.cancel()
            await asyncio.wait((self._loading,))

    @property
    def loaded(self) -> bool:
        """True from the first scan that can use them. Raises ConfigError like `load`."""
        if self._loading and self._loading.done():
            self._loading.result()
        self._loaded = self._loaded or self._in_time(self._job, 0.0)
        return self._loaded

    async def _load_in_background(self) -> None:
        try:
            if await asyncio.to_thread(_is_missing, self._warm_up):
                await self._compile_in_background()
            await asyncio.to_thread(_call, self._warm_up)
        except ModuleNotFoundError as error:
            raise missing_package(error) from None
        self._job.set_result(None)

    async def _compile_in_background(self) -> None:
        """Compile in a child process, as compiling delays its process. Retry if it is killed."""
        join_in()
        data = {"event": "compiling"}
        log.info("compiling, once per installation; works meanwhile", extra={"data": data})
        for _ in range(MAX_TRIES):
            code = await compile_in_child(self._warm_up, step_aside=True)
            if code == 0:
                log.info("compiled", extra={"data": {"event": "compiled"}})
            if code >= 0:
                return
            log.warning("compiling was ended by signal %d", -code)


async def ensure_compiled(warm_up: str) -> None:
    """Compile and load the kernels that the function at "module:name" calls, in the background.

    Logs if that takes long. Raises ConfigError if a package for them is not installed.
    """
    try:
        if await asyncio.to_thread(_is_missing, warm_up):
            await _log_if_slow(compile_in_child(warm_up))
        await _log_if_slow(asyncio.to_thread(_call, warm_up))
    except ModuleNotFoundError as error:
        raise missing_package(error) from None


def missing_package(error: ModuleNotFoundError) -> ConfigError:
    """Return an error that names the package to install."""
    return ConfigError(f"navigation needs {error.name}: pip install 'gigabrain-zenoh[nav]'")


def _is_missing(warm_up: str) -> bool:
    """Return whether kernels must be compiled and can be kept on disk."""
    mark = cache.mark_of(warm_up)
    return mark is not None and not mark.exists()


def is_kept(warm_up: str) -> bool:
    """Return whether the kernels that `warm_up` calls are compiled and on disk."""
    mark = cache.mark_of(warm_up)
    return mark is not None and mark.exists()


def _call(warm_up: str) -> None:
    find(warm_up)()  # also imports


async def _log_if_slow(work: Awaitable[object]) -> None:
    compiling = asyncio.ensure_future(work)
    try:
        done, _ = await asyncio.wait((compiling,), timeout=LOG_AFTER_S)
        if not done:
            join_in()  # compile at normal priority: it takes a minute
            data = {"event": "compiling"}
            log.info("compiling: the first start takes about a minute", extra={"data": data})
        await compiling
    finally:
        compiling.cancel()


async def compile_in_child(warm_up: str, *, step_aside: bool = False) -> int:
    """Compile in a child process, and return its exit code; `step_aside` lowers its priority."""
    aside = ("aside",) if step_aside else ()
    return await _in_child(f"compiling {warm_up}", __name__, warm_up, str(os.getpid()), *aside)


async def link_in_child(library: str, *warm_ups: str) -> int:
    """Link the compiled kernels of `warm_ups` in a child process, and return its exit code."""
    about = f"linking {library}"
    return await _in_child(about, LINKING_MODULE, library, str(os.getpid()), *warm_ups)


async def _in_child(activity: str, module: str, *arguments: str) -> int:
    paths = os.pathsep.join(path for path in sys.path if path)
    child = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", module),  # -P: do not import from the current folder
        *arguments,
        env={**os.environ, "PYTHONPATH": paths},
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        _, errors = await child.communicate()
        if child.returncode and (text := errors.decode(errors="replace").strip()):
            log.warning("%s beforehand failed: %s", activity, text.splitlines()[-1])
            log.debug("%s", text)
        return child.returncode or 0
    finally:
        if child.returncode is None:
            child.kill()
            await child.wait()


def can_link() -> bool:
    """Return whether linking is possible: with compilers, Python.h and setuptools."""
    compilers = (
        os.environ.get(name) or sysconfig.get_config_var(name) for name in COMPILER_VARIABLES
    )
    headers = Path(sysconfig.get_path("include"), "Python.h")
    has_sources = headers.exists() and find_spec("setuptools")
    return bool(has_sources) and all(
        command and shutil.which(command.split()[0]) for command in compilers
    )


def compile_all(warm_up: str) -> None:
    """Compile in this process, and mark it as done on disk. Raises ModuleNotFoundError."""
    find(warm_up)()
    mark = cache.mark_of(warm_up)
    if mark and not jit.unsaved:
        with contextlib.suppress(OSError):  # read-only or full: compile again next time
            replace_file(mark, b"compiled\n")


if __name__ == "__main__":
    this_process.die_with_parent(int(sys.argv[2]))
    gc.set_threshold(GC_THRESHOLD)
    if sys.argv[3:]:
        os.nice(LOWEST_NICE)
    compile_all(sys.argv[1])
