import asyncio
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.emulators.faults import NO_FAULTS, Faults
from gigabrain_drivers.lidars import serial_source
from gigabrain_drivers.lidars.ld.emulator import LdDevice
from gigabrain_drivers.lidars.ld.source import Ld19
from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.lidars.rplidar import source as rplidar_source
from gigabrain_drivers.lidars.rplidar.emulator import RplidarDevice
from gigabrain_drivers.lidars.rplidar.protocol import DENSE, EXPRESS, STANDARD, Health
from gigabrain_drivers.lidars.rplidar.source import Rplidar, RplidarOptions
from gigabrain_zenoh.clock import Clock, FakeClock
from gigabrain_zenoh.testing.waiting import until
from tests.system.lidars import LIDAR, Listener, agreement, emulated, truth


def options(folder: Path, **settings: Any) -> RplidarOptions:
    return RplidarOptions(driver="rplidar", port=str(folder / "scan"), **settings)


def listen(its: RplidarOptions) -> Listener:
    return Listener(Rplidar(its, LIDAR, Clock()))


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_source, "LOG_AFTER_NS", 600_000_000)
    monkeypatch.setattr(rplidar_source, "RESET_S", 0.2)


@pytest.mark.parametrize(
    ("model", "scan_mode", "kind"),
    [
        ("a1", "standard", STANDARD),
        ("a1", "auto", EXPRESS),
        ("a2m8", "auto", EXPRESS),  # an accessory board powers its motor
        ("c1", "auto", DENSE),
        ("s2", "auto", DENSE),  # its speed is commanded
        ("s2", "standard", STANDARD),
    ],
)
async def test_a_scan_of_each_model_is_the_scan_of_the_simulation(
    model: Any, scan_mode: Any, kind: int, tmp_path: Path
) -> None:
    its = options(tmp_path, model=model, scan_mode=scan_mode)
    async with emulated(RplidarDevice, its) as station, listen(its) as listener:
        scan = (await listener.next_scans(2))[-1]
        device = station.device

        assert isinstance(device, RplidarDevice)
        assert device._mode is not None
        assert device._mode.kind == kind
        missing = int(np.isnan(scan.ranges_m).sum())
        # standard scans of an A1 have 200 samples per turn
        assert missing <= (165 if kind == STANDARD and model == "a1" else 0)
        assert agreement(scan, truth()) > 0.97 - missing / 360
        await until(lambda: listener.source.health.connected)
        assert listener.source.health.errors == 0


async def test_a_lidar_that_was_rebooted_is_started_again(tmp_path: Path) -> None:
    its = options(tmp_path, model="c1")
    async with emulated(RplidarDevice, its) as station, listen(its) as listener:
        await listener.next_scans(1)
        station.set(Faults(reboot=True))
        await asyncio.sleep(0.1)
        station.set(NO_FAULTS)
        assert isinstance(station.device, RplidarDevice)
        assert station.device._mode is None

        await listener.next_scans(2)


async def test_a_lidar_that_was_unplugged_is_started_again(tmp_path: Path) -> None:
    its = options(tmp_path, model="c1")
    async with emulated(RplidarDevice, its) as station, listen(its) as listener:
        await listener.next_scans(1)
        station.set(Faults(unplugged=True))
        await until(lambda: not listener.source.link.connected)
        station.device.reset()  # it loses power with its cable
        station.set(NO_FAULTS)

        await listener.next_scans(2)
        assert listener.source.health.reconnects >= 1


async def test_without_a_model_the_baud_rates_are_tried_in_turn(
    tmp_path: Path,
) -> None:
    its = options(tmp_path)
    async with emulated(RplidarDevice, its) as station:
        station.set(Faults(silence=True))
        async with listen(its) as listener:
            source = listener.source
            await until(lambda: source.baud == 460_800)
            await until(lambda: source.baud == 1_000_000)
            station.set(NO_FAULTS)
            await listener.next_scans(1)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (
            {"model": "s2"},
            "{}/scan at 1000000 baud sends no RPLIDAR data: "
            "it looks like an LDROBOT lidar (ld06, ld19, lds02) (model: s2)",
        ),
        (
            {},
            "no RPLIDAR answers on {}/scan at any of 115200, 460800, 1000000, 256000 baud: "
            "it looks like an LDROBOT lidar (ld06, ld19, lds02)",
        ),
    ],
)
async def test_another_lidar_on_the_port_is_reported_once(
    settings: dict[str, Any], expected: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    its = options(tmp_path, **settings)
    async with emulated(LdDevice, its), listen(its) as listener:
        await until(lambda: listener.source.problem)
        await asyncio.sleep(1.0)
        assert listener.source.problem == expected.format(tmp_path)
        assert len(caplog.records) == 1


async def test_a_wrong_model_with_another_baud_rate_is_reported_as_silence(
    tmp_path: Path,
) -> None:
    its = options(tmp_path, model="a1")
    async with emulated(RplidarDevice, its) as station:
        await asyncio.sleep(0.1)  # until its banner was sent
        station.set(Faults(deaf=True))
        async with listen(its) as listener:
            await until(lambda: listener.source.problem)
            assert listener.source.problem == (
                f"no data comes from {tmp_path}/scan at 115200 baud: "
                "is the RPLIDAR powered, and wired both ways? (model: a1)"
            )


async def test_another_model_than_in_the_file_is_reported_in_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    async with (
        emulated(RplidarDevice, options(tmp_path, model="a2m8")),
        listen(options(tmp_path, model="a1")) as listener,
    ):
        await listener.next_scans(1)
        logged = [record.message for record in caplog.records]
        assert f"RPLIDAR A2 on {tmp_path}/scan, firmware 1.29" in logged
        assert f"the lidar on {tmp_path}/scan is an RPLIDAR A2, not model: a1" in logged


async def test_a_lidar_in_protection_stop_is_reset(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    its = options(tmp_path, model="c1")
    async with emulated(RplidarDevice, its) as station:
        assert isinstance(station.device, RplidarDevice)
        station.device.health = Health(2, 0x8001)
        async with listen(its) as listener:
            await listener.next_scans(1)
            assert station.device.health == Health(0, 0)


async def test_closing_stops_the_measurement_and_the_motor(tmp_path: Path) -> None:
    its = options(tmp_path, model="s2")
    async with emulated(RplidarDevice, its) as station:
        async with listen(its) as listener:
            await listener.next_scans(1)
        assert isinstance(station.device, RplidarDevice)
        await until(lambda: station.device._turn_hz == 0.0)
        assert station.device._mode is None


async def test_the_motor_of_an_a1_turns_while_dtr_is_cleared(
    tmp_path: Path,
) -> None:
    its, line = options(tmp_path, model="a1"), list[bool]()
    async with emulated(RplidarDevice, its), listen(its) as listener:
        listener.source.link.set_dtr = line.append
        await listener.next_scans(1)
        assert line == [False]
    assert line == [False, True]


@pytest.mark.parametrize(
    ("device", "expected"), [(RplidarDevice, (True, False)), (LdDevice, (False, True))]
)
async def test_each_lidar_is_recognised_by_its_reply(
    device: Any, expected: tuple[bool, bool], tmp_path: Path
) -> None:
    its = options(tmp_path)
    sources = Rplidar(its, LIDAR, Clock()), Ld19(its, LIDAR, Clock())

    def probe() -> tuple[bool, ...]:
        with serial.Serial(its.port, 115_200, timeout=0.2) as port:
            return tuple(source.probe(port) for source in sources)

    async with emulated(device, its):
        await asyncio.sleep(0.1)
        assert await asyncio.to_thread(probe) == expected


@given(st.lists(st.binary(max_size=200), max_size=20), st.sampled_from([0x81, 0x82, 0x85]))
async def test_no_bytes_make_a_source_raise(pieces: list[bytes], kind: int) -> None:
    size = 5 if kind == 0x81 else 84
    source = Rplidar(options(Path()), LIDAR, FakeClock())
    source.received(rplidar.descriptor(kind, size, endless=True))
    for piece in pieces:
        source.received(piece)
