"""A CAN link: frames both ways on a real bus, its loss, and errors without a bus."""

import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import can
import pytest

from gigabrain_drivers.emulators.can_port import CanPort
from gigabrain_drivers.links import can_link
from gigabrain_drivers.links.can_link import (
    CanDecoder,
    CanFrame,
    CanLink,
    open_multicast,
    read_address,
    records,
)
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.testing.waiting import until

FRAME = CanFrame(0x2A1, bytes(range(8)))


@pytest.fixture(name="port")
async def make_port(tmp_path: Path) -> AsyncIterator[CanPort]:
    port = CanPort(tmp_path / "bus")
    port.plug()
    yield port
    port.unplug()


@pytest.fixture(name="link")
async def make_link(port: CanPort) -> AsyncIterator[CanLink]:
    link = CanLink(str(port.path), Clock(), quiet_ns=None)
    link.open()
    await until(lambda: link.connected)
    yield link
    await link.close()


async def test_frames_go_both_ways_in_order(port: CanPort, link: CanLink) -> None:
    here, there = list[CanFrame](), list[CanFrame]()
    link.on_bytes = lambda data: here.extend(CanDecoder().feed(data))
    port.on_bytes = lambda data: there.extend(CanDecoder().feed(data))
    sent = [CanFrame(0x100 + number, bytes((number,))) for number in range(20)]
    assert link.write(records(sent))
    assert port.write(FRAME.record())
    await until(lambda: FRAME in here and FRAME in there and len(there) == 21)
    assert [frame for frame in there if frame != FRAME] == sent


async def test_invalid_datagrams_are_counted(port: CanPort, link: CanLink) -> None:
    here = list[CanFrame]()
    link.on_bytes = lambda data: here.extend(CanDecoder().feed(data))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for junk in (b"", b"junk", b"\xff" * 600):
            stranger.sendto(junk, read_address(port.path))
    port.write(FRAME.record())
    await until(lambda: FRAME in here)
    assert link.lost_frames == 3
    assert link.connected


async def test_a_silent_bus_is_reopened(port: CanPort) -> None:
    link, lost = CanLink(str(port.path), Clock(), quiet_ns=100_000_000), list[str]()
    link.on_lost = lost.append
    link.open()
    await until(lambda: link.reconnects == 1)
    assert lost[0].startswith("no data for")
    port.unplug()
    await until(lambda: link.problem.endswith("is the emulator running?"))
    assert not link.write(FRAME.record())
    port.plug()
    await until(lambda: link.connected)
    await link.close()
    assert link.problem == "closed"


async def test_a_missing_interface_is_reported_in_one_line(tmp_path: Path) -> None:
    link = CanLink("can_nowhere", Clock())
    link.open()
    await until(lambda: link.problem.startswith("no CAN interface can_nowhere"))
    assert not link.connected
    await link.close()


async def test_an_interface_is_opened_with_kernel_filters(
    port: CanPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SocketCAN is not available everywhere, so only the request to python-can is checked."""
    asked = list[dict[str, Any]]()

    def bus(**options: Any) -> can.BusABC:
        asked.append(options)
        return open_multicast(*read_address(port.path))

    monkeypatch.setattr(can_link, "describe_interface", lambda name: "")
    monkeypatch.setattr(can, "Bus", bus)
    link = CanLink("can0", Clock(), ids=(0x2A1, 0x2A5))
    link.open()
    await until(lambda: link.connected)
    await link.close()
    filters = [{"can_id": 0x2A1, "can_mask": 0x7FF}, {"can_id": 0x2A5, "can_mask": 0x7FF}]
    assert asked[0] == {"interface": "socketcan", "channel": "can0", "can_filters": filters}


async def test_an_interface_that_cannot_be_opened_is_reported_with_the_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def bus(**_: Any) -> can.BusABC:
        raise OSError(97, "Address family not supported by protocol")

    monkeypatch.setattr(can_link, "describe_interface", lambda name: "")
    monkeypatch.setattr(can, "Bus", bus)
    link = CanLink("can0", Clock())
    link.open()
    await until(lambda: link.problem == "can0: Address family not supported by protocol")
    await link.close()
