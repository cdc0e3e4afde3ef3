"""A driver by itself, without bus and gate: what it promises, it promises to anybody."""

import asyncio
import contextlib
from types import TracebackType
from typing import Self

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.qa.conformance.result import Failed
from gigabrain_zenoh.qa.conformance.subject import Subject
from gigabrain_zenoh.qa.conformance.timeline import Timeline

OPEN_TICKS = 250  # 5 s


class Session(Timeline):
    """Commands `wanted` in every tick and keeps what came of it. Used as `async with`."""

    def __init__(self, subject: Subject) -> None:
        super().__init__()
        self.driver = subject.driver()
        self.wanted = ZERO
        self.sent: Velocity | None = None  # what the driver returned last
        self.state: RobotState | None = None
        self._live: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        await self.driver.__aenter__()
        self._live = asyncio.create_task(self._run(), name="conformance session")
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._live:
            self._live.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._live
        await self.driver.__aexit__(kind, error, traceback)

    async def connected(self) -> int:
        """Wait for the body; after how many ticks it was heard."""
        ticks = await self.until(lambda: self.state and self.state.link.connected, OPEN_TICKS)
        if ticks is None:
            raise Failed(f"the body was not heard within {OPEN_TICKS} ticks")
        return ticks

    def check_alive(self) -> None:
        """Raise what the driver raised."""
        if self._live and self._live.done():
            self._live.result()
            raise Failed("its ticks have ended")

    async def _run(self) -> None:
        async for passed in self.driver.ticks(Clock()):
            self.tick += passed
            self.state = await self.driver.read_state()
            to = self.wanted
            self.sent = await self.driver.set_base_velocity(to.linear_x, to.linear_y, to.angular_z)
