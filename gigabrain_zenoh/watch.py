"""Watches a robot from outside: the newest of everything that people want to see."""

import asyncio
import contextlib

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.requests import DescribeRequest, Description
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import (
    CMD_VEL,
    DESCRIBE,
    HEALTH,
    INTENT,
    MAP,
    SAFETY,
    STATE,
    TASK,
    WORLD,
)
from gigabrain_zenoh.bounded import put
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.causes import LATE
from gigabrain_zenoh.errors import Refused

UNKNOWN = b"\xff"  # a cell of which nothing is known
PROCESSES = 64  # whose health is kept
ASK_S, PAUSE_S = 1.0, 0.1  # of one question, and until the next


class Watch:
    """What the robot is doing, as far as it can be heard."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.state = bus.latest(STATE, self._moved)
        self.world = bus.latest(WORLD)
        self.intent = bus.latest(INTENT)
        self.command = bus.latest(CMD_VEL)
        self.safety = bus.latest(SAFETY)
        self.task = bus.latest(TASK)
        self.map = bus.latest(MAP)
        self.health: dict[str, Health] = {}
        self.distance_m = 0.0  # by odometry
        self._last: RobotState | None = None
        bus.subscribe(HEALTH, self._healthy)

    @property
    def problem(self) -> str:
        """Why nothing can be made of what is heard any more; empty while all is well."""
        failed = self._bus.failed
        return str(failed.exception()) if failed.done() else ""

    @property
    def seconds(self) -> float:
        """Time of the robot since its driver's start [s]."""
        return self._bus.time.tick * 0.02

    @property
    def mapped_m2(self) -> float | None:
        """How much is known of the map: free or taken [m2]; None where there is no map."""
        grid = self.map.current
        if grid is None:
            return None
        return (len(grid.cells) - grid.cells.count(UNKNOWN)) * grid.resolution**2

    @property
    def held_by_load(self) -> bool:
        """Whether the brain is too late for the gate while the processors have no time to spare."""
        state, verdict = self.state.newest, self.safety.current
        if state is None or verdict is None or not state.gate.enables:
            return False
        busy = any(warning.code == "cpu_busy" for warning in verdict.warnings)
        late = any(cause.code in LATE for cause in (*state.gate.causes, *verdict.causes))
        return busy and late and state.gate.mode in ("idle", "stopping")

    async def describe(self, process: str, timeout_s: float = 0.3) -> Description | None:
        """What a process says of itself, or None when it does not answer.

        Asked again until the time is over: a machine that stalled may have cost either side its
        session, which comes back by itself, but a question in between goes nowhere.
        """
        loop = asyncio.get_running_loop()
        end_s = loop.time() + timeout_s
        while (left_s := end_s - loop.time()) > 0:
            with contextlib.suppress(Refused):
                for reply in await self._bus.ask(
                    DESCRIBE, DescribeRequest(), timeout_s=min(left_s, ASK_S), name=process
                ):
                    return reply
            await asyncio.sleep(min(left_s, PAUSE_S))
        return None

    def _healthy(self, _key: str, health: Health) -> None:
        put(self.health, health.process, health, PROCESSES)

    def _moved(self, state: RobotState) -> None:
        last, self._last = self._last, state
        if last and last.boot == state.boot:
            dx, dy = state.pose.x - last.pose.x, state.pose.y - last.pose.y
            self.distance_m += (dx * dx + dy * dy) ** 0.5
