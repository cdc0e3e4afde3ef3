"""Notifications of `gigabrain up` to a service manager, on a real datagram socket."""

import asyncio
import datetime
import os
import shutil
from pathlib import Path

import pytest

from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.launch import up as up_module
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.up import Notifier
from gigabrain_zenoh.runtime import heartbeat
from gigabrain_zenoh.security import authority
from gigabrain_zenoh.testing.processes import ServiceManager


def test_the_watchdog_is_fed_in_good_time_and_not_at_every_turn(
    service_manager: ServiceManager,
) -> None:
    now = [100.0]
    notifier = Notifier(service_manager.address, 10.0, lambda: now[0])
    for _ in range(100):
        notifier.alive()
        now[0] += 0.1
    assert service_manager.received == ["WATCHDOG=1"] * 3  # at 0, 4 and 8 s


def test_ready_is_said_once_and_a_status_when_it_changes(service_manager: ServiceManager) -> None:
    notifier = Notifier(service_manager.address)
    for text in ("a", "a", "b"):
        notifier.status(text)
        notifier.ready()
        notifier.alive()
    assert service_manager.received == ["STATUS=a", "READY=1", "STATUS=b"]


def test_an_abstract_address_and_a_missing_manager_are_fine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = f"gigabrain-{os.getpid()}"
    service_manager = ServiceManager(f"\0{name}")
    monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}")
    notifier = Notifier.from_environment()
    assert "NOTIFY_SOCKET" not in os.environ
    notifier.stopping()
    assert service_manager.received == ["STOPPING=1"]
    service_manager.close()
    notifier.stopping()
    Notifier.from_environment().stopping()


def test_a_watchdog_that_is_meant_for_another_process_is_not_fed(
    service_manager: ServiceManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    for pid, received in (("1", []), (str(os.getpid()), ["WATCHDOG=1"])):
        monkeypatch.setenv("NOTIFY_SOCKET", service_manager.address)
        monkeypatch.setenv("WATCHDOG_USEC", "5000000")
        monkeypatch.setenv("WATCHDOG_PID", pid)
        Notifier.from_environment().alive()
        assert service_manager.received == received


async def test_keys_that_are_valid_later_are_waited_for_until_the_clock_is_set(
    service_manager: ServiceManager,
    fleet: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own = Path(shutil.copytree(fleet, tmp_path / "fleet"))
    with monkeypatch.context() as set_back:  # of this host's clock, by a year
        set_back.setattr(authority, "BACKDATED", -datetime.timedelta(days=365))
        early = authority.issue(own, "robot", name="early", days=700)
    deployment, printed = Deployment(keys=str(early)), list[str]()

    async def pause(_: float) -> None:
        if len(pauses) == 2:  # now it is set
            shutil.rmtree(early)
            authority.issue(own, "robot", name="early")
        pauses.append(None)

    pauses: list[None] = []
    monkeypatch.setattr(asyncio, "sleep", pause)
    notifier = Notifier(service_manager.address)
    await up_module._check_keys(deployment, "robot", printed.append, notifier)
    assert len(pauses) == 3
    (line,) = printed
    assert line.startswith(f"waiting for the clock to be set: {early / 'identity.crt'} is valid fr")
    assert service_manager.received == [f"STATUS={line}"]


class TurningClock(Clock):
    """Every period is over at once, for as many times as it is told."""

    def __init__(self, turns: int) -> None:
        self._turns = turns

    async def every(self, period_ns: int):  # type: ignore[no-untyped-def]
        for turn in range(self._turns):
            yield turn * period_ns


@pytest.mark.parametrize(("made", "beats"), [("1111", 3), ("1001", 1), ("1000", 0)])
async def test_a_heartbeat_is_progress_and_not_existence(made: str, beats: int) -> None:
    reader, writer = os.pipe()
    seconds = iter(made)  # the first look only begins to count
    await heartbeat.beat(TurningClock(3), lambda: next(seconds) == "1", writer)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        assert pipe.read().splitlines() == [b'{"event":"progress","level":"debug"}'] * beats


async def test_a_supervisor_that_reads_nothing_holds_nobody_up() -> None:
    reader, writer = os.pipe()
    await heartbeat.beat(TurningClock(5000), lambda: True, writer)
    os.close(reader)
    os.close(writer)
