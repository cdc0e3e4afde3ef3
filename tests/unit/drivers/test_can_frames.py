"""CAN frames as bytes, and names of CAN interfaces, with texts if one cannot be used."""

from pathlib import Path

import pytest

from gigabrain_drivers.links.can_link import (
    CanDecoder,
    CanFrame,
    CanSpelling,
    address_text,
    check_can_port,
    describe_interface,
    read_address,
    records,
)
from gigabrain_drivers.links.link import LinkProblem

FRAMES = [CanFrame(0x155, bytes(range(8))), CanFrame(0x7FF, b""), CanFrame(1, b"\x01\x02")]


def test_records_have_the_layout_of_linux() -> None:
    assert records(FRAMES[:1]).hex() == "5501000008000000" + "0001020304050607"
    assert CanDecoder().feed(records(FRAMES)) == FRAMES


def test_invalid_records_are_counted_and_dropped() -> None:
    decoder = CanDecoder()
    extended, long = CanFrame(0x800, b""), bytearray(CanFrame(0x100, bytes(8)).record())
    long[4] = 9
    assert decoder.feed(extended.record() + bytes(long) + records(FRAMES)) == FRAMES
    assert decoder.errors == 2
    assert decoder.feed(records(FRAMES)[:20]) == FRAMES[:1]
    assert decoder.errors == 3
    assert decoder.feed(records(FRAMES)) == FRAMES


def test_frames_are_logged_in_the_format_of_candump() -> None:
    spelling = CanSpelling(lambda frame: f"{len(frame.data)} bytes")
    assert spelling.spell(records(FRAMES)) == [
        "155#0001020304050607  8 bytes",
        "7ff#  0 bytes",
        "001#0102  2 bytes",
    ]


@pytest.mark.parametrize("port", ["can0", "slcan_1", "/run/ports/base", "ports/base"])
def test_names_of_interfaces_and_paths_are_valid_ports(port: str) -> None:
    check_can_port(port)


@pytest.mark.parametrize("port", ["", "can 0", "0can", "a-name-that-is-too-long", "usb:1:2"])
def test_other_names_are_refused(port: str) -> None:
    with pytest.raises(ValueError, match="port: expected a CAN interface such as can0"):
        check_can_port(port)


def interface(folder: Path, name: str, kind: int, flags: int) -> None:
    (folder / name).mkdir()
    (folder / name / "type").write_text(f"{kind}\n", encoding="ascii")
    (folder / name / "flags").write_text(f"{flags:#x}\n", encoding="ascii")


def test_an_interface_that_cannot_be_used_is_described_in_one_line(tmp_path: Path) -> None:
    assert describe_interface("can0", tmp_path) == (
        "no CAN interface can0: is the adapter plugged in?"
    )
    interface(tmp_path, "can1", 280, 0x80)
    interface(tmp_path, "eth0", 1, 0x1003)
    interface(tmp_path, "can2", 280, 0x40081)
    assert describe_interface("can0", tmp_path) == (
        "no CAN interface can0; there is can1, can2: is the adapter plugged in?"
    )
    assert describe_interface("can1", tmp_path) == (
        "can1 is down: sudo ip link set can1 up type can bitrate 1000000"
    )
    assert describe_interface("eth0", tmp_path) == (
        "eth0 is no CAN interface; expected one such as can0"
    )
    assert describe_interface("can2", tmp_path) == ""


def test_a_file_names_the_bus_of_an_emulator(tmp_path: Path) -> None:
    path = tmp_path / "base"
    with pytest.raises(LinkProblem, match="is the emulator running"):
        read_address(path)
    path.write_text(address_text("239.255.1.2", 40123), encoding="ascii")
    assert read_address(path) == ("239.255.1.2", 40123)
    path.write_bytes(b"\xff not an address")
    with pytest.raises(LinkProblem, match="expected `udp GROUP PORT`"):
        read_address(path)
