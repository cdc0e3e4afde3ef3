"""Notifications of `gigabrain up` to a service manager, on a real datagram socket."""

import os
import signal
from pathlib import Path

import pytest

from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import Home, ServiceManager, endpoint_of
from gigabrain_zenoh.testing.waiting import until

ALL_READY = "STATUS=all ready: router, driver, perception, decision, control, safety"


def has_manager_socket(pid: int) -> bool:
    """Return whether a process could notify the service manager."""
    return b"NOTIFY_SOCKET" in Path(f"/proc/{pid}/environ").read_bytes()


@pytest.mark.slow
async def test_up_notifies_its_service_manager_of_the_state_of_all_processes(
    home: Home, service_manager: ServiceManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", f"{tmp_path}/notify")
    monkeypatch.setenv("WATCHDOG_USEC", "1000000")
    file = home.deployment()
    up = home.start("up", str(file), "--keep-stuck")
    await until(lambda: "READY=1" in service_manager.received, "all are ready")
    assert [word for word in service_manager.received if word.startswith("STATUS")][-1] == ALL_READY
    assert service_manager.received[0].startswith("STATUS=not ready: router, driver")
    await until(lambda: service_manager.received[-1] == "WATCHDOG=1", "the watchdog is fed")
    async with probing(endpoint_of(file)) as robot:
        pid = await robot.pid("decision")
        assert not has_manager_socket(pid)
        os.kill(pid, signal.SIGSTOP)
        await until(
            lambda: "STATUS=stuck: decision" in service_manager.received, "it is seen to be stuck"
        )
        await robot.ticks(100)  # twice the watchdog's timeout
        assert service_manager.received[-1] == "STATUS=stuck: decision"
        os.kill(pid, signal.SIGCONT)
        await until(lambda: service_manager.received[-1] == "WATCHDOG=1", "it gets on again")
        since = service_manager.received.index("STATUS=stuck: decision")
        assert service_manager.received[since + 1 : since + 3] == [ALL_READY, "WATCHDOG=1"]
    assert service_manager.received.count("READY=1") == 1
    up.send(signal.SIGTERM)
    assert await up.ended() == 0
    assert service_manager.received[-1] == "STOPPING=1"
    assert up.out.count("progress") == 1  # "no progress" once; heartbeats are not shown
