"""Tasks from a script: send the robot somewhere, and hear what becomes of it."""

import asyncio
from collections.abc import Callable
from pathlib import Path

from gigabrain_schemas.tasks import (
    GoalRequest,
    How,
    MissionRequest,
    Task,
    TaskRequest,
    TaskStatus,
)
from gigabrain_schemas.topics import GOAL, MISSION, TASK, TASK_CHANGE
from gigabrain_zenoh.asking import ANSWER_S
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused
from gigabrain_zenoh.keys.checks import may_not_ask

LARGEST = 1e9  # as on the bus
PLAN_S = 5.0  # how long a way through a large map may take to be found
SILENT_S = 5.0  # without a word of the tasks
OnNews = Callable[[TaskStatus], None]


class Tasks:
    """What the robot was sent to do."""

    def __init__(self, bus: Bus, keys: str = "") -> None:
        self._bus, self._keys = bus, keys
        self._news = asyncio.Event()
        self._newest: TaskStatus | None = None
        self._heard = False

    async def go_to(
        self, x: float, y: float, yaw: float | None = None, *, how: How = "replace"
    ) -> str:
        """Send the robot to a place in its map [m, m, rad]; the task's name.

        Raises ConfigError for what is no number, and Refused.
        """
        given = (x, y) if yaw is None else (x, y, yaw)
        if not all(abs(value) <= LARGEST for value in given):
            numbers = " ".join(f"{value:g}" for value in given)
            raise ConfigError(f"a goal takes numbers up to {LARGEST:g}, got {numbers}")
        self._listen()
        request = GoalRequest(x=x, y=y, yaw=yaw, how=how, source=self._bus.process)
        replies = await self._bus.ask(GOAL, request, timeout_s=PLAN_S)
        if not replies:
            raise self._nobody()
        if not replies[0].ok:
            raise Refused(replies[0].text)
        return replies[0].goal

    async def carry_out(
        self, mission: str | Path, *, how: How = "replace", label: str = "mission"
    ) -> str:
        """Have a mission carried out, a file or its text; the task's name.

        Raises ConfigError for a file that is none, with its line, and Refused.
        """
        self._listen()
        if isinstance(mission, Path):
            from gigabrain_zenoh.tasks.checks import load  # takes a while: only when used

            label = mission.stem
            mission = load(mission)[1]
        request = MissionRequest(
            mission=mission, how=how, source=self._bus.process, label=label[:64]
        )
        replies = await self._bus.ask(MISSION, request, timeout_s=PLAN_S)
        if not replies:
            raise self._nobody()
        if not replies[0].ok:
            raise Refused(replies[0].text)
        return replies[0].task

    async def explore(self, *, how: How = "replace") -> str:
        """Have the robot drive until nothing is left to be seen; the task's name."""
        return await self.carry_out("do: [{explore: {}}]", how=how, label="exploring")

    async def cancel(self, task: str = "") -> str:
        """End a task, the present one without a name, or `all`; in words. Raises Refused."""
        return await self._change(TaskRequest(do="cancel", task=task, source=self._bus.process))

    async def pause(self, task: str = "") -> str:
        """Have a task wait; in words. Raises Refused."""
        return await self._change(TaskRequest(do="pause", task=task, source=self._bus.process))

    async def resume(self, task: str = "") -> str:
        """Have a task that waits go on; in words. Raises Refused."""
        return await self._change(TaskRequest(do="resume", task=task, source=self._bus.process))

    async def status(self) -> TaskStatus:
        """What the robot is at, what waits and what was last. Raises BodyLost."""
        self._listen()
        if self._newest is None:
            await self._hear()
        assert self._newest
        return self._newest

    async def result(self, task: str, on_news: OnNews | None = None) -> Task:
        """How a task ended, once it has; `on_news` hears of it meanwhile. Raises BodyLost."""
        self._listen()
        while True:
            status = self._newest
            if status:
                for one in status.done:
                    if one.id == task:
                        return one
                if on_news:
                    on_news(status)
            await self._hear()

    def _listen(self) -> None:
        if not self._heard:
            self._heard = True
            self._bus.subscribe(TASK, self._take)

    def _take(self, _key: str, status: TaskStatus) -> None:
        self._newest = status
        self._news.set()

    async def _hear(self) -> None:
        self._news.clear()
        try:
            await asyncio.wait_for(self._news.wait(), SILENT_S)
        except TimeoutError:
            raise self._nobody() from None

    async def _change(self, request: TaskRequest) -> str:
        replies = await self._bus.ask(TASK_CHANGE, request, timeout_s=ANSWER_S)
        if not replies:
            raise self._nobody()
        if not replies[0].ok:
            raise Refused(replies[0].text)
        return replies[0].text

    def _nobody(self) -> BodyLost:
        doubt = may_not_ask(self._keys)
        return BodyLost(
            f"nobody serves goals{doubt or '; does decision run with behaviour: navigate?'}"
        )
