"""The verdict of `gigabrain bench robots`, and the share of time with a shut gate."""

import asyncio

import pytest
from msgspec.structs import replace

from gigabrain_zenoh.errors import BusError
from gigabrain_zenoh.qa.bench import robots
from gigabrain_zenoh.qa.bench.robots import (
    FleetRobot,
    RobotsResult,
    measure_robots,
    shut_share,
)

FAST = FleetRobot(
    number=1, distance_m=9.0, real_time=1.0, stood=0.0, p50_ms=8.0, p99_ms=30.0, cpu=0.3,
    physics_cpu=0.05, pss_bytes=400_000_000,
)  # fmt: skip


def gate(tick: int, mode: str) -> dict[str, object]:
    return {"event": "gate", "tick": tick, "mode": mode}


def result(*robots: FleetRobot) -> RobotsResult:
    return RobotsResult(body="b", world="w", seconds=60.0, cores=2, busy=0.8, robots=robots)


@pytest.mark.parametrize(
    ("records", "share"),
    [
        ([gate(10, "enabled")], 0.0),
        ([], 1.0),
        ([gate(10, "enabled"), gate(600, "stopping"), gate(650, "enabled")], 0.1),
        ([gate(10, "enabled"), gate(950, "latched"), {"event": "ready"}], 0.1),
        ([gate(10, "enabled"), gate(400, "idle"), gate(550, "enabled")], 0.1),
        ([gate(10, "enabled"), gate(1200, "idle")], 0.0),
    ],
)
def test_the_shut_share_covers_only_the_measured_time(
    records: list[dict[str, object]], share: float
) -> None:
    assert shut_share(records, 10.0, 20.0) == pytest.approx(share)  # ticks 500 to 1000


@pytest.mark.parametrize(
    ("slow", "reason"),
    [
        (replace(FAST, number=2, p99_ms=83.0), "scan to command took 83 ms (p99)"),
        (replace(FAST, number=2, p99_ms=None), "no scan was answered"),
        (replace(FAST, number=2, real_time=0.8), "its time ran at 80% of real time"),
        (replace(FAST, number=2, stood=0.2), "it stood for 20% of the time"),
    ],
)
def test_the_verdict_names_the_robot_that_is_too_slow(slow: FleetRobot, reason: str) -> None:
    found = result(FAST, slow)
    assert found.verdict.startswith("this machine is too small for 2 of these robots: robot 2: ")
    assert reason in found.verdict
    assert not found.ok


def test_a_failed_robot_is_reported_but_is_no_sign_of_a_small_machine() -> None:
    failed = FleetRobot(number=2, problem="a process died")
    found = result(FAST, failed)
    assert found.verdict == "1 of these 2 robots failed: robot 2: a process died"
    assert not found.ok
    slow = result(replace(FAST, p99_ms=83.0), failed)
    assert slow.verdict.endswith("(p99); robot 2: a process died")
    assert slow.verdict.startswith("this machine is too small")


def test_a_contact_is_not_a_sign_of_a_small_machine() -> None:
    found = result(FAST, replace(FAST, number=2, contacts=3))
    assert found.verdict == "this machine carries 2 of these robots, but they had 3 contacts"
    assert not found.ok


def test_the_verdict_for_a_large_machine() -> None:
    assert result(FAST).verdict == "this machine carries 1 of these robots"
    assert result(FAST).ok


async def test_an_error_of_one_robot_ends_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []

    async def compiled(_: object) -> None: ...

    async def run_robot(number: int, *_: object) -> FleetRobot:
        if number == 2:
            raise BusError("no router")
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(number)
        raise AssertionError

    monkeypatch.setattr(robots, "ensure_compiled", compiled)
    monkeypatch.setattr(robots, "_run_robot", run_robot)
    with pytest.raises(BusError, match="no router"):
        await measure_robots("turtlebot3_waffle", "house", 3, 1.0, lambda _: None)
    assert ended == [1, 3]
    assert asyncio.all_tasks() == {asyncio.current_task()}
