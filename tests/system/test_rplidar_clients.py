"""The emulated RPLIDAR with third-party clients, over a real pty.

Known differences: both use the DTR line, which a pty lacks; rplidar-roboticia reads express samples
one too late; pyrplidar swaps the bytes of dense ones.
"""

import asyncio
import contextlib
import errno
import itertools
import math
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import Any

import pyrplidar
import pyrplidar_protocol
import pytest
import rplidar as roboticia
import serial

from gigabrain_drivers.lidars.rplidar.emulator import RplidarDevice
from gigabrain_drivers.lidars.rplidar.source import RplidarOptions
from tests.system.lidars import emulated, truth

Point = tuple[float, float]  # [deg] clockwise, [mm]


@pytest.fixture(autouse=True)
def no_modem_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    def set_dtr(self: serial.Serial, value: bool = True) -> None:
        try:
            serial.Serial.dtr.fset(self, value)
        except OSError as error:
            if error.errno != errno.ENOTTY:
                raise

    monkeypatch.setattr(serial.Serial, "setDTR", set_dtr)


def options(folder: Path, model: Any) -> RplidarOptions:
    return RplidarOptions(driver="rplidar", port=str(folder / "scan"), model=model)


@contextlib.asynccontextmanager
async def booted(its: RplidarOptions) -> AsyncIterator[None]:
    async with emulated(RplidarDevice, its):
        await asyncio.sleep(0.1)  # until its banner was sent
        yield


def count_wrong(points: Iterable[Point]) -> tuple[int, int]:
    """Return the number of points with a range, and of those that the simulation contradicts."""
    expected, seen, off = truth(), 0, 0
    for angle, distance in points:
        if not 0 < distance < 3450:
            continue
        seen += 1
        beam = round(-angle) % 360
        near = [expected[(beam + n) % 360] for n in (-1, 0, 1)]
        off += not min(near) * 1000 - 60 < distance < max(near) * 1000 + 60
    return seen, off


def with_pyrplidar(port: str, baud: int, mode: int | None) -> tuple[Any, list[Point]]:
    lidar = pyrplidar.PyRPlidar()
    lidar.connect(port=port, baudrate=baud, timeout=3)
    try:
        facts = lidar.get_info(), lidar.get_health(), lidar.get_samplerate(), lidar.get_scan_modes()
        typical = lidar.get_scan_mode_typical()
        scan = lidar.start_scan() if mode is None else lidar.start_scan_express(mode)
        points = [(m.angle, m.distance) for m in itertools.islice(scan(), 1000)]
        lidar.stop()
    finally:
        lidar.disconnect()
    return (*facts, typical), points


def with_roboticia(port: str, scan_type: str) -> tuple[Any, list[Point]]:
    lidar = roboticia.RPLidar(port, baudrate=115_200, timeout=3)
    try:
        facts = lidar.get_info(), lidar.get_health()
        measures = itertools.islice(lidar.iter_measures(scan_type, max_buf_meas=False), 1000)
        points = [(angle, distance) for _, _, angle, distance in measures]
        lidar.stop()
        lidar.stop_motor()
    finally:
        lidar.disconnect()
    return facts, points


@pytest.mark.parametrize("mode", [None, 1])  # standard and express mode
async def test_pyrplidar_identifies_an_a1_and_reads_its_scans(
    mode: int | None, tmp_path: Path
) -> None:
    its = options(tmp_path, "a1")
    async with booted(its):
        facts, points = await asyncio.to_thread(with_pyrplidar, its.port, 115_200, mode)

    info, health, rate, modes, typical = facts
    assert (info.model, info.firmware_major, info.firmware_minor, info.hardware) == (24, 1, 29, 7)
    assert info.serialnumber == "0123456789ABCDEF0123456789ABCDEF"
    assert (health.status, health.error_code) == (0, 0)
    assert (rate.t_standard, rate.t_express) == (500, 250)
    assert [(m.name, m.ans_type, m.us_per_sample >> 8, m.max_distance >> 8) for m in modes] == [
        ("Standard", 0x81, 500, 12),
        ("Express", 0x82, 250, 12),
    ]
    assert typical == 1
    seen, off = count_wrong(points)
    assert seen > 300
    assert off <= 0.01 * seen


async def test_pyrplidar_reads_dense_scans_of_a_c1_with_swapped_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cabin(self: Any, raw: bytes) -> None:
        self.distance = raw[0] | raw[1] << 8

    its = options(tmp_path, "c1")
    monkeypatch.setattr(pyrplidar_protocol.PyRPlidarDenseCabin, "__init__", cabin)
    async with booted(its):
        _, points = await asyncio.to_thread(with_pyrplidar, its.port, 460_800, 1)

    seen, off = count_wrong(points)
    assert seen > 300
    assert off <= 0.01 * seen


async def test_rplidar_roboticia_identifies_an_a1_and_reads_its_standard_scans(
    tmp_path: Path,
) -> None:
    its = options(tmp_path, "a1")
    async with booted(its):
        (info, health), points = await asyncio.to_thread(with_roboticia, its.port, "normal")

    assert info == {
        "model": 24,
        "firmware": (1, 29),
        "hardware": 7,
        "serialnumber": "0123456789ABCDEF0123456789ABCDEF",
    }
    assert health == ("Good", 0)
    seen, off = count_wrong(points)
    assert seen > 300
    assert off <= 0.01 * seen


async def test_rplidar_roboticia_reads_express_scans_shifted_by_one_sample(
    tmp_path: Path,
) -> None:
    its = options(tmp_path, "a1")
    async with booted(its):
        _, points = await asyncio.to_thread(with_roboticia, its.port, "express")

    step = 360 * 10 / 4000
    seen, off = count_wrong([(math.fmod(angle - step + 360, 360), d) for angle, d in points])
    assert seen > 300
    assert off <= 0.01 * seen
