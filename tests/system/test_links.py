"""Links: they reconnect by themselves, never block or raise, and send nothing late."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import serial

from gigabrain_drivers.emulators.ports import Pty
from gigabrain_drivers.links import serial_link
from gigabrain_drivers.links.serial_link import SerialLink, open_port
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.testing.waiting import until
from tests.system.links import LinkRecorder


@pytest.fixture
async def pty(tmp_path: Path) -> AsyncIterator[Pty]:
    port = Pty(tmp_path / "base")
    port.plug()
    yield port
    port.unplug()


@pytest.fixture
async def link(pty: Pty) -> AsyncIterator[SerialLink]:
    link = SerialLink(str(pty.path), 115200, Clock())
    yield link
    await link.close()


async def test_bytes_go_both_ways(pty: Pty, link: SerialLink) -> None:
    received, back = LinkRecorder(link), list[bytes]()
    pty.on_bytes = back.append
    link.open()
    await until(lambda: link.connected)
    assert link.write(b"V,0.100,0.500\n")
    pty.write(b"\x00\n\r\xff")  # a raw line changes no byte
    await until(lambda: back and received.data)
    assert (b"".join(back), received.data) == (b"V,0.100,0.500\n", b"\x00\n\r\xff")
    assert (received.opened, received.lost, link.problem) == (1, [], "")


async def test_a_link_waits_for_a_missing_port(tmp_path: Path) -> None:
    pty, link = Pty(tmp_path / "base"), SerialLink(str(tmp_path / "base"), 115200, Clock())
    link.open()
    assert not link.write(b"too early")
    await until(lambda: "is it plugged in?" in link.problem)
    pty.plug()
    await until(lambda: link.connected)
    assert link.reconnects == 0
    await link.close()
    pty.unplug()


async def test_an_unplugged_port_is_noticed_and_reopened(pty: Pty, link: SerialLink) -> None:
    received, back = LinkRecorder(link), list[bytes]()
    pty.on_bytes = back.append
    link.open()
    await until(lambda: link.connected)
    pty.unplug()
    await until(lambda: received.lost)
    assert not link.connected
    assert not link.write(b"lost")
    pty.plug()
    await until(lambda: link.connected)
    assert (received.opened, link.reconnects, link.health.reconnects) == (2, 1, 1)
    assert link.write(b"new")
    await until(lambda: back)
    assert back == [b"new"]  # no old bytes


async def test_an_unplugged_port_does_not_busy_loop(
    pty: Pty, link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    link.open()
    await until(lambda: link.connected)
    pty.unplug()
    await until(lambda: not link.connected)
    selector, turns = asyncio.get_running_loop()._selector, list[float | None]()  # type: ignore[attr-defined]
    select = selector.select
    monkeypatch.setattr(selector, "select", lambda wait=None: turns.append(wait) or select(wait))
    await asyncio.sleep(0.3)
    assert 0 < len(turns) < 30  # a busy loop would make thousands


async def test_a_device_that_read_nothing_gets_no_old_bytes(pty: Pty, link: SerialLink) -> None:
    link.open()
    await until(lambda: link.connected)
    loop = asyncio.get_running_loop()
    assert pty._master is not None
    loop.remove_reader(pty._master)  # the device stops reading
    sent = 0
    while link.write(b"x" * 64):
        sent += 1
        assert sent < 10_000
    back: list[bytes] = []
    pty.on_bytes = back.append
    loop.add_reader(pty._master, pty._readable)
    await until(lambda: link.write(b"new"))
    await until(lambda: b"".join(back).endswith(b"new"))
    taken = b"".join(back)[:-3]
    assert set(taken) <= {ord("x")}
    assert len(taken) <= 4096 < 64 * sent  # the rest is dropped, not sent late


async def test_a_port_can_be_opened_only_once(pty: Pty, link: SerialLink) -> None:
    link.open()
    await until(lambda: link.connected)
    other = SerialLink(str(pty.path), 115200, Clock())
    other.open()
    await until(lambda: "in use by pid" in other.problem)
    await other.close()
    assert link.connected


async def test_missing_modem_lines_are_no_fault(pty: Pty, link: SerialLink) -> None:
    link.set_dtr(False)
    link.open()
    await until(lambda: link.connected)
    link.set_dtr(False)
    assert link.connected


async def test_close_works_in_any_state_any_number_of_times(pty: Pty) -> None:
    link = SerialLink(str(pty.path), 115200, Clock())
    await link.close()
    link.open()
    await link.close()  # while opening
    await link.close()
    link.open()
    await until(lambda: link.connected)
    await link.close()
    assert (link.connected, link.problem) == (False, "closed")
    again = open_port(str(pty.path), 115200)  # the port is free
    again.close()


async def test_a_trace_shows_both_directions(pty: Pty, link: SerialLink) -> None:
    seen: list[tuple[str, bytes]] = []
    link.trace = lambda way, data: seen.append((way, data))
    link.open()
    await until(lambda: link.connected)
    link.write(b"out")
    pty.write(b"in")
    await until(lambda: len(seen) == 2)
    assert seen == [("tx", b"out"), ("rx", b"in")]


async def test_the_age_of_a_link_is_that_of_its_newest_bytes(pty: Pty, link: SerialLink) -> None:
    link.open()
    await until(lambda: link.connected)
    await asyncio.sleep(0.05)
    assert link.health.age_ms >= 45
    received, loop = LinkRecorder(link), asyncio.get_running_loop()
    wrote_s = loop.time()
    pty.write(b"x")
    await until(lambda: received.data)
    assert link.health.age_ms <= 1e3 * (loop.time() - wrote_s)


async def test_auto_takes_the_port_that_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right, wrong = Pty(tmp_path / "right"), Pty(tmp_path / "another")
    for pty in (right, wrong):
        pty.plug()
    paths = [str(wrong.path), str(tmp_path / "gone"), str(right.path)]
    monkeypatch.setattr(serial_link, "candidate_paths", lambda port: paths)
    right.on_bytes = lambda data: right.write(b"mycustombot") and None

    def probe(port: serial.Serial) -> bool:
        port.write(b"who?")
        return b"mycustombot" in port.read(11)

    link = SerialLink("auto", 115200, Clock(), probe=probe)
    link.open()
    await until(lambda: link.connected)
    assert link.path == str(right.path)
    await link.close()
    for pty in (right, wrong):
        pty.unplug()


def test_a_usb_port_is_named_by_its_numbers() -> None:
    assert serial_link.usb_id("usb:0483:5740") == (0x0483, 0x5740, "")
    assert serial_link.usb_id("usb:10c4:ea60:0001") == (0x10C4, 0xEA60, "0001")
    with pytest.raises(ValueError, match="expected usb:VID:PID"):
        serial_link.usb_id("usb:0483")
    with pytest.raises(ValueError, match="hexadecimal"):
        serial_link.usb_id("usb:048x:5740")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("usb:12345:0043", "up to four hexadecimal digits"),
        ("usb:2341:-43", "up to four hexadecimal digits"),
        ("USB:2341:0043", "did you mean 'usb:2341:0043'"),
        ("Auto", "did you mean 'auto'"),
        ("", "expected a path"),
        ("tcp://1.2.3.4:5", "expected a path"),
    ],
)
def test_invalid_port_names_are_refused_with_their_field(name: str, expected: str) -> None:
    with pytest.raises(ValueError, match=f"^port: .*{expected}"):
        serial_link.check_port(name)


@pytest.mark.parametrize("name", ["auto", "usb:2341:0043", "usb:2341:43:A-1", "/dev/ttyUSB0"])
def test_valid_port_names_are_accepted(name: str) -> None:
    serial_link.check_port(name)


def test_port_problems_have_a_remedy() -> None:
    assert (
        serial_link.describe_missing("usb:0483:5740")
        == "no USB device usb:0483:5740: is it plugged in?"
    )
    assert 'KERNEL=="ttyACM9", MODE="0666"' in serial_link.describe_refusal(
        "/dev/ttyACM9", PermissionError(13, "Permission denied")
    )


@pytest.mark.parametrize("path", ["/dev/null", "/tmp"])
async def test_a_path_that_is_no_serial_port_is_reported_as_such(path: str) -> None:
    link = SerialLink(path, 115200, Clock())
    link.open()
    await until(lambda: link.problem == f"{path} is not a serial port")
    await link.close()
