"""A line is closed only after all written bytes are sent."""

import asyncio
from pathlib import Path

import pytest

from gigabrain_drivers.bodies.line.driver import LineDriver
from gigabrain_drivers.bodies.line.options import LineOptions
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.robot import Run
from gigabrain_zenoh.clock import FakeClock

MS = 1_000_000
OPTIONS = LineOptions(
    driver="line",
    port="/dev/null",
    baud=9600,
    command="V,{linear_x:.3f},{angular_z:.3f}\n",
    state=("S,{linear_x},{angular_z}\n",),
    start="$MOTORS,ALL,ENABLE*5C\n",
    stop="$MOTORS,LEFT,DISABLE*5C\n$MOTORS,RIGHT,DISABLE*5C\n",
    command_hz=10.0,
    state_hz=10.0,
)


async def test_a_stop_string_is_sent_before_the_port_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, written, closed_ns = FakeClock(), bytearray(), list[int]()
    driver = LineDriver(load_robot("mycustombot"), OPTIONS, Run(folder=Path()), clock=clock)

    async def close() -> None:
        closed_ns.append(clock.now_ns())

    def write(data: bytes) -> bool:
        written.extend(data)
        return True

    monkeypatch.setattr(driver.link, "open", lambda: None)
    monkeypatch.setattr(driver.link, "_fd", 0)
    monkeypatch.setattr(driver.link, "write", write)
    monkeypatch.setattr(driver.link, "close", close)
    await driver.open()
    driver.link.on_bytes(b"S,0,0\n")
    await clock.advance(200 * MS)
    written.clear()
    began_ns = clock.now_ns()
    await driver.set_base_velocity(0.1, 0.0, 0.0)
    closing = asyncio.create_task(driver.close())
    await clock.advance(1000 * MS)
    await closing
    assert written.endswith(OPTIONS.stop.encode())
    assert closed_ns[0] - began_ns >= len(written) * 10 / 9600 * 1e9
