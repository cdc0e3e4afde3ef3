"""One message, however extreme, must not be able to stop a robot."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

import msgspec
from msgspec import Struct

from gigabrain_schemas.requests import DescribeRequest, EnableRequest, ParamRequest
from gigabrain_schemas.tasks import MissionRequest
from gigabrain_schemas.topics import (
    BUTTON,
    CMD_VEL,
    DESCRIBE,
    ENABLE,
    ESTOP,
    ESTOP_SAID,
    GOAL,
    MISSION,
    PARAM,
    SAFETY,
    TASK_CHANGE,
    TELEOP,
    TOPICS,
    Topic,
)
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.qa.faults.errand import PLACES, in_map, needs_navigation, waiting_robot
from gigabrain_zenoh.qa.faults.extremes import Case, fixed
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.helpers import rss_mb
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.deployment import client_endpoint

# what may stop, take or cancel by its purpose: it is undone as a person would
UNDONE = (
    ESTOP, ESTOP_SAID, BUTTON, SAFETY, ENABLE, TELEOP, GOAL, MISSION, TASK_CHANGE, PARAM,
)  # fmt: skip
ACCIDENTS = {"collision", "tilted"}
LOOK_TICKS = 7  # until a message has gone the whole way: more than a scan
ANSWER_S = 1.0
GROWN_MB = 50.0
AGAIN_S, AGAIN_AFTER_DEATH_S = 3.0, 10.0
UNDONE_TIMES = 3  # at most: on a busy machine a message may take effect after it was undone
PATIENCE_S = 30.0  # until the next message at most, where it does not drive again in time
MOVES = 0.02  # [m/s], [rad/s]


class Outcome(Struct, frozen=True, kw_only=True):
    """What one message has done to a robot."""

    number: int
    what: str
    silent: tuple[str, ...] = ()  # processes that did not answer in time
    ended: tuple[str, ...] = ()  # processes that were started again
    grown_mb: float = 0.0  # of the process that grew most
    grown: str = ""  # which one that is
    again_s: float = 0.0  # until it drove again
    undone: bool = False  # whether somebody has undone what it asks for

    @property
    def wrong(self) -> str:
        """What speaks against the robot; empty where nothing does."""
        limit_s = AGAIN_AFTER_DEATH_S if self.ended else AGAIN_S
        found = []
        if self.silent:
            found.append(f"{', '.join(self.silent)} did not answer within {ANSWER_S:g} s")
        if self.grown_mb > GROWN_MB:
            found.append(f"{self.grown} grew by {self.grown_mb:.0f} MB")
        if self.again_s > limit_s:
            found.append(f"it drove again after {self.again_s:.1f} s")
        return "; ".join(found)


async def one_message(rig: Rig) -> Measured:
    """A fixed set of extremes, one after the other, to a robot that drives from goal to goal."""
    needs_navigation()
    await rig.give_up()
    async with rig.new(waiting_robot(rig.options)) as subject, sending(subject) as sender:
        outcomes = [await sender.tried(case) for case in fixed()]
    harmful = [one for one in outcomes if one.silent or one.grown_mb > GROWN_MB]
    if harmful:  # a figure would not name them
        raise Failed("; ".join(f"{one.what}: {one.wrong}" for one in harmful))
    return figures(outcomes)


def figures(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """The figures of the criterion."""
    calm = [one.again_s for one in outcomes if not one.ended]
    after_death = [one.again_s for one in outcomes if one.ended]
    return {
        "silent": sum(bool(one.silent) for one in outcomes),
        "memory grown": max((one.grown_mb for one in outcomes), default=0.0),
        "drives again after": max(calm, default=0.0),
        "after a death": max(after_death, default=0.0),
    }


@asynccontextmanager
async def sending(subject: Subject) -> AsyncIterator["Sender"]:
    """Somebody on the robot's network, once the robot drives."""
    transport = await ZenohTransport.open(client_endpoint(subject.deployment))
    try:
        sender = Sender(subject, transport)
        await sender.begin()
        yield sender
    finally:
        await transport.close()


class Sender:
    """Sends extremes to one robot, and looks what comes of them."""

    def __init__(self, subject: Subject, transport: ZenohTransport) -> None:
        self._subject, self._transport = subject, transport
        self._newest: dict[str, bytes] = {}  # by key, what the robot itself has said
        self._sent = b""
        self._round = ""  # the mission, in YAML
        self._params: dict[str, str] = {}
        self._commands = subject.onlooker.bus.latest(CMD_VEL)
        self._asking: set[asyncio.Task[Any]] = set()

    async def begin(self) -> None:
        """Send the robot round, and wait until it drives."""
        onlooker = self._subject.onlooker
        for topic in TOPICS:
            onlooker.bus.tap(topic.at("*"), self._keep)
        truth = await self._subject.truth()
        places = [in_map(truth, place) for place in PLACES]
        steps = "\n".join(
            f"      - fallback: [{{goto: [{x:.2f}, {y:.2f}]}}, {{wait: 0.2}}]" for x, y in places
        )
        self._round = f"do:\n  - repeat:\n      do:\n{steps}\n"
        replies = await onlooker.bus.ask(PARAM, ParamRequest(), name="decision")
        self._params = {one.name: one.value for one in replies[0].params}
        await self._go_round()
        await until(self._drives, "it drives from goal to goal")

    def _keep(self, key: str, _encoding: str, payload: bytes) -> None:
        if payload != self._sent:
            self._newest[key] = payload

    async def tried(self, case: Case) -> Outcome:
        """What becomes of the robot after one message."""
        loop, before = asyncio.get_running_loop(), self._pids()
        held_mb = {name: _held_mb(pid) for name, pid in before.items()}
        began_s = loop.time()
        self._send(case)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(ANSWER_S):
                await self._subject.onlooker.ticks(LOOK_TICKS)
        silent = await self._silent(before)
        await self._until(lambda: self._drives() or case.to in UNDONE or self._accident())
        undone = case.to in UNDONE or (not self._drives() and self._accident())
        began_s = loop.time() if undone else began_s
        for _ in range(UNDONE_TIMES if undone else 0):
            await self._undo()
            await self._until(self._drives, AGAIN_S)
            if self._drives():
                break
        await self._until(self._drives)
        again_s, now = loop.time() - began_s, self._pids()
        ended = tuple(name for name, pid in before.items() if now.get(name) != pid)
        growth: dict[str, float] = {}

        def small() -> bool:
            for name, mb in held_mb.items():
                growth[name] = _held_mb(now[name]) - mb if name in now else 0.0
            return not any(mb > GROWN_MB for name, mb in growth.items() if name not in ended)

        # what it holds until the robot's own message has taken the place of this one is no growth
        await self._until(small)
        most = max(set(growth) - set(ended), key=growth.__getitem__, default="")
        return Outcome(
            number=case.number,
            what=str(case),
            silent=tuple(name for name in silent if name not in ended),
            ended=ended,
            grown_mb=max(0.0, round(growth.get(most, 0.0), 1)),
            grown=most,
            again_s=round(again_s, 2),
            undone=undone,
        )

    def _send(self, case: Case) -> None:
        state = self._subject.onlooker.state
        header = {"boot": state.boot, "tick": state.tick, "basis": state.tick}
        newest = self._newest.get(case.key)
        payload = case.payload(msgspec.msgpack.decode(newest) if newest else None, header)
        self._sent = payload
        if isinstance(case.to, Topic):
            self._transport.publish(case.to, case.key, payload, "")
            return
        asking = asyncio.ensure_future(
            self._transport.query(case.key, payload, "", ANSWER_S, case.to.priority)
        )
        self._asking.add(asking)
        asking.add_done_callback(self._asking.discard)

    def _pids(self) -> dict[str, int]:
        statuses = self._subject.supervisor.statuses
        return {name: one.pid for name, one in statuses.items() if one.pid is not None}

    async def _silent(self, processes: dict[str, int]) -> tuple[str, ...]:
        answers = await asyncio.gather(*(self._answers(name) for name in processes))
        return tuple(name for name, there in zip(processes, answers, strict=True) if not there)

    async def _answers(self, name: str) -> bool:
        bus = self._subject.onlooker.bus
        try:
            return bool(await bus.ask(DESCRIBE, DescribeRequest(), timeout_s=ANSWER_S, name=name))
        except Refused:
            return False

    def _drives(self) -> bool:
        state = self._subject.onlooker.state
        velocity, gate = state.velocity, state.gate
        command = self._commands.current
        mine = gate.mode == "enabled" and gate.commander == BRAIN
        mine = mine and command is not None and not command.operator
        return mine and max(abs(velocity.linear_x), abs(velocity.angular_z)) > MOVES

    def _accident(self) -> bool:
        """Whether the gate has latched for what no sensor may report unheeded, even once."""
        gate = self._subject.onlooker.state.gate
        return gate.mode == "latched" and {one.code for one in gate.causes} <= ACCIDENTS

    async def _until(self, condition: Callable[[], bool], within_s: float = PATIENCE_S) -> None:
        """Wait for it, or for so long."""
        with contextlib.suppress(Failed):
            await until(condition, "all is as it was", within_s)

    async def _undo(self) -> None:
        """As a person would: release, hand back, begin the round again, set what was set."""
        subject, bus = self._subject, self._subject.onlooker.bus
        with contextlib.suppress(TimeoutError, Refused):
            async with asyncio.timeout(AGAIN_S):
                await subject.release()
                await until(lambda: subject.onlooker.state.gate.mode in ("idle", "enabled"), "idle")
                request = EnableRequest(source=BRAIN, take=True, by="a person")
                while not any(one.ok for one in await bus.ask(ENABLE, request)):
                    await subject.onlooker.ticks(2)
        for name, value in self._params.items():
            with contextlib.suppress(Refused):
                await bus.ask(PARAM, ParamRequest(name=name, value=value), name="decision")
        await self._go_round()

    async def _go_round(self) -> None:
        with contextlib.suppress(Refused):
            await self._subject.onlooker.bus.ask(MISSION, MissionRequest(mission=self._round))


def _held_mb(pid: int) -> float:
    """The memory of a process [MB]; nan of one that has just ended."""
    try:
        return rss_mb(pid)
    except Failed:
        return math.nan
