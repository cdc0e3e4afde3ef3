import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.emulators.faults import NO_FAULTS, Faults
from gigabrain_drivers.lidars.base import SampleBuffer, bin_scan
from gigabrain_drivers.lidars.ld import protocol as ld
from gigabrain_drivers.lidars.ld.emulator import LdDevice
from gigabrain_drivers.lidars.ld.source import Ld19
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.clock import Clock, FakeClock
from gigabrain_zenoh.testing.waiting import until
from tests.system.lidars import (
    LIDAR,
    Listener,
    Wire,
    agreement,
    emulated,
    lost_bytes,
    run_for,
    truth,
    waffle,
)

SMALL = Lidar(beams=8, rate_hz=10, range_min=0.1, range_max=3.0)
MS = 1_000_000


def options(folder: Path) -> ScanOptions:
    return ScanOptions(driver="ld19", port=str(folder / "scan"))


def test_a_bin_has_its_nearest_sample_inf_without_return_or_nan_without_sample() -> None:
    eighth = math.tau / 8
    angles = [0.1, -0.1, eighth, 2 * eighth, 3 * eighth, 4 * eighth, 5 * eighth]
    scan = bin_scan(SMALL, angles, [1.0, 0.9, math.inf, 9.0, 0.02, math.nan, -0.0])

    np.testing.assert_allclose(
        scan.ranges_m, [0.9, math.inf, math.inf, 0.1, math.nan, 0.1, math.nan, math.nan], rtol=1e-6
    )
    assert (scan.angle_min, scan.angle_increment) == (0.0, math.tau / 8)


def test_clockwise_degrees_become_counter_clockwise_bins() -> None:
    turn = SampleBuffer(SMALL)
    turn.add_samples([0.0], [1000], 0, 0)
    turn.add_samples([90.0], [2000], None, 40 * MS)
    turn.add_samples([270.0], [2500], None, 80 * MS)
    scan = turn.add_samples([0.0], [1000], 0, 100 * MS)

    assert scan is not None
    got = scan.ranges_m
    assert (got[0], got[6], got[2]) == (1.0, 2.0, 2.5)


def test_an_incomplete_turn_is_no_scan() -> None:
    turn = SampleBuffer(SMALL)
    turn.add_samples([90.0], [2000], None, 0)

    assert turn.add_samples([0.0], [1000], 0, 50 * MS) is None


@pytest.mark.parametrize("took_ms", [20, 301])
def test_a_turn_of_implausible_duration_is_no_scan(took_ms: int) -> None:
    turn = SampleBuffer(SMALL)
    for n in range(5):
        turn.add_samples([30.0 * n], [1000], None if n else 0, n * took_ms * MS // 5)

    assert turn.add_samples([0.0], [1000], 0, took_ms * MS) is None


def test_samples_before_a_long_silence_are_dropped() -> None:
    turn = SampleBuffer(SMALL)
    turn.add_samples([0.0], [1000], 0, 0)
    turn.add_samples([200.0], [1000], None, 101 * MS)

    assert turn.add_samples([0.0], [1000], 0, 150 * MS) is None


def test_a_lidar_that_never_ends_a_turn_does_not_fill_the_memory() -> None:
    turn, most = SampleBuffer(SMALL), 0
    for n in range(3000):
        turn.add_samples([1.0] * 12, [1000] * 12, None, n * MS)
        most = max(most, sum(len(angles) for angles, _ in turn._pieces))

    assert most <= 20_000


def test_the_emulator_sends_4500_samples_a_second_in_frames_of_twelve(tmp_path: Path) -> None:
    body, wire = waffle(), Wire()
    device = LdDevice(body, options(tmp_path), wire)
    device.reset()
    run_for(body, device, 1.0)
    frames = [ld.decode(sent) for sent in wire.sent]

    assert len(frames) == 375
    assert all(frame is not None for frame in frames)
    first, last = frames[0], frames[-1]
    assert first is not None
    assert last is not None
    assert (first.speed, first.start, first.end) == (3600, 0, 880)
    assert last.time_ms == 1000


def test_a_scan_of_the_emulated_lidar_is_the_scan_of_the_simulation() -> None:
    body, wire, clock = waffle(), Wire(), FakeClock()
    device = LdDevice(body, options(Path()), wire)
    device.reset()
    source = Ld19(options(Path()), LIDAR, clock)
    scans = []
    source.emit = scans.append
    for _ in range(50):
        run_for(body, device, 0.01)
        clock._now += 10 * MS
        source.received(b"".join(wire.sent))
        wire.sent.clear()

    assert len(scans) == 3  # the first and the last turn are incomplete
    assert agreement(scans[-1], truth()) > 0.97
    assert not np.isnan(scans[-1].ranges_m).any()


async def test_scans_arrive_over_a_pty_and_again_after_it_was_unplugged(tmp_path: Path) -> None:
    async with (
        emulated(LdDevice, options(tmp_path)) as station,
        Listener(Ld19(options(tmp_path), LIDAR, Clock())) as listener,
    ):
        await listener.next_scan_like(truth(), 0.97)
        await until(lambda: listener.source.health.connected)
        if not lost_bytes(station):  # a host that stalls loses bytes of a UART
            assert listener.source.health.errors == 0

        station.set(Faults(unplugged=True))
        missing = f"no {tmp_path}/scan: is it plugged in?"
        await until(lambda: listener.source.problem == missing)
        assert not listener.source.health.connected

        station.set(NO_FAULTS)
        await listener.next_scan_like(truth(), 0.97)
        assert listener.source.health.reconnects >= 1
        await until(lambda: not listener.source.problem)


async def test_silence_is_reported_in_one_line_until_data_returns(tmp_path: Path) -> None:
    async with (
        emulated(LdDevice, options(tmp_path)) as station,
        Listener(Ld19(options(tmp_path), LIDAR, Clock())) as listener,
    ):
        await listener.next_scans(1)
        station.set(Faults(silence=True))
        await until(lambda: listener.source.problem)
        station.set(NO_FAULTS)
        await listener.next_scans(1)


async def test_bit_errors_and_half_frames_only_lose_frames(tmp_path: Path) -> None:
    async with (
        emulated(LdDevice, options(tmp_path)) as station,
        Listener(Ld19(options(tmp_path), LIDAR, Clock())) as listener,
    ):
        await listener.next_scans(1)
        station.set(Faults(bit_errors=0.001, half_frames=0.01, garbage=0.01))
        scans = await listener.next_scans(10)
        real = truth()

        assert listener.source.health.errors > 5
        for scan in scans:
            missing = np.isnan(scan.ranges_m).sum()
            assert agreement(scan, real) > 0.97 - missing / 360


async def test_a_missing_ld19_is_reported_as_silent(tmp_path: Path) -> None:
    async with emulated(LdDevice, options(tmp_path)) as station:
        station.set(Faults(silence=True))
        async with Listener(Ld19(options(tmp_path), LIDAR, Clock())) as listener:
            await until(lambda: listener.source.problem)
            assert listener.source.problem == (
                f"no data comes from {tmp_path}/scan at 230400 baud: "
                "is the LD19 powered, and wired both ways?"
            )


@given(st.lists(st.binary(max_size=200), max_size=20))
async def test_no_bytes_make_a_source_raise(pieces: list[bytes]) -> None:
    source = Ld19(options(Path()), LIDAR, FakeClock())
    for piece in pieces:
        source.received(piece)
