"""A simulated body in a flat world of cells, driven only by the decision node, in fake time."""

import asyncio
import functools
import math
from types import TracebackType
from typing import Self, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.brain import Intent, OccupancyGrid, PoseInMap, WorldModel
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import BODY, INTENT, MAP, POSE, STATE, TASK, WORLD, Service
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.geometry.limits import limits_of, ramp
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import BOOT, DRIVING, TICK_NS, WAFFLE, body, scan, state

Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)

CELL = 0.05  # [m]
PIXELS = {"#": 100, ".": 0, "?": -1}
Cells = NDArray[np.int8]

ROOM = """
####################
#..................#
#..................#
#.........#........#
#.........#........#
#.........#........#
#.........#........#
####################
"""  # a character is 0.25 m; the first line has the largest y


def drawn(picture: str, scale: int = 5) -> Cells:
    """Return the cells of a drawing, (height, width), with the last line first."""
    lines = picture.strip().splitlines()[::-1]
    rows = np.array([[PIXELS[c] for c in line] for line in lines], np.int8)
    return np.kron(rows, np.ones((scale, scale), np.int8))


def as_map(cells: Cells, tick: int, boot: int) -> OccupancyGrid:
    """Return the map of these cells, with its origin at the corner of the first cell."""
    height, width = cells.shape
    return OccupancyGrid(
        resolution=CELL, width=width, height=height, origin_x=0.0, origin_y=0.0,
        cells=cells.tobytes(), boot=boot, tick=tick, basis=tick,
    )  # fmt: skip


class Plane:
    """A Waffle in a world of cells. Use it as `async with Plane(cells) as plane:`."""

    def __init__(
        self,
        cells: Cells,
        at: tuple[float, float, float] = (1.0, 1.0, 0.0),
        config: DecisionConfig | None = None,
    ) -> None:
        config = config or DecisionConfig(behaviour="navigate")
        self.bench = NodeBench(functools.partial(decision.run, config))
        self.cells, self.known = cells, cells.copy()
        self.x, self.y, self.yaw = at
        self.start = at  # pose at which the odometry started
        self.velocity, self.tick, self.localized = Velocity(), 0, True
        self.intent = Intent(behaviour="none", reason="")
        self.intents: list[Intent] = []  # one per scan
        self.status = TaskStatus()
        self.gate = DRIVING
        self.travelled = 0.0
        self.closest = math.inf  # [m], from the body's centre to an obstacle
        self.maps = True  # whether perception publishes maps
        self.maps_sent = False  # whether the newest map was sent
        self.boot, self.description = BOOT, WAFFLE
        self.late_ticks = 0  # transit time of world models and poses [ticks]
        self._in_transit: list[tuple[int, WorldModel, PoseInMap]] = []

    async def __aenter__(self) -> Self:
        await self.bench.__aenter__()
        await self.bench.ready()
        self.operator = Bus(self.bench.network.transport(), self.bench.clock, "operator")
        self.operator.subscribe(INTENT, self._on_intent)
        self.operator.subscribe(TASK, self._on_status)
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.operator.close()
        await self.bench.__aexit__(kind, error, traceback)

    async def go(self, seconds: float) -> None:
        """Let `seconds` of fake time pass."""
        for _ in range(round(seconds * 50)):
            await self._tick()

    async def until(self, *states: str, seconds: float) -> None:
        """Let time pass until a task ends; assert that it ends in one of `states`."""
        for _ in range(round(seconds * 50)):
            await self._tick()
            if not self.status.current and self.status.done:
                assert self.status.done[0].state in states, self.status.done[0]
                return
        raise AssertionError(f"at ({self.x:.2f}, {self.y:.2f}): {self.intent.reason}")

    async def ask(self, service: Service[Q, R], request: Q) -> R:
        """Send a request, and return the reply. Time advances meanwhile."""
        asking = asyncio.ensure_future(self.operator.ask(service, request, timeout_s=30.0))
        while not asking.done():
            await self._tick()
            await asyncio.sleep(0.001)
        return asking.result()[0]

    async def ask_at_once(self, service: Service[Q, R], request: Q) -> R:
        """Send a request while time stands still, and return the reply."""
        return (await self.operator.ask(service, request, timeout_s=30.0))[0]

    def restart_driver(self) -> None:
        """Restart ticks and odometry. The map and the pose in it stay; no new map is sent."""
        self.boot, self.tick, self.start = self.boot + 1, 1, (self.x, self.y, self.yaw)
        self.velocity, self.maps_sent = Velocity(), True

    async def restart(self) -> None:
        """Restart the decision node."""
        await self.bench.restart()
        await self.bench.ready()

    async def _tick(self) -> None:
        self.tick += 1
        self._move()
        bench = self.bench
        if self.tick % 50 == 2:
            own = body(self.description, boot=self.boot)
            bench.send(BODY, msgspec.structs.replace(own, tick=self.tick))
            if self.maps and not self.maps_sent:
                bench.send(MAP, as_map(self.known, self.tick, self.boot))
        x, y, yaw = self._odometry()
        bench.send(
            STATE, state(self.tick, v=self.velocity.linear_x, w=self.velocity.angular_z,
                         pose=(x, y, yaw), gate=self.gate, boot=self.boot),
        )  # fmt: skip
        if self.tick % 5 == 0:
            self._in_transit.append((self.tick + self.late_ticks, self._world(), self._place()))
        while self._in_transit and self._in_transit[0][0] <= self.tick:
            _, world, place = self._in_transit.pop(0)
            bench.send(WORLD, world)
            if self.maps:
                bench.send(POSE, place)
        await bench.clock.advance(TICK_NS)

    def _on_intent(self, _key: str, intent: Intent) -> None:
        if intent.basis != self.intent.basis:
            self.intents.append(intent)
        self.intent = intent

    def _on_status(self, _key: str, status: TaskStatus) -> None:
        self.status = status

    def _move(self) -> None:
        wanted = self.intent.twist or Velocity()
        self.velocity = ramp(self.velocity, wanted, limits_of(WAFFLE), 0.02)
        v, w = self.velocity.linear_x, self.velocity.angular_z
        self.yaw += w * 0.02
        self.x += v * 0.02 * math.cos(self.yaw)
        self.y += v * 0.02 * math.sin(self.yaw)
        self.travelled += abs(v) * 0.02

    def _odometry(self) -> tuple[float, float, float]:
        x, y, yaw = self.start
        dx, dy = self.x - x, self.y - y
        c, s = math.cos(yaw), math.sin(yaw)
        return c * dx + s * dy, c * dy - s * dx, math.remainder(self.yaw - yaw, math.tau)

    def _world(self) -> WorldModel:
        ranges = self._ranges()
        self.closest = min(self.closest, float(np.nanmin(ranges)))
        config = PerceptionConfig(mapping="slam")
        seen = perception.step(config, WAFFLE, scan(ranges, self.tick))
        return msgspec.structs.replace(seen, boot=self.boot, tick=self.tick, basis=self.tick)

    def _ranges(self) -> NDArray[np.float64]:
        """Return the ranges [m] of 360 beams, in steps of half a cell; inf without a hit."""
        reach = np.arange(0.0, 3.5, CELL / 2)
        angles = self.yaw + np.radians(np.arange(360.0))
        columns = ((self.x + np.outer(np.cos(angles), reach)) / CELL).astype(int)
        rows = ((self.y + np.outer(np.sin(angles), reach)) / CELL).astype(int)
        height, width = self.cells.shape
        inside = (rows >= 0) & (columns >= 0) & (rows < height) & (columns < width)
        occupied = np.zeros(rows.shape, bool)
        occupied[inside] = self.cells[rows[inside], columns[inside]] == 100
        self._see(rows, columns, inside, occupied)
        first = occupied.argmax(axis=1)
        return np.where(occupied.any(axis=1), reach[first], np.inf)

    def _see(
        self,
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        inside: NDArray[np.bool_],
        occupied: NDArray[np.bool_],
    ) -> None:
        """Mark the cells that the beams passed or hit as known."""
        passed = inside & (np.cumsum(occupied, axis=1) - occupied == 0)
        r, c = rows[passed], columns[passed]
        self.known[r, c] = self.cells[r, c]

    def _place(self) -> PoseInMap:
        covariance = (0.0,) * 9
        return PoseInMap(
            x=self.x, y=self.y, yaw=math.remainder(self.yaw, math.tau), covariance=covariance,
            localized=self.localized, boot=self.boot, tick=self.tick, basis=self.tick,
        )  # fmt: skip
