"""Client for tasks from a script: send the robot to a goal, and follow the task's progress."""

import asyncio
import contextlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from gigabrain_schemas.base import Message
from gigabrain_schemas.tasks import (
    GoalReply,
    GoalRequest,
    How,
    MissionReply,
    MissionRequest,
    Task,
    TaskRequest,
    TaskStatus,
)
from gigabrain_schemas.topics import GOAL, MISSION, TASK, TASK_CHANGE, Service
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import arrival
from gigabrain_zenoh.client.requests import ANSWER_S, still_open
from gigabrain_zenoh.errors import BodyLost, ConfigError, GigabrainError, Refused
from gigabrain_zenoh.security.identity_files import may_not_ask

FILE_NAME = re.compile(r".+\.ya?ml")  # does not match a mission's text: it has more lines
MAX_NAME_CHARS = 64
MAX_TAG = 1_000_000
MAX_COORDINATE = 1e5  # [m], of goals on the bus
PLAN_S = 5.0  # path planning in a large map may take this long
SILENT_S = 5.0  # after this long without a task status, the robot counts as lost
STALE_NS = 1_000_000_000  # maximum age of a status: five are published a second
STARTING_S = 3.0  # a starting robot may take this long to serve goals
RETRY_S = 0.2
MAX_STATUSES_WITHOUT = 5  # older statuses, without a new task, may still arrive
OnStatus = Callable[[TaskStatus], None]
Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)
OnWait = Callable[[str], None]


def late(timeout_s: float) -> str:
    """Return the error text for a request without a reply in time."""
    return (
        f"no answer within {timeout_s:g} s; `gigabrain task list` shows whether the robot has "
        "accepted it"
    )


def check_goal(x: float, y: float, yaw: float | None = None) -> None:
    """Raise ConfigError for numbers that no goal in a map can have."""
    given = (x, y) if yaw is None else (x, y, yaw)
    if not all(abs(value) <= MAX_COORDINATE for value in given):
        numbers = " ".join(f"{value:g}" for value in given)
        raise ConfigError(f"a goal takes numbers up to {MAX_COORDINATE:g}, got {numbers}")


def check_place(name: str) -> None:
    """Raise ConfigError for a name that no place can have."""
    if not 1 <= len(name) <= MAX_NAME_CHARS:
        raise ConfigError(f"a place has a name of 1 to {MAX_NAME_CHARS} characters")


def check_object(label: str = "", tag: int | None = None) -> None:
    """Raise ConfigError for a class that no thing, or a number that no tag can have."""
    if tag is not None and not 0 <= tag <= MAX_TAG:
        raise ConfigError(f"a tag has a number from 0 to {MAX_TAG}, got {tag}")
    if tag is None and not 1 <= len(label) <= MAX_NAME_CHARS:
        raise ConfigError(f"a thing has a class of 1 to {MAX_NAME_CHARS} characters")


def check_task(name: str) -> None:
    """Raise ConfigError for a name that no task can have; empty is the current task."""
    if len(name) > MAX_NAME_CHARS:
        raise ConfigError(f"a task has a name of at most {MAX_NAME_CHARS} characters")


class Tasks:
    """Client for the tasks of one robot."""

    def __init__(
        self,
        bus: Bus,
        keys: str = "",
        *,
        on_wait: OnWait | None = None,
        starting_s: float = STARTING_S,
        silent_s: float = SILENT_S,
        plan_s: float = PLAN_S,
    ) -> None:
        """Create a client that waits up to `starting_s` for a process that serves goals.

        The callback `on_wait` receives a text when this wait begins. After `silent_s` without a
        task status, or `plan_s` without a reply to a goal, calls raise BodyLost.
        """
        self._given_bus, self._keys = bus, keys
        self._on_wait, self._starting_s, self._silent_s = on_wait, starting_s, silent_s
        self._plan_s = plan_s
        self._arrived = asyncio.Event()
        self._newest: TaskStatus | None = None
        self._newest_ns = 0  # time of its arrival
        self._subscribed = False

    @property
    def _bus(self) -> Bus:
        """The bus. Raises BusError once it is closed."""
        return still_open(self._given_bus)

    async def go_to(
        self, x: float, y: float, yaw: float | None = None, *, how: How = "replace"
    ) -> str:
        """Send the robot to a pose in its map [m, m, rad]; return the task's name.

        Raises ConfigError for numbers that are not valid, and Refused.
        """
        check_goal(x, y, yaw)
        return await self._go(GoalRequest(x=x, y=y, yaw=yaw, how=how, source=self._bus.process))

    async def go_to_place(
        self, name: str, yaw: float | None = None, *, how: How = "replace"
    ) -> str:
        """Send the robot to a named place of its map; return the task's name. Raises Refused."""
        check_place(name)
        request = GoalRequest(place=name, yaw=yaw, how=how, source=self._bus.process)
        return await self._go(request)

    async def go_to_object(
        self, label: str = "", *, tag: int | None = None, how: How = "replace"
    ) -> str:
        """Send the robot to the nearest thing of a class, or to a tag; it looks for an unknown one.

        Returns the task's name. Raises ConfigError for an invalid name or number, and Refused.
        """
        check_object(label, tag)
        request = GoalRequest(object=label, tag=tag, how=how, source=self._bus.process)
        return await self._go(request)

    async def _go(self, request: GoalRequest) -> str:
        self._listen()
        reply = await self._ask(GOAL, request, self._plan_s)
        if not reply.ok:
            raise Refused(reply.text)
        return reply.goal

    async def carry_out(
        self, mission: str | Path, *, how: How = "replace", label: str = "mission"
    ) -> str:
        """Start a mission, given as a file or as its text; return the task's name.

        One line that ends with `.yaml` or `.yml` is a file. Raises ConfigError with the line number
        for an invalid mission, and Refused.
        """
        self._listen()
        from gigabrain_zenoh.decision.tasks.mission_files import load, refuse_long

        if isinstance(mission, Path) or FILE_NAME.fullmatch(mission):
            label = Path(mission).stem
            mission = load(Path(mission))[1]
        refuse_long(mission, label)
        request = MissionRequest(
            mission=mission,
            how=how,
            source=self._bus.process,
            label=label.encode(errors="replace").decode()[:64],  # file names may be any bytes
        )
        reply = await self._ask(MISSION, request, self._plan_s)
        if not reply.ok:
            raise Refused(reply.text)
        return reply.task

    async def explore(self, *, how: How = "replace") -> str:
        """Start exploring until nothing unknown is reachable; return the task's name."""
        return await self.carry_out("do: [{explore: {}}]", how=how, label="exploring")

    async def cancel(self, task: str = "") -> str:
        """Cancel a task by name, the current one (empty name), or `all`; return the reply in words.

        Raises Refused.
        """
        return await self._change(TaskRequest(do="cancel", task=task, source=self._bus.process))

    async def pause(self, task: str = "") -> str:
        """Pause a task; return the reply in words. Raises Refused."""
        return await self._change(TaskRequest(do="pause", task=task, source=self._bus.process))

    async def resume(self, task: str = "") -> str:
        """Resume a paused task; return the reply in words. Raises Refused."""
        return await self._change(TaskRequest(do="resume", task=task, source=self._bus.process))

    @property
    def newest(self) -> TaskStatus | None:
        """Return the newest status received since the first request; None without one."""
        return self._newest

    async def status(self) -> TaskStatus:
        """Return the current, the waiting and the most recent ended tasks. Raises BodyLost."""
        self._listen()
        if self._newest is None or self._bus.clock.now_ns() - self._newest_ns > STALE_NS:
            await self._next_status()
        assert self._newest
        return self._newest

    async def result(self, task: str, on_status: OnStatus | None = None) -> Task:
        """Wait until a task has ended, and return it. Raises BodyLost, also for an unknown task.

        Until then `on_status` is called with each status.
        """
        self._listen()
        missing = 0  # statuses in sequence without the task
        while True:
            status = self._newest
            if status:
                for ended in status.done:
                    if ended.id == task:
                        return ended
                open_tasks = (status.current, *status.queue)
                known = any(each and each.id == task for each in open_tasks)
                missing = 0 if known else missing + 1
                if missing == MAX_STATUSES_WITHOUT:
                    raise BodyLost(
                        f"the robot has no task {task}, or has forgotten it; "
                        "see `gigabrain task list`"
                    )
                if on_status:
                    on_status(status)
            await self._next_status()

    async def _ask(self, service: Service[Q, R], request: Q, timeout_s: float) -> R:
        """Return the first reply; retry while no process serves tasks, as on a starting robot."""
        now = asyncio.get_running_loop().time
        until, waiting = now() + self._starting_s, False
        while True:
            asked, losses = now(), self._bus.transport.losses
            replies = await self._ask_once(service, request, timeout_s)
            if replies:
                return replies[0]
            took = now() - asked
            await asyncio.sleep(
                RETRY_S
            )  # the loss of a link may be reported only after the query ended
            if self._bus.transport.losses != losses:
                raise BodyLost(
                    "the link was lost before the answer; `gigabrain task list` shows whether the "
                    "robot has received the request"
                )
            doubt = may_not_ask(self._keys)
            if took >= timeout_s:  # the request may have been received: do not repeat it
                raise BodyLost(f"{late(timeout_s)}{doubt}")
            if now() >= until or doubt:
                raise self._no_server()
            if self._on_wait and not waiting:
                self._on_wait(
                    "waiting: no process serves goals yet; the robot may still be starting"
                )
            waiting = True

    async def _ask_once(self, service: Service[Q, R], request: Q, timeout_s: float) -> list[R]:
        """Return all replies. If this call is cancelled, cancel a task that it started as well."""
        asking = asyncio.ensure_future(self._bus.ask(service, request, timeout_s=timeout_s))
        try:
            return await asyncio.shield(asking)
        except asyncio.CancelledError:
            with contextlib.suppress(GigabrainError):
                await self._cancel_started(await asking)
            raise

    async def _cancel_started(self, replies: list[R]) -> None:
        for reply in replies:
            if isinstance(reply, GoalReply) and reply.ok:
                await self.cancel(reply.goal)
            if isinstance(reply, MissionReply) and reply.ok:
                await self.cancel(reply.task)

    def _listen(self) -> None:
        still_open(self._given_bus)
        if not self._subscribed:
            self._subscribed = True
            self._bus.subscribe(TASK, self._on_status)

    def _on_status(self, _key: str, status: TaskStatus) -> None:
        self._newest, self._newest_ns = status, self._bus.clock.now_ns()
        self._arrived.set()

    async def _next_status(self) -> None:
        self._arrived.clear()
        try:
            await arrival(self._arrived, self._silent_s)
        except TimeoutError:
            raise self._no_server() from None

    async def _change(self, request: TaskRequest) -> str:
        check_task(request.task)
        reply = await self._ask(TASK_CHANGE, request, ANSWER_S)
        if not reply.ok:
            raise Refused(reply.text)
        return reply.text

    def _no_server(self) -> BodyLost:
        doubt = may_not_ask(self._keys)
        return BodyLost(
            f"no process serves goals{doubt or '; run decision with behaviour: navigate'}"
        )
