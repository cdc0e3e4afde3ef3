"""Waits for what must come, and says what did not."""

import asyncio
from collections.abc import Callable

from gigabrain_zenoh.faults.fault import Failed

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


class StallWatch:
    """Notices when this machine stands still, so that no robot is blamed for it."""

    def __init__(self) -> None:
        self._longest_s = 0.0
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to look."""
        self._task = asyncio.create_task(self._watch())

    def close(self) -> None:
        """Look no more."""
        if self._task:
            self._task.cancel()

    def reset(self) -> None:
        """Forget what was."""
        self._longest_s = 0.0

    async def longest_s(self) -> float:
        """How long it stood still at most since the last `reset`, a moment ago included."""
        await asyncio.sleep(2 * LOOK_S)
        return self._longest_s

    async def _watch(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            due_s = loop.time() + LOOK_S
            await asyncio.sleep(LOOK_S)
            self._longest_s = max(self._longest_s, loop.time() - due_s)
