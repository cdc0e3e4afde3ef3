"""What a service manager hears of `gigabrain up`, on a real datagram socket."""

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import Home, endpoint_of
from gigabrain_zenoh.testing.waiting import until


class Manager:
    """The other end of $NOTIFY_SOCKET."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.setblocking(False)
        self._heard: list[str] = []

    @property
    def heard(self) -> list[str]:
        """All that it was told so far."""
        while True:
            try:
                self._heard.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return list(self._heard)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    made = Manager(f"{tmp_path}/notify")
    yield made
    made.close()


ALL_READY = "STATUS=all ready: router, driver, perception, decision, control, safety"


def knows_of_the_manager(pid: int) -> bool:
    """Whether a process could speak in the service's name."""
    return b"NOTIFY_SOCKET" in Path(f"/proc/{pid}/environ").read_bytes()


async def test_up_tells_its_service_manager_how_all_are_doing(
    home: Home, manager: Manager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", f"{tmp_path}/notify")
    monkeypatch.setenv("WATCHDOG_USEC", "1000000")
    file = home.deployment()
    up = home.start("up", str(file), "--keep-stuck")
    await until(lambda: "READY=1" in manager.heard, "all are ready")
    assert [word for word in manager.heard if word.startswith("STATUS")][-1] == ALL_READY
    assert manager.heard[0].startswith("STATUS=not ready: router, driver")
    await until(lambda: manager.heard[-1] == "WATCHDOG=1", "the watchdog is fed")
    async with probing(endpoint_of(file)) as robot:
        pid = await robot.pid("decision")
        assert not knows_of_the_manager(pid)
        os.kill(pid, signal.SIGSTOP)
        await until(lambda: "STATUS=stuck: decision" in manager.heard, "it is seen to be stuck")
        await robot.ticks(100)  # twice the watchdog's time
        assert manager.heard[-1] == "STATUS=stuck: decision"
        os.kill(pid, signal.SIGCONT)
        await until(lambda: manager.heard[-1] == "WATCHDOG=1", "it gets on again")
        since = manager.heard.index("STATUS=stuck: decision")
        assert manager.heard[since + 1 : since + 3] == [ALL_READY, "WATCHDOG=1"]
    assert manager.heard.count("READY=1") == 1
    up.send(signal.SIGTERM)
    assert await up.ended() == 0
    assert manager.heard[-1] == "STOPPING=1"
    assert up.out.count("progress") == 1  # that there was none; beats are not shown
