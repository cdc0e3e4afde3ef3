"""Watches a robot from outside: keeps the newest message of everything shown to people."""

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
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.causes import LATE
from gigabrain_zenoh.host.bounded import put_newest

UNKNOWN = b"\xff"  # an unknown cell
PROCESSES = 64  # at most, whose health is kept
ASK_S, PAUSE_S = 1.0, 0.1  # timeout of one query, and pause before the next


class Watch:
    """Newest state of a robot, from the messages it publishes."""

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
        """Return why messages can no longer be processed; an empty text while they are."""
        failed = self._bus.failed
        return str(failed.exception()) if failed.done() else ""

    @property
    def seconds(self) -> float:
        """Return the robot's time since its driver started [s]."""
        return self._bus.time.tick * 0.02

    @property
    def mapped_m2(self) -> float | None:
        """Return the area of the map known to be free or occupied [m2]; None without a map."""
        grid = self.map.current
        if grid is None:
            return None
        return (len(grid.cells) - grid.cells.count(UNKNOWN)) * grid.resolution**2

    @property
    def held_by_load(self) -> bool:
        """Return whether the brain is late for the gate while the processors are fully loaded."""
        state, verdict = self.state.newest, self.safety.current
        if state is None or verdict is None or not state.gate.enables:
            return False
        busy = any(warning.code == "cpu_busy" for warning in verdict.warnings)
        late = any(cause.code in LATE for cause in (*state.gate.causes, *verdict.causes))
        return busy and late and state.gate.mode in ("idle", "stopping")

    async def describe(self, process: str, timeout_s: float = 0.3) -> Description | None:
        """Return a process's description of itself; None without an answer in `timeout_s`.

        The query is repeated until then. A machine that stalled may have cost either side its
        session. The session recovers by itself, but queries in between are lost.
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
        put_newest(self.health, health.process, health, PROCESSES)

    def _moved(self, state: RobotState) -> None:
        last, self._last = self._last, state
        if last and last.boot == state.boot:
            dx, dy = state.pose.x - last.pose.x, state.pose.y - last.pose.y
            self.distance_m += (dx * dx + dy * dy) ** 0.5
