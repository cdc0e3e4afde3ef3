"""Waits for what must come, and says what did not."""

import asyncio
from collections.abc import Callable

from gigabrain_zenoh.qa.faults.fault import Failed

PATIENCE_S = 60.0  # far more than anything here takes on a busy machine
LOOK_S = 0.01


async def until(condition: Callable[[], object], what: str, within_s: float = PATIENCE_S) -> None:
    """Wait for `condition`; raises Failed naming `what` when it never comes true."""
    loop = asyncio.get_running_loop()
    end_s = loop.time() + within_s
    while not condition():
        if loop.time() >= end_s:
            raise Failed(f"not within {within_s:g} s: {what}")
        await asyncio.sleep(LOOK_S)
