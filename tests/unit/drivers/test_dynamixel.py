"""Dynamixel Protocol 2.0, by the vendor's manual, the vendor's SDK and hostile input."""

import random

import dynamixel_sdk
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.bodies.turtlebot3.protocol import (
    READ,
    STATUS,
    WRITE,
    DynamixelDecoder,
    DynamixelPacket,
    crc16,
    encode,
    ping,
    read,
    status,
    write,
)

FRAMES = {
    "ping 1 (e-manual)": ("ff ff fd 00 01 03 00 01 19 4e", ping(1)),
    "its answer (e-manual)": (
        "ff ff fd 00 01 07 00 55 00 06 04 26 65 5d",
        status(1, bytes([0x06, 0x04, 0x26])),
    ),
    "ping 200": ("ff ff fd 00 c8 03 00 01 3b fa", ping(200)),
    "its answer": (
        "ff ff fd 00 c8 07 00 55 00 00 50 05 4c b7",
        status(200, bytes([0x00, 0x50, 0x05])),
    ),
    "read 10..181": ("ff ff fd 00 c8 07 00 02 0a 00 ac 00 b6 2f", read(200, 10, 172)),
    "write 19": ("ff ff fd 00 c8 06 00 03 13 00 07 23 a7", write(200, 19, bytes([7]))),
    "its answer, all well": ("ff ff fd 00 c8 04 00 55 00 19 2d", status(200)),
    "stuffed write at 174": (
        "ff ff fd 00 c8 0f 00 03 ae 00 ff ff fd fd 00 ff ff fd fd 00 33 0b",
        write(200, 174, bytes.fromhex("fffffd00fffffd00")),
    ),
}
HARD = [b"\xff", b"\xfd", b"\x00", b"\x12"]  # what headers and stuffing are made of
packets = st.builds(
    DynamixelPacket,
    id=st.integers(0, 252),
    instruction=st.sampled_from([READ, WRITE, STATUS]),
    params=st.lists(st.sampled_from(HARD), max_size=60).map(b"".join),
)


@pytest.mark.parametrize("name", FRAMES)
def test_frames_are_those_of_the_manual(name: str) -> None:
    expected, frame = FRAMES[name]
    assert frame.hex(" ") == expected


def test_the_stuffed_write_is_read_without_its_stuffing() -> None:
    frame = bytes.fromhex(FRAMES["stuffed write at 174"][0])
    assert DynamixelDecoder().feed(frame) == [
        DynamixelPacket(200, WRITE, bytes.fromhex("ae00 fffffd00 fffffd00"))
    ]


@given(st.binary(max_size=300))
def test_the_check_is_the_vendors(data: bytes) -> None:
    handler = dynamixel_sdk.Protocol2PacketHandler()
    assert crc16(data) == handler.updateCRC(0, list(data), len(data))


@given(packets)
def test_what_is_encoded_is_decoded_whatever_it_holds(packet: DynamixelPacket) -> None:
    decoder = DynamixelDecoder()
    assert decoder.feed(encode(packet)) == [packet]
    assert decoder.errors == 0


@given(st.lists(packets, max_size=4), st.lists(st.integers(1, 40), min_size=1, max_size=20))
def test_pieces_of_any_size_make_no_difference(
    sent: list[DynamixelPacket], sizes: list[int]
) -> None:
    stream = b"".join(map(encode, sent))
    decoder, found = DynamixelDecoder(), []
    while stream:
        for size in sizes:
            found += decoder.feed(stream[:size])
            stream = stream[size:]
    assert found == sent
    assert decoder.errors == 0


@given(st.binary(max_size=200), packets)
def test_a_packet_is_found_behind_any_noise(noise: bytes, packet: DynamixelPacket) -> None:
    decoder = DynamixelDecoder(longest=100)
    decoder.feed(noise)
    flushed = decoder.feed(bytes(110)) + decoder.feed(encode(packet))
    assert flushed[-1:] == [packet]


def test_a_boot_banner_before_the_answer_costs_one_error() -> None:
    decoder = DynamixelDecoder()
    assert decoder.feed(b"OpenCR boot\r\n" + status(200)) == [DynamixelPacket(200, STATUS, b"\0")]
    assert decoder.errors == 1


def test_no_single_flipped_bit_passes_for_a_command() -> None:
    good = write(200, 150, bytes(range(24)))
    for bit in range(8 * len(good)):
        frame = bytearray(good)
        frame[bit // 8] ^= 1 << bit % 8
        assert DynamixelDecoder().feed(bytes(frame)) == []


def test_a_flipped_bit_in_the_length_costs_only_its_own_packet() -> None:
    broken = bytearray(status(200, bytes(172)))
    broken[6] = 0x02  # now 512 bytes longer
    decoder = DynamixelDecoder()
    assert decoder.feed(bytes(broken) + status(200)) == [DynamixelPacket(200, STATUS, b"\0")]
    assert decoder.errors == 1


def test_endless_noise_takes_no_room() -> None:
    decoder = DynamixelDecoder()
    for _ in range(100):
        decoder.feed(b"\xff\xff\xfd\x00\xc8\xff\x03" + bytes(4096))
    assert len(decoder._buffer) < 1100


def test_an_impossible_length_is_not_waited_for() -> None:
    decoder = DynamixelDecoder()
    for length in (0, 1, 2, 1025, 65535):
        head = b"\xff\xff\xfd\x00\xc8" + length.to_bytes(2, "little")
        assert decoder.feed(head + ping(200)) == [DynamixelPacket(200, 1)]
    assert decoder.errors == 5


def test_what_had_begun_is_forgotten_when_asked() -> None:
    decoder = DynamixelDecoder()
    decoder.feed(status(200, bytes(10))[:12])
    decoder.clear()
    assert decoder.feed(status(200)) == [DynamixelPacket(200, STATUS, b"\0")]
    assert decoder.errors == 0


def test_noise_of_one_byte_in_a_thousand_makes_no_wrong_command() -> None:
    noise = random.Random(7)
    sent = [write(200, 150, noise.randbytes(24)) for _ in range(20_000)]
    stream = bytearray(b"".join(sent))
    for at in noise.sample(range(len(stream)), len(stream) // 1000):
        stream[at] ^= noise.randint(1, 255)
    decoder, found = DynamixelDecoder(), list[DynamixelPacket]()
    for at in range(0, len(stream), 1000):
        found += decoder.feed(bytes(stream[at : at + 1000]))
    assert {encode(packet) for packet in found} <= set(sent)
    assert 19_200 < len(found) < 19_400
