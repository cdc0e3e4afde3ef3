"""Delays that drivers report for devices with their own clock, on delayed lines."""

from pathlib import Path

import pytest

from gigabrain_drivers.bodies.alpha import driver as alpha_driver
from gigabrain_drivers.bodies.alpha import protocol as alpha
from gigabrain_drivers.bodies.alpha.driver import AlphaDriver, AlphaOptions
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run, ScanOptions
from gigabrain_drivers.lidars.ld import protocol as ld
from gigabrain_drivers.lidars.ld.source import Ld19
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.clock import FakeClock
from tests.unit.drivers.test_alpha_protocol import a_state

MS = 1_000_000
LIDAR = Lidar(beams=360, rate_hz=10, range_min=0.12, range_max=3.5)
FRAMES = 40  # per turn


def frame(number: int, time_ms: int) -> bytes:
    """Return a frame of 9 degrees."""
    start = number % FRAMES * 900
    return ld.encode(
        ld.LdFrame(3600, start, (start + 825) % ld.TURN, (1000,) * 12, (200,) * 12, time_ms)
    )


@pytest.mark.long
async def test_scans_of_an_ld19_have_their_delay() -> None:
    clock, scans = FakeClock(), list[LaserScan]()
    source = Ld19(ScanOptions(driver="ld19", port="/dev/null"), LIDAR, clock)
    source.emit = scans.append

    async def turn(turns: int, late_ms: int) -> list[float]:
        scans.clear()
        await clock.advance(late_ms * MS)  # the delay begins with silence
        for _ in range(turns * 10):  # every 10 ms
            await clock.advance(10 * MS)
            now_ms = clock.now_ns() // MS - late_ms
            first = now_ms * FRAMES // 100
            source.received(b"".join(frame(first + n, now_ms % 30_000) for n in range(4)))
        return [scan.late_ms for scan in scans]

    assert max(await turn(350, 0)) <= 1.0  # 35 s: the stamp wraps
    assert (await turn(10, 100))[-1] == pytest.approx(100.0, abs=5.0)
    assert (await turn(10, 0))[-1] <= 5.0


@pytest.mark.long
@pytest.mark.parametrize("from_the_start", [False, True])
async def test_states_of_alpha_have_their_delay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, from_the_start: bool
) -> None:
    clock = FakeClock()
    monkeypatch.setattr(alpha_driver, "Clock", lambda: clock)
    options = AlphaOptions(driver="alpha", port="127.0.0.1:1")
    driver = AlphaDriver(catalog.load_robot("alpha"), options, Run(folder=tmp_path))
    sent_ms: list[int] = []  # time of each command

    async def walk(ticks: int, late_ms: int) -> float | None:
        await clock.advance(late_ms * MS)
        for _ in range(ticks):
            await driver.stop()
            sent_ms.append(clock.now_ns() // MS)
            for _ in range(2):  # states between two commands
                await clock.advance(10 * MS)
                then_ms = clock.now_ns() // MS - late_ms
                echo = sum(ms <= then_ms for ms in sent_ms)
                state = a_state(milliseconds=then_ms + 1000, echo=echo)
                driver.link.on_bytes(alpha.encode_state(state, clock.now_ns() // (10 * MS)))
        return (await driver.read_state()).link.late_ms

    if not from_the_start:
        assert await walk(100, 0) == pytest.approx(0.0, abs=1.0)
    assert await walk(100, 100) == pytest.approx(85.0, abs=16.0)
    assert await walk(100, 0) == pytest.approx(0.0, abs=5.0)
