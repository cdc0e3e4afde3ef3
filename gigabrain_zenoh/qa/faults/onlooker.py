"""Looks on while a robot runs, and judges it by the robot's own clock."""

import asyncio
import itertools
import math
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.requests import DescribeRequest, Description, EnableRequest
from gigabrain_schemas.safety import Health, LogRecord
from gigabrain_schemas.topics import (
    BODY,
    DESCRIBE,
    ENABLE,
    HEALTH,
    INTENT,
    LOG,
    SAFETY,
    STATE,
    WORLD,
    command_topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Close
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.qa.faults.fault import Failed
from gigabrain_zenoh.qa.faults.waiting import PATIENCE_S, until

AT_REST = 0.005  # [m/s], [rad/s]
STRAIGHT = 0.02  # [rad/s]
SYSTEMS = ("driver", "perception", "decision", "control", "safety")


class Onlooker:
    """Hears all that a robot says."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.states: deque[RobotState] = deque(maxlen=50_000)
        self.commands: deque[CmdVel] = deque(maxlen=10_000)  # of the brain
        self.arrivals: deque[int] = deque(maxlen=10_000)  # the tick when each of them came
        self._deaf = False
        self._end_hearing: Close | None = None
        self.health: dict[str, Health] = {}
        self.logs: list[LogRecord] = []
        self.safety, self.world = bus.latest(SAFETY), bus.latest(WORLD)
        self.intent = bus.latest(INTENT)
        self.on_state: Callable[[RobotState], None] = lambda _state: None
        bus.latest(STATE, self._see)
        self.bodies = bus.latest(BODY, self._join)
        bus.subscribe(HEALTH, self._hear)
        bus.subscribe(LOG, lambda _key, record: self.logs.append(record))

    @property
    def state(self) -> RobotState:
        """The newest state."""
        return self.states[-1]

    def _see(self, state: RobotState) -> None:
        self.states.append(state)
        self.on_state(state)

    def _hear(self, _key: str, health: Health) -> None:
        self.health[health.process] = health

    def _join(self, body: Body) -> None:
        if self._end_hearing is None and not self._deaf:
            topic = command_topic(body.description)
            self._end_hearing = self.bus.subscribe(topic, self._obey)

    def deafen(self, deaf: bool) -> None:
        """Whether to leave commands unheard, however many come; they are heard again in a second.

        One who looks on would need the time of the machine that the robot runs on.
        """
        self._deaf = deaf
        if deaf and self._end_hearing:
            self._end_hearing()
            self._end_hearing = None

    def _obey(self, _key: str, command: CmdVel) -> None:
        if command.source == BRAIN:
            self.commands.append(command)
            self.arrivals.append(self.bus.time.tick)

    async def describe(self, process: str) -> Description:
        """What a process says of itself; waits until it is there."""
        for _ in range(round(PATIENCE_S)):
            try:
                replies = await self.bus.ask(DESCRIBE, DescribeRequest(), name=process)
            except Refused:  # it has not answered in time
                continue
            if replies:
                return replies[0]
            await asyncio.sleep(0.05)
        raise Failed(f"{process} does not answer")

    async def pid(self, process: str) -> int:
        """The pid under which a process answers."""
        return (await self.describe(process)).pid

    async def pids(self) -> dict[str, int]:
        """The pids of all systems."""
        return {name: await self.pid(name) for name in SYSTEMS}

    async def truth(self) -> dict[str, Any]:
        """What the driver knows that the robot does not."""
        return dict((await self.describe("driver")).report)

    async def straight(
        self,
        speed: float = 0.25,
        room: float = 1.3,
        turning: float = STRAIGHT,
        *,
        by_hand: bool = False,
    ) -> None:
        """Wait until the robot drives straight on at `speed` [m/s] with `room` [m] ahead.

        It counts as straight while it turns by less than `turning` [rad/s].

        `by_hand` enables it as a person would, again and again where a busy machine stops it.
        """

        def driving() -> bool:
            world = self.world.fresh()
            if not (self.states and world and world.sectors):
                return False
            if self.state.gate.mode != "enabled":
                return False  # what it measures may be from before
            velocity, ahead = self.state.velocity, world.sectors[0]
            roomy = ahead is None or ahead > room
            return roomy and velocity.linear_x > speed and abs(velocity.angular_z) < turning

        async def enable() -> None:
            while True:
                await until(lambda: self.state.gate.mode == "idle", "idle", math.inf)
                await self.hand_to_brain()

        person = asyncio.ensure_future(enable()) if by_hand else None
        try:
            await until(driving, f"driving straight at {speed} m/s")
        finally:
            if person:
                person.cancel()

    async def hand_to_brain(self) -> None:
        """As a person: let the brain drive, as soon as nothing speaks against it."""
        while True:
            replies = await self.bus.ask(ENABLE, EnableRequest(source=BRAIN))
            if replies and replies[0].ok:
                return
            await self.ticks(5)

    async def still(self, ticks: int = 10) -> None:
        """Wait until the body has been at rest for `ticks` of one boot."""
        begin = self.state

        def resting() -> bool:
            newest = self.state
            since = begin.tick if newest.boot == begin.boot else 0
            recent = itertools.takewhile(
                lambda s: s.boot == newest.boot and s.tick > max(since, newest.tick - ticks),
                reversed(self.states),
            )
            return newest.tick - since > ticks and all(map(at_rest, recent))

        await until(resting, f"at rest for {ticks} ticks")

    async def ticks(self, count: int) -> None:
        """Let the robot's time go on; where the driver starts anew meanwhile, from then on."""
        begin = self.state

        def passed() -> bool:
            since = begin.tick if self.state.boot == begin.boot else 0
            return self.state.tick - since >= count

        await until(passed, f"{count} more ticks")

    def moved(self, start: RobotState) -> float:
        """How far the body is now from where it was [m]."""
        return math.dist((start.pose.x, start.pose.y), (self.state.pose.x, self.state.pose.y))

    def period_ms(self, start: RobotState) -> float:
        """Control's period (p99) since `start`, by the robot's ticks."""
        ticks = [c.tick for c in self.commands if c.boot == start.boot and c.tick > start.tick]
        periods = sorted((b - a) * TICK_NS / 1e6 for a, b in itertools.pairwise(ticks))
        p99_ms = percentile(periods, 0.99)
        if p99_ms is None:
            passed = self.state.tick - start.tick
            raise Failed(f"{len(ticks)} commands were heard within {passed} ticks")
        return p99_ms

    def travel_until_rest(self, start: RobotState) -> float:
        """The path [m] by odometry from `start` until the body first came to rest."""
        path, before = 0.0, start
        for state in list(self.states):
            if state.boot != start.boot or state.tick <= start.tick:
                continue
            path += math.hypot(state.pose.x - before.pose.x, state.pose.y - before.pose.y)
            before = state
            if at_rest(state):
                return path
        raise Failed("the body has not come to rest")


def at_rest(state: RobotState) -> bool:
    """Whether the body stands still."""
    velocity = state.velocity
    return abs(velocity.linear_x) < AT_REST and abs(velocity.angular_z) < AT_REST


@asynccontextmanager
async def looking_on(endpoint: Endpoint, name: str = "onlooker") -> AsyncIterator[Onlooker]:
    """Join a robot's network; waits for its router and its first state."""
    bus = Bus(await ZenohTransport.open(endpoint), Clock(), name)
    try:
        onlooker = Onlooker(bus)
        await until(lambda: onlooker.states, "the robot's first state")
        yield onlooker
    finally:
        await bus.close()
