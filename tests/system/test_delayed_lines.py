"""Emulated devices behind a proxy that delays their bytes, in real time."""

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from msgspec.structs import replace

from gigabrain_drivers.bodies.line.driver import LineDriver
from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.lidars.ld.emulator import LdDevice
from gigabrain_drivers.lidars.ld.source import Ld19
from gigabrain_schemas.base import TICK_S, Velocity
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.geometry.limits import limits_of, ramp
from gigabrain_zenoh.qa.proxy.chaos import CALM, Chaos
from gigabrain_zenoh.qa.proxy.serial import LineProxy
from gigabrain_zenoh.safety.latency import SpeedDelay
from gigabrain_zenoh.testing.line import EmulatedLine
from gigabrain_zenoh.testing.waiting import until
from tests.system.lidars import LIDAR, Listener, emulated


async def test_scans_of_an_ld19_report_the_delay_of_its_line(tmp_path: Path) -> None:
    device = ScanOptions(driver="ld19", port=str(tmp_path / "scan"))
    behind = ScanOptions(driver="ld19", port=str(tmp_path / "behind"))
    async with (
        emulated(LdDevice, device),
        LineProxy(device.port, Path(behind.port)) as proxy,
        Listener(Ld19(behind, LIDAR, Clock())) as listener,
    ):
        await listener.next_scans(5)
        await until(lambda: listener.scans[-1].late_ms < 40.0)
        proxy.set(Chaos(delay_ms=100.0))
        await until(lambda: listener.scans[-1].late_ms >= 70.0)
        proxy.set(CALM)
        await until(lambda: listener.scans[-1].late_ms < 40.0)


class OscillatingBase:
    """A base on a text line, commanded to and fro; measures the delay of its speed."""

    def __init__(self, driver: LineDriver) -> None:
        self.driver, self.lag = driver, SpeedDelay()

    async def run(self) -> None:
        commanded, limits, begin = (
            Velocity(),
            limits_of(self.driver.robot),
            asyncio.get_running_loop(),
        )
        start_s, last = begin.time(), 0
        for step in itertools.count():
            to = Velocity(linear_x=0.3 if step % 60 < 30 else -0.3)
            commanded = ramp(commanded, to, limits, TICK_S)
            sent = await self.driver.set_base_velocity(commanded.linear_x, 0.0, 0.0)
            await asyncio.sleep(TICK_S)
            tick = round((begin.time() - start_s) / TICK_S)
            state = replace(await self.driver.read_state(), tick=tick, sent=sent)
            self.lag, last = self.lag.then(state, tick - last), tick

    def is_late(self, least: int, most: int) -> Callable[[], bool]:
        return lambda: self.lag.ticks is not None and least <= self.lag.ticks <= most


@asynccontextmanager
async def oscillating_base(bench: EmulatedLine, port: Path) -> AsyncIterator[OscillatingBase]:
    options = replace(bench.driver.options, port=str(port))
    driver = LineDriver(bench.robot, options, bench.driver.run)
    bench.station.start()
    async with driver:
        body = OscillatingBase(driver)
        task = asyncio.create_task(body.run())
        yield body
        task.cancel()
        await asyncio.wait((task,))
    await bench.station.close()


async def test_the_delay_of_a_base_without_a_clock_is_measured(tmp_path: Path) -> None:
    bench, port = EmulatedLine(tmp_path), tmp_path / "behind"
    async with (
        LineProxy(str(tmp_path / "base"), port) as proxy,
        oscillating_base(bench, port) as body,
    ):
        await until(body.is_late(0, 4))
        proxy.set(Chaos(delay_ms=50.0))
        await until(body.is_late(5, 10))
