"""An emulated SO-101 on a real pty."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import cast

from gigabrain_drivers.bodies.feetech.driver import FeetechOptions
from gigabrain_drivers.bodies.feetech.emulator import FeetechArm
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.emulators.emulator import Station
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_zenoh.clock import Clock
from tests.unit.drivers.feetech import OPTIONS, FreeArm


@asynccontextmanager
async def emulated_arm(
    port: Path, options: FeetechOptions = OPTIONS
) -> AsyncIterator[tuple[FeetechArm, FreeArm]]:
    """Run an emulated arm with its serial line at `port`, in real time."""
    clock, body = Clock(), FreeArm()
    station = Station(
        lambda wire: FeetechArm(cast(EmulatedBody, body), options, wire),
        Pty(port, FeetechArm.baud),
        clock,
    )
    moving = asyncio.ensure_future(_move(body, clock))
    station.start()
    try:
        assert isinstance(station.device, FeetechArm)
        yield station.device, body
    finally:
        moving.cancel()
        await station.close()


async def _move(body: FreeArm, clock: Clock) -> None:
    async for _ in clock.every(10_000_000):
        body.step(0.01)
