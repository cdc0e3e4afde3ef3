"""The chaos proxy for serial lines: a pty in front of a pty, and a folder of ports."""

import asyncio
import os
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gigabrain_drivers.emulators.ports import Pty, TcpPort
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_drivers.links.tcp_link import AddressLink
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.qa.proxy.chaos import CALM, Chaos
from gigabrain_zenoh.qa.proxy.serial import LineProxy, in_front_of
from gigabrain_zenoh.testing.waiting import until


class Line:
    """A device, the proxy in front of it, and a host that opened the proxy."""

    def __init__(self, folder: Path) -> None:
        self.device = Pty(folder / "device")
        self.proxy = LineProxy(str(self.device.path), folder / "proxy", seed=1)
        self.host = SerialLink(str(folder / "proxy"), 115200, Clock())
        self.up, self.down = bytearray(), bytearray()
        self.device.on_bytes, self.host.on_bytes = self.up.extend, self.down.extend


@pytest.fixture
async def line(tmp_path: Path) -> AsyncIterator[Line]:
    made = Line(tmp_path)
    made.device.plug()
    async with made.proxy:
        made.host.open()
        await until(lambda: made.host.connected and made.proxy.connected, "both are open")
        yield made
        await made.host.close()
    made.device.unplug()


async def test_a_calm_line_changes_no_byte(line: Line) -> None:
    assert line.host.write(bytes(range(256)))
    assert line.device.write(b"\x00\n\r\xff\x11\x13")
    await until(lambda: len(line.up) == 256 and len(line.down) == 6, "all of it")
    assert (bytes(line.up), bytes(line.down)) == (bytes(range(256)), b"\x00\n\r\xff\x11\x13")


async def test_bytes_sent_into_a_hole_are_lost(line: Line) -> None:
    line.proxy.set(Chaos(hole=True), "up")
    line.host.write(b"lost")
    line.device.write(b"heard")
    await until(lambda: line.down == b"heard" and line.proxy.figures["up"].dropped == 4, "both")
    line.proxy.set(CALM, "up")
    line.host.write(b"found")
    await until(lambda: line.up, "what comes after")
    assert bytes(line.up) == b"found"


async def test_bit_errors_and_losses_occur_at_the_set_rates(line: Line) -> None:
    line.proxy.set(Chaos(corrupt=1.0), "down")
    line.proxy.set(Chaos(drop=1.0), "up")
    line.device.write(bytes(64))
    line.host.write(bytes(64))
    figures = line.proxy.figures
    await until(lambda: len(line.down) == 64 and figures["up"].dropped == 64, "both ways")
    assert all(byte.bit_count() == 1 for byte in line.down)
    assert (figures["down"].flipped, bytes(line.up)) == (64, b"")


async def test_a_replugged_port_is_found_again(line: Line) -> None:
    await line.proxy.unplug()
    await until(lambda: not line.host.connected, "the loss")
    assert "unplugged" in line.host.problem or line.host.problem
    await line.proxy.plug()
    await until(lambda: line.host.connected, "it is back")
    line.host.write(b"back")
    await until(lambda: line.up == b"back", "what comes after")
    assert line.host.reconnects == 1


async def test_every_port_of_an_emulator_gets_a_proxy(tmp_path: Path) -> None:
    before = len(os.listdir("/dev/fd"))
    serial, tcp = Pty(tmp_path / "ports" / "scan"), TcpPort(tmp_path / "ports" / "base", 0)
    (tmp_path / "ports").mkdir()
    (tmp_path / "ports" / "faults.json").write_text("{}")
    received = bytearray()
    tcp.on_bytes = received.extend
    serial.plug()
    tcp.plug()
    async with in_front_of(tmp_path / "ports", tmp_path / "spoiled") as proxies:
        assert sorted(proxies) == ["base", "scan"]
        link = AddressLink(str(tmp_path / "spoiled" / "base"), Clock())
        link.quiet_ns = None
        link.open()
        await until(lambda: link.connected, "it is open")
        link.write(b"to a body behind TCP")
        await until(lambda: received == b"to a body behind TCP", "it arrives")
        await link.close()
    serial.unplug()
    tcp.unplug()
    assert list((tmp_path / "spoiled").iterdir()) == []
    await asyncio.sleep(0)
    await until(lambda: len(os.listdir("/dev/fd")) <= before, "no descriptor is left")
