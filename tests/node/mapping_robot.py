"""Perception that makes a map of a house, in memory."""

import asyncio
import functools
from typing import Self

from gigabrain_schemas.requests import MapReply, MapRequest
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY, MAP_SAVE, SCAN, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import body, scan, state
from tests.unit.mapping.houses import HOUSE, Rooms, at

SLAM = PerceptionConfig(mapping="slam")


class Robot(NodeBench):
    """Perception alone, with a robot that drives north in the house at 0.2 m/s."""

    def __init__(self, config: PerceptionConfig = SLAM) -> None:
        super().__init__(functools.partial(perception.run, config))
        self.rooms, self.tick, self.boot = Rooms(HOUSE), 0, 7

    async def __aenter__(self) -> Self:
        await super().__aenter__()
        await self.ready()
        return self

    def publish_body(self) -> None:
        self.send(BODY, body(boot=self.boot))

    def scan(self, *, y: float | None = None) -> LaserScan:
        """Return the scan at the present pose, or from `y` m north of the start."""
        north = 0.004 * self.tick if y is None else y
        values = self.rooms.ranges(at(3.0, 2.0 + north, 90))
        return scan(values, self.tick, boot=self.boot)

    def drive(self, scans: int, *, still: bool = False) -> None:
        """Publish `scans` scans, five ticks apart, and a state at each tick."""
        for _ in range(scans):
            for _ in range(5):
                self.tick += 1
                x = 0.0 if still else 0.004 * self.tick
                self.send(STATE, state(self.tick, pose=(x, 0, 0), boot=self.boot))
            self.send(SCAN, self.scan(y=0.0 if still else None))

    async def save(self, name: str, *, replace: bool = False) -> MapReply:
        """Ask perception to save the map, and return its reply. Fake time advances meanwhile."""
        bus = Bus(self.network.transport(), self.clock, "test")
        request = MapRequest(name=name, replace=replace)
        answer = bus.ask(MAP_SAVE, request, timeout_s=600.0)  # of the fake clock below
        asking = asyncio.ensure_future(answer)
        async with asyncio.timeout(30):
            while not asking.done():
                await self.clock.advance(20_000_000)
                await asyncio.sleep(0.005)
        await bus.close()
        return asking.result()[0]
