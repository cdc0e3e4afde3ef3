"""Observes a running robot on the bus, and judges it by the robot's own clock."""

import asyncio
import itertools
import math
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

from gigabrain_schemas.base import TICK_MS
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
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.qa.judging import Failed
from gigabrain_zenoh.runtime.connect import connect

PATIENCE_S = 60.0  # far longer than any event here on a busy machine
POLL_S = 0.01
MAX_REST_SPEED = 0.005  # [m/s], [rad/s]
MAX_STRAIGHT_TURN = 0.02  # [rad/s]
NODES = ("driver", "perception", "decision", "control", "safety")


async def until(condition: Callable[[], object], what: str, within_s: float = PATIENCE_S) -> None:
    """Wait until `condition` is true. Raises Failed with `what` when time is up."""
    loop = asyncio.get_running_loop()
    end_s = loop.time() + within_s
    while not condition():
        if loop.time() >= end_s:
            raise Failed(f"not within {within_s:g} s: {what}")
        await asyncio.sleep(POLL_S)


class Probe:
    """Collects a robot's messages: states, the brain's commands, health and logs."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.states: deque[RobotState] = deque(maxlen=50_000)
        self.commands: deque[CmdVel] = deque(maxlen=10_000)  # of the brain
        self.arrivals: deque[int] = deque(maxlen=10_000)  # tick of each command's arrival
        self._ignores_commands = False
        self._unsubscribe_commands: Close | None = None
        self.health: dict[str, Health] = {}
        self.logs: list[LogRecord] = []
        self.safety, self.world = bus.latest(SAFETY), bus.latest(WORLD)
        self.intent = bus.latest(INTENT)
        self.on_state: Callable[[RobotState], None] = lambda _state: None
        bus.latest(STATE, self._on_state)
        self.bodies = bus.latest(BODY, self._on_body)
        bus.subscribe(HEALTH, self._on_health)
        bus.subscribe(LOG, lambda _key, record: self.logs.append(record))

    @property
    def state(self) -> RobotState:
        """The newest state."""
        return self.states[-1]

    @property
    def causes(self) -> set[str]:
        """Codes of the causes for which the gate is shut."""
        return {cause.code for cause in self.state.gate.causes}

    def since(self, start: RobotState) -> list[RobotState]:
        """Return `start` and all later states of the same boot."""
        return [s for s in self.states if s.boot == start.boot and s.tick >= start.tick]

    def _on_state(self, state: RobotState) -> None:
        self.states.append(state)
        self.on_state(state)

    def _on_health(self, _key: str, health: Health) -> None:
        self.health[health.process] = health

    def _on_body(self, body: Body) -> None:
        if self._unsubscribe_commands is None and not self._ignores_commands:
            topic = command_topic(body.description)
            self._unsubscribe_commands = self.bus.subscribe(topic, self._on_command)

    def ignore_commands(self, ignore: bool) -> None:
        """Unsubscribe from commands, or subscribe again with the next `robot/body` (1 Hz).

        Receiving a flood of commands would take CPU time from the robot on the same machine.
        """
        self._ignores_commands = ignore
        if ignore and self._unsubscribe_commands:
            self._unsubscribe_commands()
            self._unsubscribe_commands = None

    def _on_command(self, _key: str, command: CmdVel) -> None:
        if command.source == BRAIN:
            self.commands.append(command)
            self.arrivals.append(self.bus.time.tick)

    async def describe(self, process: str) -> Description:
        """Return a process's description; waits until it answers. Raises Failed."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + PATIENCE_S
        while loop.time() < end_s:
            try:
                replies = await self.bus.ask(DESCRIBE, DescribeRequest(), name=process)
            except Refused:  # no answer in time
                continue
            if replies:
                return replies[0]
            await asyncio.sleep(0.05)
        raise Failed(f"{process} does not answer")

    async def pid(self, process: str) -> int:
        """Return the pid of the process that answers by this name."""
        return (await self.describe(process)).pid

    async def pids(self) -> dict[str, int]:
        """Return the pids of driver and brain."""
        return {name: await self.pid(name) for name in NODES}

    async def truth(self) -> dict[str, Any]:
        """Return the driver's report, which has the simulation's true values."""
        return dict((await self.describe("driver")).report)

    async def driving_straight(
        self, speed: float = 0.25, room: float = 1.3, turning: float = MAX_STRAIGHT_TURN,
        *, by_hand: bool = False,
    ) -> None:  # fmt: skip
        """Wait until the robot drives straight at `speed` [m/s] with `room` [m] ahead.

        Turning by less than `turning` [rad/s] counts as straight. With `by_hand`, enable the brain
        like a person, again each time that a busy machine shuts the gate.
        """

        def driving() -> bool:
            world = self.world.fresh()
            if not (self.states and world and world.sectors):
                return False
            if self.state.gate.mode != "enabled":
                return False  # the measured speed may be older than the gate's closing
            velocity, ahead = self.state.velocity, world.sectors[0]
            is_free = ahead is None or ahead > room
            return is_free and velocity.linear_x > speed and abs(velocity.angular_z) < turning

        async def enable() -> None:
            while True:
                await until(lambda: self.state.gate.mode == "idle", "idle", math.inf)
                await self.enable_brain()

        enabling = asyncio.ensure_future(enable()) if by_hand else None
        try:
            await until(driving, f"driving straight at {speed} m/s")
        finally:
            if enabling:
                enabling.cancel()

    async def enable_brain(self) -> None:
        """Enable the brain like a person; repeat until the gate agrees."""
        while True:
            replies = await self.bus.ask(ENABLE, EnableRequest(source=BRAIN))
            if replies and replies[0].ok:
                return
            await self.ticks(5)

    async def count_enables(self, count: int = 5) -> int:
        """Ask `count` times to enable the brain; return how often the gate agreed."""
        enabled = 0
        for _ in range(count):
            try:
                replies = await self.bus.ask(ENABLE, EnableRequest(source=BRAIN))
            except Refused:
                continue
            enabled += any(reply.ok for reply in replies)
            await self.ticks(5)
        return enabled

    async def at_rest(self, ticks: int = 10) -> None:
        """Wait until the body is at rest for `ticks` of one boot."""
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
        """Wait for `count` ticks of the robot; if it boots, count from there."""
        begin = self.state

        def passed() -> bool:
            since = begin.tick if self.state.boot == begin.boot else 0
            return self.state.tick - since >= count

        await until(passed, f"{count} more ticks")

    def distance_from(self, start: RobotState) -> float:
        """Return the distance of the body from its position in `start` [m]."""
        return math.dist((start.pose.x, start.pose.y), (self.state.pose.x, self.state.pose.y))

    def stops(self, start: RobotState) -> list[int]:
        """Return the ticks since `start` at which the gate left `enabled`."""
        pairs = itertools.pairwise(self.since(start))
        return [b.tick for a, b in pairs if a.gate.mode == "enabled" != b.gate.mode]

    def starts_and_stops(self, start: RobotState, ticks: int) -> int:
        """Count each opening and each closing of the gate within `ticks` of `start`."""
        pairs = itertools.pairwise(s for s in self.since(start) if s.tick <= start.tick + ticks)
        return sum((a.gate.mode == "enabled") != (b.gate.mode == "enabled") for a, b in pairs)

    def control_period_ms(self, start: RobotState) -> float:
        """Return the p99 of control's period since `start`, in the robot's time [ms]."""
        ticks = [c.tick for c in self.commands if c.boot == start.boot and c.tick > start.tick]
        periods = sorted((b - a) * TICK_MS for a, b in itertools.pairwise(ticks))
        p99_ms = percentile(periods, 0.99)
        if p99_ms is None:
            passed = self.state.tick - start.tick
            raise Failed(f"only {len(ticks)} commands received within {passed} ticks")
        return p99_ms


def path_until_rest(
    states: Sequence[RobotState], rests: Callable[[RobotState], bool]
) -> float | None:
    """Return the odometry's path length from the first state to rest [m]; None without rest."""
    path_m = 0.0
    for before, state in itertools.pairwise(states):
        path_m += math.hypot(state.pose.x - before.pose.x, state.pose.y - before.pose.y)
        if rests(state):
            return path_m
    return None


def at_rest(state: RobotState) -> bool:
    """Return whether the body stands still."""
    velocity = state.velocity
    return abs(velocity.linear_x) < MAX_REST_SPEED and abs(velocity.angular_z) < MAX_REST_SPEED


def moving(states: list[RobotState], above: float) -> int:
    """Count the states in which the body drives or turns faster than `above` [m/s], [rad/s]."""
    return sum(max(abs(s.velocity.linear_x), abs(s.velocity.angular_z)) > above for s in states)


@asynccontextmanager
async def probing(endpoint: Endpoint, name: str = "probe") -> AsyncIterator[Probe]:
    """Connect to a robot; wait for its router and its first state."""
    async with connect(endpoint, name, timeout_s=None) as bus:
        probe = Probe(bus)
        await until(lambda: probe.states, "the robot's first state")
        yield probe
