"""Tilt, knocks, slow commands and the computer's resources."""

import itertools
import math
import threading
from collections import namedtuple
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import GateStatus, Thresholds
from gigabrain_zenoh.safety.health import Host, RoundTrip, tilt_deg
from gigabrain_zenoh.safety.node import HostMonitor
from gigabrain_zenoh.safety.step import LATCHING_TICKS
from gigabrain_zenoh.testing.waiting import until
from tests.unit.safety.patrol import BODY, Patrol, imu

Usage = namedtuple("Usage", "free")


def rolled(degrees: float, axis: int = 0) -> tuple[float, float, float, float]:
    half = math.radians(degrees) / 2
    parts = [0.0, 0.0, 0.0, math.cos(half)]
    parts[axis] = math.sin(half)
    return parts[0], parts[1], parts[2], parts[3]


@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilted_body_latches_after_200_ms(axis: int) -> None:
    patrol = Patrol()
    assert patrol.go(50, imu=imu(rolled(29.0, axis))) == []
    assert patrol.go(9, imu=imu(rolled(31.0, axis))) == []
    assert patrol.go(imu=imu(rolled(31.0, axis))) == ["tilted"]
    assert patrol.verdict.causes[0].latching


def test_turning_is_no_tilt() -> None:
    assert tilt_deg(rolled(90.0, 2)) == pytest.approx(0.0)
    assert tilt_deg(rolled(180.0, 0)) == pytest.approx(180.0)


def test_an_invalid_orientation_has_no_tilt() -> None:
    assert tilt_deg((0.0, 0.0, 0.0, 0.0)) is None
    assert Patrol().go(50, imu=imu((0.0, 0.0, 0.0, 0.0))) == []


def test_the_limit_of_tilt_can_be_changed() -> None:
    legs = Patrol(replace(BODY, thresholds=Thresholds(tilt_stop=45.0)))
    assert legs.go(50, imu=imu(rolled(44.0))) == []


def test_a_bumper_latches_at_once() -> None:
    patrol = Patrol()
    assert patrol.go(bumpers=(False, True)) == ["collision"]
    assert patrol.verdict.causes[0].latching
    assert patrol.go(LATCHING_TICKS - 1, bumpers=(False, False)) == ["collision"]
    assert patrol.go(bumpers=(False, False)) == []  # the gate stays latched


@pytest.mark.parametrize(("push", "stopped"), [(39.0, []), (-41.0, ["collision"])])
def test_a_hard_knock_is_a_collision(push: float, stopped: list[str]) -> None:
    assert Patrol().go(imu=imu(push=push)) == stopped
    assert Patrol().go(imu=imu(), shock=abs(push)) == stopped


def test_slow_commands_halve_the_speed_after_a_second() -> None:
    patrol = Patrol()
    assert patrol.go(200, echo_ages=(5,)) == []  # 100 ms
    ticks = patrol.ticks_until("round_trip", 60, echo_ages=(6,))
    assert ticks == 51  # 1 tick until two of a hundred commands are slow, then a second
    assert patrol.verdict.verdict == "slow"
    caps = patrol.verdict.caps
    assert (caps.forward, caps.backward, caps.rotation) == (0.13, 0.13, 0.91)
    patrol.go(100, echo_ages=(1,))
    assert patrol.verdict.verdict == "ok"


def test_slow_commands_at_ten_hertz_halve_the_speed_after_a_second_too() -> None:
    patrol = Patrol()
    for _ in range(10):
        assert patrol.go(echo_ages=(6,)) == []
        assert patrol.go(4) == []
    assert patrol.go(echo_ages=(6,)) == ["round_trip"]


def test_slow_commands_count_also_at_a_second_verdict_of_a_tick() -> None:
    limits, monitor = Thresholds(), RoundTrip()
    for _ in range(50):
        assert monitor.causes(limits) == ()
        monitor = monitor.then(limits, "page", (), 1).then(limits, "page", (6,), 0)
    assert [cause.code for cause in monitor.causes(limits)] == ["round_trip"]


def test_a_last_late_command_is_ignored() -> None:
    patrol = Patrol()
    patrol.go(echo_ages=(7,))
    for _ in range(200):
        assert patrol.go() == []
    for _ in range(100):
        assert patrol.go(echo_ages=(1,)) == []


def test_slow_commands_do_not_count_for_the_next_commander() -> None:
    patrol, nobody = Patrol(), GateStatus(mode="idle")
    assert patrol.go(60, echo_ages=(6,)) == ["round_trip"]
    assert patrol.go(gate=nobody) == []
    assert patrol.go(60, echo_ages=(6,)) == ["round_trip"]
    other = GateStatus(mode="enabled", commander="page", enables=2)
    for _ in range(60):
        assert patrol.go(gate=other, echo_ages=(1,)) == []


def test_single_slow_commands_are_ignored() -> None:
    patrol = Patrol()
    patrol.go(100, echo_ages=(1,))
    for _ in range(5):
        patrol.go(echo_ages=(20,))
        assert patrol.go(120, echo_ages=(1,)) == []


def test_scarce_resources_of_the_computer_are_warnings_only() -> None:
    patrol = Patrol()
    patrol.go(host=Host(disk_mb=499.0, cpu=95.1, memory=95.1))
    assert patrol.warnings == ["disk_low", "cpu_busy", "memory_low"]
    assert patrol.verdict.verdict == "ok"
    assert Host(disk_mb=500.0, cpu=95.0, memory=95.0).warnings(Thresholds()) == ()
    assert Host().warnings(Thresholds()) == ()


SECONDS = itertools.count(1000)


def disk_mb(watch: HostMonitor) -> float:
    """Return the free disk space at the next reading [MB]; 0 before the disk answers."""
    return watch.read(next(SECONDS) * 1_100_000_000).disk_mb or 0.0


async def test_a_disk_that_hangs_does_not_block_safety(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    hangs, answers = threading.Event(), threading.Event()

    def disk_usage(path: object) -> Usage:
        asked.append(path)
        hangs.wait(60)
        answers.set()
        return Usage(free=5_000_000)

    monkeypatch.setattr("shutil.disk_usage", disk_usage)
    watch = HostMonitor(tmp_path)
    for second in range(5):
        assert watch.read(second * 1_100_000_000).disk_mb is None
    assert asked == [tmp_path]
    hangs.set()
    assert answers.wait(60)
    await until(lambda: disk_mb(watch) == 5.0, "the disk's answer")


async def test_a_missing_folder_is_on_the_disk_of_its_parent(
    tmp_path: Path,
) -> None:
    watch = HostMonitor(tmp_path / "gigabrain" / "runs")
    await until(lambda: disk_mb(watch) > 0, "the disk's answer")


def test_the_resources_are_read_once_a_second(tmp_path: Path) -> None:
    watch = HostMonitor(tmp_path)
    first = watch.read(1)
    assert watch.read(900_000_000) is first
    assert first.disk_mb is None or first.disk_mb > 0
    assert first.memory is None or 0 < first.memory <= 100
    for second in range(1, 12):
        last = watch.read(second * 1_100_000_000)
    assert last.cpu is None or 0 <= last.cpu <= 100
