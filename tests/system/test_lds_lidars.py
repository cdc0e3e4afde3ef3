"""LDS-01, LDS-02 and LDS-03: the vendors' corrections, emulated scans, ptys."""

import math
from pathlib import Path

import numpy as np
import pytest

from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.emulators.base import Device
from gigabrain_drivers.emulators.faults import NO_FAULTS, Faults
from gigabrain_drivers.lidars.ld import protocol as ld
from gigabrain_drivers.lidars.ld.emulator import Lds02Device, lens_distance
from gigabrain_drivers.lidars.ld.source import Lds02, seen_from_axis
from gigabrain_drivers.lidars.lds import lds01, lds03
from gigabrain_drivers.lidars.lds.emulator import Lds01Device, Lds03Device
from gigabrain_drivers.lidars.lds.lds01 import Lds01
from gigabrain_drivers.lidars.lds.lds03 import Lds03, trusted
from gigabrain_drivers.lidars.serial_source import SerialSource
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.clock import Clock, FakeClock
from gigabrain_zenoh.testing.waiting import until
from tests.system.lidars import LIDAR, Listener, Wire, agreement, emulated, run_for, truth, waffle

MS = 1_000_000
COARSE = Lidar(beams=180, rate_hz=10, range_min=0.16, range_max=3.5)
SLOW = Lidar(beams=360, rate_hz=5, range_min=0.12, range_max=3.5)
ALL: list[tuple[type[SerialSource], type[Device], Lidar]] = [
    (Lds01, Lds01Device, SLOW),
    (Lds02, Lds02Device, COARSE),
    (Lds03, Lds03Device, LIDAR),
]
each = pytest.mark.parametrize(("source", "device", "lidar"), ALL, ids=["lds01", "lds02", "lds03"])


def options(folder: Path = Path()) -> ScanOptions:
    return ScanOptions(driver="lds", port=str(folder / "scan"))


def scans_of(source: SerialSource, clock: FakeClock, pieces: list[bytes]) -> list[LaserScan]:
    """Feed pieces to a source, 10 ms apart, and return its scans."""
    found: list[LaserScan] = []
    source.emit = found.append
    for piece in pieces:
        clock._now += 10 * MS
        source.received(piece)
    return found


def test_the_last_lds01_sample_points_ahead_and_earlier_ones_to_the_right() -> None:
    def packet(number: int) -> lds01.Lds01Packet:
        first = 6 * number
        return lds01.Lds01Packet(number, 300.0, (9,) * 6, tuple(range(1000 + first, 1006 + first)))

    clock = FakeClock()
    pieces = [
        b"".join(lds01.encode(packet(n % 60)) for n in range(turn * 60 + at, turn * 60 + at + 3))
        for turn in range(3)
        for at in range(0, 60, 3)
    ]
    scan = scans_of(Lds01(options(), SLOW, clock), clock, pieces)[0].ranges_m
    assert scan[[0, 1, 90, 270, 359]] == pytest.approx([1.359, 1.358, 1.269, 1.089, 1.0])


@pytest.mark.parametrize(
    ("distance", "seen"),
    [(1000, (-5.6258, 1010.77)), (200, (-1.0300, 205.93)), (8000, (-6.6522, 8060.16))],
)
def test_lds02_distances_are_corrected_as_by_the_vendor(
    distance: int, seen: tuple[float, float]
) -> None:
    angles, distances = seen_from_axis(np.array([0.0, 90.0]), np.array([distance, distance]))
    assert angles == pytest.approx([seen[0], 90 + seen[0]], abs=0.01)
    assert distances == pytest.approx([seen[1]] * 2, abs=0.01)


def test_samples_without_return_are_not_corrected() -> None:
    angles, distances = seen_from_axis(np.array([12.0]), np.array([0.0]))
    assert (angles, distances) == ([12.0], [0.0])


@pytest.mark.parametrize("distance", [200.0, 1000.0, 8000.0])
def test_the_emulated_lens_is_the_inverse_of_the_correction(distance: float) -> None:
    _, distances = seen_from_axis(np.array([0.0]), np.array([lens_distance(distance)]))
    assert distances == pytest.approx([distance])


def test_lds02_frames_are_ld_frames_with_the_correction() -> None:
    frame = ld.LdFrame(3600, 0, 1100, (1000,) * 6 + (0,) * 6, (200,) * 12, 0)
    lidar = Lds02(options(), COARSE, FakeClock())
    angles, distances = lidar.to_axis(*ld.points(ld.encode(frame)))
    assert angles[:2] == pytest.approx([-5.626, -4.626], abs=1e-3)
    assert angles[6] == 6.0
    assert distances == pytest.approx([1010.77] * 6 + [0] * 6, abs=0.01)


@pytest.mark.parametrize(
    ("sample", "distance"),
    [
        (lds03.Lds03Sample(0.0, 1000, 10, False), 1000.0),
        (lds03.Lds03Sample(0.0, 0, 0, False), 0.0),
        (lds03.Lds03Sample(0.0, 150, 66, False), 150.0),
        (lds03.Lds03Sample(0.0, 150, 65, True), 150.0),
        (lds03.Lds03Sample(0.0, 150, 65, False), math.nan),
        (lds03.Lds03Sample(0.0, 151, 0, False), 151.0),
    ],
)
def test_near_and_weak_lds03_samples_are_ignored(
    sample: lds03.Lds03Sample, distance: float
) -> None:
    assert trusted(sample) == pytest.approx(distance, nan_ok=True)


@each
def test_an_emulated_scan_is_the_simulations(
    source: type[SerialSource], device: type[Device], lidar: Lidar
) -> None:
    body, wire, clock = waffle(), Wire(), FakeClock()
    emulator = device(body, options(), wire)
    emulator.reset()
    emulator.feed(lds01.START + lds03.START)
    pieces = []
    for _ in range(100):
        run_for(body, emulator, 0.01)
        pieces.append(b"".join(wire.sent))
        wire.sent.clear()
    scans = scans_of(source(options(), lidar, clock), clock, pieces)
    assert len(scans) >= 3
    expected = truth()[:: 360 // lidar.beams]
    assert agreement(scans[-1], expected, within=0.1) > 0.97
    assert np.isnan(scans[-1].ranges_m).mean() < 0.03


@each
async def test_scans_arrive_over_a_pty_and_again_after_it_was_unplugged(
    tmp_path: Path, source: type[SerialSource], device: type[Device], lidar: Lidar
) -> None:
    async with (
        emulated(device, options(tmp_path)) as station,
        Listener(source(options(tmp_path), lidar, Clock())) as listener,
    ):
        expected = truth()[:: 360 // lidar.beams]
        await listener.next_scan_like(expected, 0.95, within=0.1)
        await until(lambda: listener.source.health.connected)
        station.set(Faults(unplugged=True))
        await until(lambda: not listener.source.health.connected)
        station.set(NO_FAULTS)
        await listener.next_scan_like(expected, 0.95, within=0.1)
        assert listener.source.health.reconnects >= 1


@each
async def test_noise_only_loses_frames(
    tmp_path: Path, source: type[SerialSource], device: type[Device], lidar: Lidar
) -> None:
    async with (
        emulated(device, options(tmp_path)) as station,
        Listener(source(options(tmp_path), lidar, Clock())) as listener,
    ):
        await listener.next_scans(1)
        station.set(Faults(half_frames=0.02, garbage=0.02))
        await until(lambda: listener.source.health.errors > 3)
        station.set(NO_FAULTS)
        await listener.next_scans(2)


@pytest.mark.parametrize(
    ("source", "device"), [(Lds01, Lds01Device), (Lds03, Lds03Device)], ids=["lds01", "lds03"]
)
async def test_a_lidar_that_was_rebooted_is_started_again(
    tmp_path: Path, source: type[SerialSource], device: type[Device]
) -> None:
    async with (
        emulated(device, options(tmp_path)) as station,
        Listener(source(options(tmp_path), SLOW, Clock())) as listener,
    ):
        await listener.next_scans(1)
        station.device.reset()
        await listener.next_scans(2)


async def test_closing_the_port_stops_the_lidar_motor(tmp_path: Path) -> None:
    async with emulated(Lds01Device, options(tmp_path)) as station:
        async with Listener(Lds01(options(tmp_path), SLOW, Clock())) as listener:
            await listener.next_scans(1)
        sweep = station.device._sweep  # type: ignore[attr-defined]
        await until(lambda: not sweep._rate_hz)
