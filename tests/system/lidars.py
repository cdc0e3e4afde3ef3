"""Emulated lidars on real ptys, on a Waffle at rest in the arena."""

import functools
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import Device, EmulatedBody
from gigabrain_drivers.emulators.emulator import Station, emulated_body
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_drivers.lidars.serial_source import SerialSource
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.testing.waiting import until

LIDAR = Lidar(beams=360, rate_hz=10, range_min=0.12, range_max=3.5)


class Wire:
    """Collects the bytes of a device."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def write(self, data: bytes) -> bool:
        self.sent.append(data)
        return True


def waffle(world: str = "arena") -> EmulatedBody:
    """Return an emulated Waffle that is not started, so its time stands still."""
    return emulated_body("turtlebot3_waffle", Run(folder=Path(), world=world))


@functools.cache
def truth() -> NDArray[np.float32]:
    """Return the scan of the simulation's own lidar at the body's place, (360,) [m]."""
    return waffle().simulation.scan()


def run_for(body: EmulatedBody, device: Device, seconds: float) -> None:
    """Advance simulated time in steps of 10 ms, without waiting."""
    for _ in range(round(seconds * 100)):
        body._step()
        device.step(body.snapshot.time_ns)


@asynccontextmanager
async def emulated(device: type[Device], options: Any) -> AsyncIterator[Station]:
    """Run a device on its pty in real time."""
    body = waffle()
    station = Station(functools.partial(device, body, options), device.port(options), Clock())
    body.start()
    station.start()
    try:
        yield station
    finally:
        await station.close()
        await body.close()


class Listener:
    """Collects the scans of a source from its opening to its close."""

    def __init__(self, source: SerialSource) -> None:
        self.source, self.scans = source, list[LaserScan]()
        source.emit = self.scans.append

    async def __aenter__(self) -> "Listener":
        self.source.open()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.source.close()

    async def next_scans(self, count: int) -> list[LaserScan]:
        """Wait for the next `count` scans and return them."""
        start = len(self.scans)
        await until(lambda: len(self.scans) >= start + count)
        return self.scans[start : start + count]

    async def next_scan_like(
        self, expected: NDArray[np.float32], share: float, within: float = 0.06
    ) -> None:
        """Wait for a new scan that agrees with `expected`; a busy machine loses parts of others."""
        seen = len(self.scans)
        await until(
            lambda: any(agreement(one, expected, within) > share for one in self.scans[seen:])
        )


def lost_bytes(station: Station) -> int:
    """Return the count of bytes that this machine has read too late."""
    port = station._port
    assert isinstance(port, Pty)
    return port.lost_bytes


def agreement(scan: LaserScan, expected: NDArray[np.float32], within: float = 0.06) -> float:
    """Return the share of beams that agree with the expected beam or one of its neighbours."""
    got, seen = (
        np.nan_to_num(values, nan=-1.0, posinf=99.0) for values in (scan.ranges_m, expected)
    )
    near = [np.roll(seen, shift) for shift in (-1, 0, 1)]
    return float(np.mean(np.any([np.abs(got - other) < within for other in near], axis=0)))
