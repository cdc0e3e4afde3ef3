"""Processes of the suite's own that trouble a robot, and what a process costs."""

import asyncio
import contextlib
import os
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager

import psutil

from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.qa.faults.fault import Failed
from gigabrain_zenoh.qa.faults.tampered import MODULES


@asynccontextmanager
async def helper(module: str, *words: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """`python -m gigabrain_zenoh.qa.faults.MODULE WORDS`, while the block runs."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", MODULES + module, *words),
        stdout=asyncio.subprocess.PIPE,
        env=os.environ | {this_process.SUPERVISOR_VARIABLE: str(os.getpid())},
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):  # it has ended by itself
            process.kill()
        await process.wait()


@asynccontextmanager
async def helpers(module: str, words: list[str]) -> AsyncIterator[None]:
    """One for each of `words`."""
    async with AsyncExitStack() as stack:
        for word in words:
            await stack.enter_async_context(helper(module, word))
        yield


def rss_mb(pid: int) -> float:
    """Return the memory that a process holds [MB]. Raises Failed where it has ended."""
    with _looking_at(pid) as process:
        return process.memory_info().rss / 1e6


def open_files(pid: int) -> int:
    """Return how many files and sockets a process has open. Raises Failed where it has ended."""
    with _looking_at(pid) as process:
        return process.num_fds()


@contextlib.contextmanager
def _looking_at(pid: int) -> Iterator[psutil.Process]:
    try:
        yield psutil.Process(pid)
    except psutil.Error:
        raise Failed(f"process {pid} has ended") from None
