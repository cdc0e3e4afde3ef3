"""Waits for other threads and processes."""

import asyncio
import threading
from collections.abc import Callable

PATIENCE_S = 60.0  # far longer than any operation takes on a busy machine
POLL_S = 0.002


async def until(
    condition: Callable[[], object], what: str = "", within_s: float = PATIENCE_S
) -> None:
    """Wait until `condition` holds. Raises TimeoutError, with `what` in its text."""
    loop = asyncio.get_running_loop()
    end_s = loop.time() + within_s
    while not condition():
        if loop.time() >= end_s:
            raise TimeoutError(f"not within {within_s:g} s: {what or condition}")
        await asyncio.sleep(POLL_S)


async def settle() -> None:
    """Let the event loop run all callbacks that are due; no time passes."""
    for _ in range(5):
        await asyncio.sleep(0)


def start_thread(work: Callable[[], None]) -> threading.Thread:
    """Start a thread that calls `work`, and return it."""
    thread = threading.Thread(target=work)
    thread.start()
    return thread
