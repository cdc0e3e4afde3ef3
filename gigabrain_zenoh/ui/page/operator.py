"""What viewers ask of the robot, and what becomes of it."""

import time
from collections.abc import Sequence

from msgspec.structs import replace

from gigabrain_schemas.requests import EnableRequest, GateReply, ReleaseRequest
from gigabrain_schemas.tasks import GoalReply, TaskReply, TaskRequest
from gigabrain_schemas.topics import ENABLE, GOAL, RELEASE, TASK_CHANGE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.asking import ANSWER_S, ask, granted
from gigabrain_zenoh.client.estop import press
from gigabrain_zenoh.errors import BodyLost, GigabrainError, Refused
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.ui.page.wire import Ask, Reply


class Operator:
    """Carries out what is asked, and says what became of it."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    async def answer(self, asked: Ask) -> Reply:
        """Never raises what a person has to read: that is the reply."""
        began = time.perf_counter()
        try:
            text, robot = await self._do(asked)
            ok = True
        except GigabrainError as error:
            text, robot, ok = str(error), "", False
        took_ms = (time.perf_counter() - began) * 1e3
        return Reply(
            id=asked.id, what=asked.what, ok=ok, text=text[:500], robot=robot,
            took_ms=round(took_ms, 1),
        )  # fmt: skip

    async def _do(self, asked: Ask) -> tuple[str, str]:
        if asked.what == "goal":
            return await self._goal(asked), ""
        if asked.what == "cancel":
            return await self._cancel(), ""
        if asked.what == "estop":
            reply = await press(self._bus, "operator page")
        elif asked.what == "release":
            reply = await self._release(asked.estop_generation)
        else:
            reply = await self._enable(take=asked.what == "take")
        return reply.text, reply.robot_type

    async def _release(self, generation: int) -> GateReply:
        request = ReleaseRequest(estop_generation=generation, source=self._bus.process)
        return granted(await ask(self._bus, RELEASE, request))

    async def _enable(self, *, take: bool) -> GateReply:
        request = EnableRequest(source=BRAIN, take=take, by=self._bus.process)
        return granted(await ask(self._bus, ENABLE, request))

    async def _cancel(self) -> str:
        request = TaskRequest(do="cancel", source=self._bus.process)
        replies = await self._bus.ask(TASK_CHANGE, request, timeout_s=ANSWER_S)
        return _answered(replies)

    async def _goal(self, asked: Ask) -> str:
        if asked.goal is None:
            raise Refused("a goal needs a place")
        goal = replace(asked.goal, source=self._bus.process)
        replies = await self._bus.ask(GOAL, goal, timeout_s=ANSWER_S)
        return _answered(replies)


def _answered(replies: Sequence[GoalReply | TaskReply]) -> str:
    """What a robot that goes somewhere says. Raises BodyLost where none does, and Refused."""
    if not replies:
        raise BodyLost("nobody serves goals: this robot has no navigation running")
    if not replies[0].ok:
        raise Refused(replies[0].text)
    return replies[0].text
