"""Single extreme messages: none may stop a robot.

Started as `python -m gigabrain_zenoh.qa.faults.rows.extreme_messages FILE [NUMBER ...]` it sends
all of them, to one robot after the other. Each result is a line of FILE; messages that have one are
not sent again, so that an interrupted run continues. With numbers only those are sent.
"""

import asyncio
import contextlib
import math
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from gigabrain_schemas.requests import DescribeRequest, EnableRequest, ParamRequest
from gigabrain_schemas.sim import SimRequest
from gigabrain_schemas.tasks import MissionRequest
from gigabrain_schemas.topics import (
    BUTTON,
    CMD_VEL,
    DESCRIBE,
    ENABLE,
    ESTOP,
    ESTOP_TOPIC,
    GOAL,
    MAP_LOAD,
    MISSION,
    PARAM,
    POSE,
    POSE_SET,
    SAFETY,
    SIM_CHANGE,
    TASK_CHANGE,
    TELEOP,
    TOPICS,
    ZONES,
    Topic,
)
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.client.objects import set_pose
from gigabrain_zenoh.client.requests import change_world
from gigabrain_zenoh.errors import BodyLost, Refused
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.pose import relative
from gigabrain_zenoh.host.files import read_bounded
from gigabrain_zenoh.qa.faults.hostile import ExtremeMessage, all_extremes, chosen_extremes
from gigabrain_zenoh.qa.faults.rig import DRIVES_AGAIN_WALL, MEMORY_GROWN, Options, Rig
from gigabrain_zenoh.qa.faults.rows.goal_recovery import (
    PLACES,
    in_map,
    needs_navigation,
    true_pose,
    waiting_robot,
)
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, fault_row
from gigabrain_zenoh.qa.probe import moving, until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest, rss_mb

# messages that may stop, take, cancel or misplace by their purpose: undone as a person would
UNDONE = (
    ESTOP, ESTOP_TOPIC, BUTTON, SAFETY, ENABLE, TELEOP, GOAL, MISSION, TASK_CHANGE, PARAM,
    MAP_LOAD, POSE_SET, SIM_CHANGE, ZONES,
)  # fmt: skip
ACCIDENTS = {"collision", "tilted"}
LOOK_TICKS = 7  # until a message has gone the whole way: more than a scan
ANSWER_S = 1.0
GROWN_MB = 50.0
AGAIN_S, AGAIN_AFTER_DEATH_S = 3.0, 10.0
UNDO_ATTEMPTS = 3  # on a busy machine a message may take effect after it was undone
PATIENCE_S = 30.0  # until the next message at most, where it does not drive again in time
MOVES = 0.02  # [m/s], [rad/s]
MAX_FILE_BYTES = 100_000_000
BATCH = 100  # messages to one robot; then a new one begins

UNRESPONSIVE = Figure("unresponsive processes")
AGAIN_AFTER_DEATH = Figure("after a death", "s", wall=True)


class MessageEffect(Struct, frozen=True, kw_only=True):
    """The effect of one message on a robot."""

    number: int
    what: str
    silent: tuple[str, ...] = ()  # processes that did not answer in time
    ended: tuple[str, ...] = ()  # processes that were started again
    grown_mb: float = 0.0  # of the process that grew most
    grown: str = ""  # which one that is
    again_s: float = 0.0  # until it drove again
    undone: bool = False  # whether its purpose was undone

    @property
    def wrong(self) -> str:
        """The harm in words; empty for none."""
        limit_s = AGAIN_AFTER_DEATH_S if self.ended else AGAIN_S
        found = []
        if self.silent:
            found.append(f"{', '.join(self.silent)} did not answer within {ANSWER_S:g} s")
        if self.grown_mb > GROWN_MB:
            found.append(f"{self.grown} grew by {self.grown_mb:.0f} MB")
        if self.again_s > limit_s:
            found.append(f"it drove again after {self.again_s:.1f} s")
        return "; ".join(found)


@fault_row(
    49, "", UNRESPONSIVE.at_most(0), MEMORY_GROWN.at_most(GROWN_MB),
    DRIVES_AGAIN_WALL.at_most(AGAIN_S), AGAIN_AFTER_DEATH.at_most(AGAIN_AFTER_DEATH_S),
    needs=("nav",), loads=True,
)  # fmt: skip
async def extreme_messages(rig: Rig) -> Measured:
    """Send a fixed set of extremes, one after the other, to a robot that drives between goals."""
    needs_navigation()
    deployment = waiting_robot(rig.options)
    async with rig.own_robot(deployment, checked=False) as robot, sending(robot) as sender:
        effects = [await sender.effect_of(message) for message in chosen_extremes()]
    harmful = [one for one in effects if one.silent or one.grown_mb > GROWN_MB]
    if harmful:  # a figure would not name them
        raise Failed("; ".join(f"{one.what}: {one.wrong}" for one in harmful))
    return figures(effects)


def figures(effects: Sequence[MessageEffect]) -> dict[Figure, float]:
    """Return the figures of the row."""
    calm = [one.again_s for one in effects if not one.ended]
    after_death = [one.again_s for one in effects if one.ended]
    return {
        UNRESPONSIVE: sum(bool(one.silent) for one in effects),
        MEMORY_GROWN: max((one.grown_mb for one in effects), default=0.0),
        DRIVES_AGAIN_WALL: max(calm, default=0.0),
        AGAIN_AFTER_DEATH: max(after_death, default=0.0),
    }


@asynccontextmanager
async def sending(robot: RobotUnderTest) -> AsyncIterator["ExtremeSender"]:
    """Join the robot's network, and wait until the robot drives."""
    transport = await ZenohTransport.open(robot.endpoint)
    try:
        sender = ExtremeSender(robot, transport, await robot.truth())
        await sender.begin()
        yield sender
    finally:
        await transport.close()


class ExtremeSender:
    """Sends extreme messages to one robot, and observes their effects."""

    def __init__(
        self, robot: RobotUnderTest, transport: ZenohTransport, start: Mapping[str, Any]
    ) -> None:
        self._robot, self._probe, self._transport = robot, robot.probe, transport
        self._newest: dict[str, bytes] = {}  # the robot's own newest message, by key
        self._sent = b""
        self._mission = ""  # in YAML
        self._params: dict[str, str] = {}
        self._commands = robot.probe.bus.latest(CMD_VEL)
        self._poses = robot.probe.bus.latest(POSE)
        self._start = start  # the truth where the map has its origin
        self._asking: set[asyncio.Task[Any]] = set()

    async def begin(self) -> None:
        """Send the robot on an endless round, and wait until it drives."""
        bus = self._probe.bus
        for topic in TOPICS:
            bus.tap(topic.at("*"), self._keep)
        places = [in_map(self._start, place) for place in PLACES]
        steps = "\n".join(
            f"      - fallback: [{{goto: [{x:.2f}, {y:.2f}]}}, {{wait: 0.2}}]" for x, y in places
        )
        self._mission = f"do:\n  - repeat:\n      do:\n{steps}\n"
        replies = await bus.ask(PARAM, ParamRequest(), name="decision")
        self._params = {one.name: one.value for one in replies[0].params}
        await self._start_mission()
        await until(self._drives, "it drives from goal to goal")

    def _keep(self, key: str, _encoding: str, payload: bytes) -> None:
        if payload != self._sent:
            self._newest[key] = payload

    async def effect_of(self, message: ExtremeMessage) -> MessageEffect:
        """Send one message; return its effect."""
        loop, before = asyncio.get_running_loop(), self._robot.pids
        held_mb = {name: _held_mb(pid) for name, pid in before.items()}
        own, began_s = self._newest.get(message.key), loop.time()
        self._send(message)
        await self._let_spread()
        silent = await self._silent(before)
        await self._until(lambda: self._drives() or message.to in UNDONE or self._accident())
        undone = message.to in UNDONE or (not self._drives() and self._accident())
        if undone:
            await self._has_taken_effect(message, own)
            began_s = loop.time()
        for _ in range(UNDO_ATTEMPTS if undone else 0):
            await self._undo()
            await self._until(self._drives, AGAIN_S)
            if self._drives():
                break
        await self._until(self._drives)
        again_s, now = loop.time() - began_s, self._robot.pids
        ended = tuple(name for name, pid in before.items() if now.get(name) != pid)
        growth = await self._growth(held_mb, now, ended)
        most = max(set(growth) - set(ended), key=growth.__getitem__, default="")
        return MessageEffect(
            number=message.number,
            what=str(message),
            silent=tuple(name for name in silent if name not in ended),
            ended=ended,
            grown_mb=max(0.0, round(growth.get(most, 0.0), 1)),
            grown=most,
            again_s=round(again_s, 2),
            undone=undone,
        )

    async def _has_taken_effect(self, message: ExtremeMessage, own: bytes | None) -> None:
        """Wait for the answer, or until the robot's `own` message has replaced the extreme one."""
        if self._asking:
            await asyncio.wait(self._asking, timeout=ANSWER_S)
            await self._let_spread()
        if own is not None:
            await self._until(lambda: self._newest.get(message.key) is not own, AGAIN_S)

    async def _let_spread(self) -> None:
        """Wait until all processes can have reacted."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(ANSWER_S):
                await self._probe.ticks(LOOK_TICKS)

    async def _growth(
        self, held_mb: dict[str, float], now: dict[str, int], ended: tuple[str, ...]
    ) -> dict[str, float]:
        """Return the growth of each process [MB].

        Memory that is held until the robot's own message replaces the extreme one is no growth.
        """
        growth: dict[str, float] = {}

        def small() -> bool:
            for name, mb in held_mb.items():
                growth[name] = _held_mb(now[name]) - mb if name in now else 0.0
            return not any(mb > GROWN_MB for name, mb in growth.items() if name not in ended)

        await self._until(small)
        return growth

    def _send(self, message: ExtremeMessage) -> None:
        state = self._probe.state
        header = {"boot": state.boot, "tick": state.tick, "basis": state.tick}
        newest = self._newest.get(message.key)
        payload = message.payload(msgspec.msgpack.decode(newest) if newest else None, header)
        self._sent = payload
        if isinstance(message.to, Topic):
            self._transport.publish(message.to, message.key, payload, "")
            return
        asking = asyncio.ensure_future(
            self._transport.query(message.key, payload, "", ANSWER_S, message.to.priority)
        )
        self._asking.add(asking)
        asking.add_done_callback(self._asking.discard)

    async def _silent(self, processes: dict[str, int]) -> tuple[str, ...]:
        answers = await asyncio.gather(*(self._answers(name) for name in processes))
        return tuple(name for name, there in zip(processes, answers, strict=True) if not there)

    async def _answers(self, name: str) -> bool:
        try:
            replies = await self._probe.bus.ask(
                DESCRIBE, DescribeRequest(), timeout_s=ANSWER_S, name=name
            )
        except Refused:
            return False
        return bool(replies)

    def _drives(self) -> bool:
        state, command = self._probe.state, self._commands.current
        by_brain = state.gate.mode == "enabled" and state.gate.commander == BRAIN
        by_brain = by_brain and command is not None and not command.operator
        return by_brain and bool(moving([state], MOVES))

    def _accident(self) -> bool:
        """Return whether the gate has latched for a reading that always latches, however brief."""
        return self._probe.state.gate.mode == "latched" and self._probe.causes <= ACCIDENTS

    async def _until(self, condition: Callable[[], bool], within_s: float = PATIENCE_S) -> None:
        """Wait for a condition, or until time is up."""
        with contextlib.suppress(Failed):
            await until(condition, "as before", within_s)

    async def _undo(self) -> None:
        """Release, enable, clear the world, localize, reset parameters, restart the mission."""
        robot, bus = self._robot, self._probe.bus
        with contextlib.suppress(TimeoutError, Refused):
            async with asyncio.timeout(AGAIN_S):
                await robot.release()
                await until(lambda: self._probe.state.gate.mode in ("idle", "enabled"), "idle")
                request = EnableRequest(source=BRAIN, take=True, by="a person")
                while not any(one.ok for one in await bus.ask(ENABLE, request)):
                    await self._probe.ticks(2)
        await self._clear_world()
        await self._localize()
        for name, value in self._params.items():
            with contextlib.suppress(Refused):
                await bus.ask(PARAM, ParamRequest(name=name, value=value), name="decision")
        await self._start_mission()

    async def _clear_world(self) -> None:
        """Remove the objects that were added to the simulated world."""
        with contextlib.suppress(BodyLost, Refused):
            for thing in (await change_world(self._probe.bus, SimRequest())).things:
                await change_world(self._probe.bus, SimRequest(do="remove", name=thing.name))

    async def _localize(self) -> None:
        """Set the robot's true pose where perception does not know it."""
        pose = self._poses.current
        if pose is None or not pose.localized:
            here = relative(true_pose(self._start), true_pose(await self._robot.truth()))
            with contextlib.suppress(BodyLost, Refused):
                await set_pose(self._probe.bus, here.x, here.y, here.yaw)

    async def _start_mission(self) -> None:
        with contextlib.suppress(Refused):
            await self._probe.bus.ask(MISSION, MissionRequest(mission=self._mission))


def _held_mb(pid: int) -> float:
    """Return the memory of a process [MB]; NaN when it has just ended."""
    try:
        return rss_mb(pid)
    except Failed:
        return math.nan


def main(words: list[str]) -> int:
    """Send all messages, or those numbered; returns 1 where one has done harm."""
    path, numbers = Path(words[0]), {int(word) for word in words[1:]}
    path.parent.mkdir(parents=True, exist_ok=True)
    known = {one.number for one in read_effects(path)}
    left = [
        one
        for one in all_extremes()
        if (one.number in numbers if numbers else one.number not in known)
    ]
    with contextlib.suppress(KeyboardInterrupt):  # the next run continues from here
        asyncio.run(_send_all(left, path))
    effects = {one.number: one for one in read_effects(path)}
    wrong = [one for one in effects.values() if one.wrong]
    for one in sorted(wrong, key=lambda one: one.number):
        print(f"{one.what}: {one.wrong}")
    print(f"{len(effects) - len(wrong)} of {len(all_extremes())} messages did no harm")
    return 1 if wrong else 0


def read_effects(path: Path) -> Iterator[MessageEffect]:
    """Yield the results in a file; a line that was cut off is skipped."""
    for line in read_bounded(path, MAX_FILE_BYTES).splitlines() if path.exists() else ():
        try:
            yield msgspec.json.decode(line, type=MessageEffect)
        except msgspec.DecodeError:
            continue


async def _send_all(left: list[ExtremeMessage], path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        async with Rig(Options(), Path(folder)) as rig:
            for first in range(0, len(left), BATCH):
                await _send_batch(rig, left[first : first + BATCH], path)


async def _send_batch(rig: Rig, batch: list[ExtremeMessage], path: Path) -> None:
    async with rig.new(waiting_robot(rig.options)) as robot, sending(robot) as sender:
        for message in batch:
            effect = await sender.effect_of(message)
            with path.open("ab") as file:
                file.write(msgspec.json.encode(effect) + b"\n")
            if effect.wrong or effect.ended:
                ended = f" ended: {', '.join(effect.ended)}" if effect.ended else ""
                print(f"{message}: {effect.wrong}{ended}", flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
