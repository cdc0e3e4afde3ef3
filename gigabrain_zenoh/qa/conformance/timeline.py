"""Time as the body has it: waiting is counted in its ticks, so that no machine is too slow."""

import abc
import asyncio
from collections.abc import Callable, Mapping

from gigabrain_zenoh.qa.conformance.result import Failed

LOOK_S = 0.004
PATIENCE_S = 10.0  # of wall time without a single tick


class Timeline(abc.ABC):
    """Somebody who lives by a driver's ticks."""

    def __init__(self) -> None:
        self.tick = 0

    @abc.abstractmethod
    def check_alive(self) -> None:
        """Raise what has ended the driver, if anything has."""

    async def until(self, condition: Callable[[], object], ticks: int) -> int | None:
        """Wait for `condition`, at most so many ticks; after how many it held, or None."""
        loop, begin = asyncio.get_running_loop(), self.tick
        seen, seen_s = self.tick, loop.time()
        while not condition():
            self.check_alive()
            if self.tick - begin >= ticks:
                return None
            if self.tick != seen:
                seen, seen_s = self.tick, loop.time()
            elif loop.time() - seen_s > PATIENCE_S:
                raise Failed(f"no tick for {PATIENCE_S:.0f} s")
            await asyncio.sleep(LOOK_S)
        return self.tick - begin

    async def firsts(
        self, conditions: Mapping[str, Callable[[], object]], ticks: int
    ) -> dict[str, float]:
        """After how long each condition first held [ms]; ends with the last, or after `ticks`."""
        loop = asyncio.get_running_loop()
        begin_s, found = loop.time(), dict[str, float]()

        def look() -> bool:
            for name, holds in conditions.items():
                if name not in found and holds():
                    found[name] = (loop.time() - begin_s) * 1e3
            return len(found) == len(conditions)

        await self.until(look, ticks)
        return found

    async def go_on(self, ticks: int) -> None:
        """Let so many ticks pass."""
        await self.until(lambda: False, ticks)
