"""Tasks from a script: send the robot somewhere, and hear what becomes of it."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from gigabrain_schemas.base import Message
from gigabrain_schemas.tasks import (
    GoalRequest,
    How,
    MissionRequest,
    Task,
    TaskRequest,
    TaskStatus,
)
from gigabrain_schemas.topics import GOAL, MISSION, TASK, TASK_CHANGE, Service
from gigabrain_zenoh.asking import ANSWER_S
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused
from gigabrain_zenoh.keys.checks import may_not_ask

LARGEST = 1e9  # as on the bus
PLAN_S = 5.0  # how long a way through a large map may take to be found
SILENT_S = 5.0  # without a word of the tasks
STARTING_S = 3.0  # how long a robot that starts may take until it serves goals
AGAIN_S = 0.2
OnNews = Callable[[TaskStatus], None]
Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)
OnWait = Callable[[str], None]


class Tasks:
    """What the robot was sent to do."""

    def __init__(
        self,
        bus: Bus,
        keys: str = "",
        *,
        on_wait: OnWait | None = None,
        starting_s: float = STARTING_S,
        silent_s: float = SILENT_S,
    ) -> None:
        """Who serves goals is waited for `starting_s`; `on_wait` is told so.

        Whoever says nothing of the tasks for `silent_s` is taken for gone.
        """
        self._bus, self._keys = bus, keys
        self._on_wait, self._starting_s, self._silent_s = on_wait, starting_s, silent_s
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
        reply = await self._ask(GOAL, request, PLAN_S)
        if not reply.ok:
            raise Refused(reply.text)
        return reply.goal

    async def carry_out(
        self, mission: str | Path, *, how: How = "replace", label: str = "mission"
    ) -> str:
        """Have a mission carried out, a file or its text; the task's name.

        Raises ConfigError for a file that is none, with its line, and Refused.
        """
        self._listen()
        from gigabrain_zenoh.tasks.checks import load, refuse_long  # takes a while: only when used

        if isinstance(mission, Path):
            label = mission.stem
            mission = load(mission)[1]
        refuse_long(mission, label)
        request = MissionRequest(
            mission=mission,
            how=how,
            source=self._bus.process,
            label=label.encode(errors="replace").decode()[:64],  # a file's name may be any bytes
        )
        reply = await self._ask(MISSION, request, PLAN_S)
        if not reply.ok:
            raise Refused(reply.text)
        return reply.task

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

    async def _ask(self, service: Service[Q, R], request: Q, timeout_s: float) -> R:
        """The answer of who serves tasks, which a robot that starts does a moment later."""
        now = asyncio.get_running_loop().time
        until, waits = now() + self._starting_s, False
        while True:
            asked = now()
            replies = await self._bus.ask(service, request, timeout_s=timeout_s)
            if replies:
                return replies[0]
            # whoever has not answered in time may have heard it, and is not asked again
            if now() >= min(until, asked + timeout_s) or may_not_ask(self._keys):
                raise self._nobody()
            if self._on_wait and not waits:
                self._on_wait("waiting: nobody serves goals yet; is the robot just starting?")
            waits = True
            await asyncio.sleep(AGAIN_S)

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
            await asyncio.wait_for(self._news.wait(), self._silent_s)
        except TimeoutError:
            raise self._nobody() from None

    async def _change(self, request: TaskRequest) -> str:
        reply = await self._ask(TASK_CHANGE, request, ANSWER_S)
        if not reply.ok:
            raise Refused(reply.text)
        return reply.text

    def _nobody(self) -> BodyLost:
        doubt = may_not_ask(self._keys)
        return BodyLost(
            f"nobody serves goals{doubt or '; does decision run with behaviour: navigate?'}"
        )
