"""A link never stops reconnecting, whatever exception its port or its owner raises."""

import asyncio
import os
import termios
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import serial

from gigabrain_drivers.emulators.ports import Pty
from gigabrain_drivers.links import serial_link
from gigabrain_drivers.links.link import Link, LinkProblem
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_drivers.links.tcp_link import TcpLink
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.testing.waiting import until
from tests.system.links import LinkRecorder


class FlakyLink(Link):
    """A link whose port raises the given faults, one per try, and then is a pipe."""

    def __init__(self, *faults: Exception) -> None:
        super().__init__(Clock())
        self._faults, self._ends = list(faults), tuple[int, int] | None
        self.far: int | None = None
        self._near: int | None = None

    def __str__(self) -> str:
        return "flaky"

    async def _connect(self) -> int:
        if self._faults:
            raise self._faults.pop(0)
        self._near, self.far = os.pipe()
        os.set_blocking(self._near, False)
        return self._near

    def _shut(self) -> None:
        near, far, self._near, self.far = self._near, self.far, None, None
        for end in (near, far):
            if end is not None:
                os.close(end)

    def _cut_short(self) -> None:
        pass


@pytest.mark.parametrize(
    "fault",
    [
        LinkProblem("no port"),
        OSError(5, "Input/output error"),
        termios.error(5, "Input/output error"),
        UnicodeError("label empty or too long"),
        RuntimeError("anything else"),
    ],
    ids=lambda fault: type(fault).__name__,
)
async def test_a_port_that_raises_anything_is_tried_again(
    fault: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    link = FlakyLink(fault, fault)
    link.open()
    await until(lambda: link.connected)
    await link.close()
    errors = [record for record in caplog.records if record.levelname == "ERROR"]
    expected = not isinstance(fault, (LinkProblem, OSError))
    assert len(errors) == expected  # once, with its traceback
    assert all(record.exc_info for record in errors)


async def test_an_exception_in_on_open_causes_a_reconnection() -> None:
    link, opened = FlakyLink(), list[int]()

    def on_open() -> None:
        opened.append(len(opened))
        if len(opened) == 1:
            raise KeyError("not yet")

    link.on_open = on_open
    link.open()
    await until(lambda: len(opened) == 2 and link.connected)
    assert link.reconnects == 1
    await link.close()


async def test_a_connection_that_cannot_be_polled_is_made_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    link, loop, add = FlakyLink(), asyncio.get_running_loop(), asyncio.get_running_loop().add_reader
    faults = [PermissionError(1, "epoll_ctl"), ValueError("no descriptor")]

    def watched(*args: Any) -> None:
        if faults:
            raise faults.pop()
        add(*args)

    monkeypatch.setattr(loop, "add_reader", watched)
    link.open()
    await until(lambda: link.connected and not faults)
    await link.close()


@pytest.mark.parametrize("gather_s", [0.0, 0.001])
async def test_an_exception_in_on_bytes_causes_a_reconnection(
    gather_s: float,
) -> None:
    link, received = FlakyLink(), list[bytes]()
    link.gather_s = gather_s

    def on_bytes(data: bytes) -> None:
        received.append(data)
        if data == b"bad":
            raise IndexError("frame")

    link.on_bytes = on_bytes
    link.open()
    await until(lambda: link.connected)
    assert link.far is not None
    os.write(link.far, b"bad")
    await until(lambda: link.connected and link.reconnects == 1)
    os.write(link.far, b"good")
    await until(lambda: received == [b"bad", b"good"])
    await link.close()


async def test_an_exception_in_on_lost_does_not_end_the_link() -> None:
    link = FlakyLink()

    def on_lost(_: str) -> None:
        raise ValueError("lost")

    link.on_lost = on_lost
    link.open()
    await until(lambda: link.connected)
    link.drop("a test")
    await until(lambda: link.connected and link.reconnects == 1)
    await link.close()
    await link.close()


@pytest.fixture
async def pty(tmp_path: Path) -> AsyncIterator[Pty]:
    port = Pty(tmp_path / "base")
    port.plug()
    yield port
    port.unplug()


async def test_an_adapter_lost_between_open_and_settings_is_opened_again(
    pty: Pty, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened, bounced = list[serial.Serial](), list[int]()
    open_port, tcgetattr = serial_link.open_port, termios.tcgetattr

    def opening(path: str, baud: int) -> serial.Serial:
        opened.append(open_port(path, baud))
        return opened[-1]

    def bouncing(fd: int) -> list[int]:
        if opened and not bounced:
            bounced.append(fd)
            raise termios.error(5, "Input/output error")
        return tcgetattr(fd)

    monkeypatch.setattr(serial_link, "open_port", opening)
    monkeypatch.setattr(termios, "tcgetattr", bouncing)
    link = SerialLink(str(pty.path), 115200, Clock())
    received = LinkRecorder(link)
    link.open()
    await until(lambda: link.connected)
    assert bounced
    assert not opened[0].is_open  # not leaked
    pty.write(b"hello")
    await until(lambda: received.data == b"hello")
    await link.close()


async def test_a_failing_probe_leaves_no_port_open(
    pty: Pty, monkeypatch: pytest.MonkeyPatch
) -> None:
    probed: list[serial.Serial] = []

    def probe(port: serial.Serial) -> bool:
        probed.append(port)
        if len(probed) == 1:
            raise termios.error(5, "Input/output error")
        return True

    monkeypatch.setattr(serial_link, "candidate_paths", lambda name: [str(pty.path)])
    link = SerialLink("auto", 115200, Clock(), probe=probe)
    link.open()
    await until(lambda: link.connected)
    assert not probed[0].is_open
    await link.close()


async def test_an_invalid_host_name_is_a_problem_and_does_not_end_the_link() -> None:
    link = TcpLink("a..b", 80, Clock())
    link.open()
    await until(lambda: "a..b" in link.problem)
    await asyncio.sleep(0)
    assert not link.connected
    await link.close()
