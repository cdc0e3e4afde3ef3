"""An emulated SO-101 on a real pty."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import cast

from gigabrain_drivers.bodies.feetech.driver import FeetechOptions
from gigabrain_drivers.bodies.feetech.emulator import FeetechArm
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.emulators.emulator import Station
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_zenoh.clock import Clock
from tests.unit.drivers.feetech import FOLDER, OPTIONS, ROBOT


@asynccontextmanager
async def emulated_arm(port: Path, options: FeetechOptions = OPTIONS) -> AsyncIterator[FeetechArm]:
    """An arm whose line appears at `port`, and whose time goes on by itself."""
    body = cast(EmulatedBody, SimpleNamespace(robot=ROBOT, run=Run(folder=FOLDER)))
    station = Station(
        lambda wire: FeetechArm(body, options, wire), Pty(port, FeetechArm.baud), Clock()
    )
    station.start()
    try:
        assert isinstance(station.device, FeetechArm)
        yield station.device
    finally:
        await station.close()
