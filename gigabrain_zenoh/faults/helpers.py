"""Processes of the suite's own that trouble a robot, and what a process costs."""

import asyncio
import contextlib
import os
import resource
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

from gigabrain_zenoh import lifeline
from gigabrain_zenoh.faults.fault import Skipped
from gigabrain_zenoh.faults.tampered import MODULES


@asynccontextmanager
async def helper(module: str, *words: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """`python -m gigabrain_zenoh.faults.MODULE WORDS`, while the block runs."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", MODULES + module, *words),
        stdout=asyncio.subprocess.PIPE,
        env=os.environ | {lifeline.VARIABLE: str(os.getpid())},
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
    """The memory that a process holds [MB]. Raises Skipped where /proc does not say."""
    pages = int(_read(pid, "statm").split()[1])
    return pages * resource.getpagesize() / 1e6


def open_files(pid: int) -> int:
    """How many files, sockets and pipes it has open. Raises Skipped where /proc does not say."""
    try:
        return len(os.listdir(f"/proc/{pid}/fd"))
    except OSError as error:
        raise Skipped(f"needs /proc: {error}") from None


def _read(pid: int, name: str) -> str:
    try:
        return Path(f"/proc/{pid}/{name}").read_text()
    except OSError as error:
        raise Skipped(f"needs /proc: {error}") from None
