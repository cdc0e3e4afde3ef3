"""Packets and items of the servo bus, against literal bytes of the vendor's manual and SDK."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.protocol import FeetechDecoder, FeetechPacket, Register

PACKETS = st.builds(FeetechPacket, st.integers(0, 253), st.integers(0, 255), st.binary(max_size=60))


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (feetech.ping(1), "ff ff 01 02 01 fb"),
        (feetech.status(1), "ff ff 01 02 00 fc"),
        (feetech.read(1, 56, 2), "ff ff 01 04 02 38 02 be"),
        (feetech.status(1, b"\x00\x08"), "ff ff 01 04 00 00 08 f2"),
        (feetech.write(1, 40, b"\0"), "ff ff 01 04 03 28 00 cf"),
        (feetech.sync_read(range(1, 7), 56, 2), "ff ff fe 0a 82 38 02 01 02 03 04 05 06 26"),
        (
            feetech.sync_write(
                46, {7 + n: feetech.GOAL_VELOCITY.encode(v) for n, v in enumerate((500, -300, 0))}
            ),
            "ff ff fe 0d 83 2e 02 07 f4 01 08 2c 81 09 00 00 87",
        ),
    ],
)
def test_packets_are_those_of_the_vendor(frame: bytes, expected: str) -> None:
    assert frame.hex(" ") == expected
    assert FeetechDecoder().feed(frame)


@pytest.mark.parametrize(
    ("register", "value", "data"),
    [
        (feetech.POSITION, 2048, "00 08"),
        (feetech.POSITION, -1, "01 80"),
        (feetech.OFFSET, -1126, "66 0c"),
        (feetech.OFFSET, 2047, "ff 07"),
        (feetech.LOAD, -1000, "e8 07"),
        (feetech.TORQUE, 1, "01"),
    ],
)
def test_a_sign_is_a_bit_of_its_own(register: Register, value: int, data: str) -> None:
    assert register.encode(value).hex(" ") == data
    assert register.decode(bytes.fromhex(data)) == value


@pytest.mark.parametrize(
    ("register", "value"),
    [(feetech.OFFSET, 2048), (feetech.LOAD, -1024), (feetech.TORQUE, 256), (feetech.GOAL, 32768)],
)
def test_what_does_not_fit_is_not_sent(register: Register, value: int) -> None:
    with pytest.raises(OverflowError):
        register.encode(value)


@given(st.lists(PACKETS, max_size=5), st.integers(1, 9))
def test_packets_are_found_however_they_are_cut(packets: list[FeetechPacket], size: int) -> None:
    stream = b"".join(map(feetech.encode, packets))
    decoder = FeetechDecoder()
    pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
    assert [found for piece in pieces for found in decoder.feed(piece)] == packets


@pytest.mark.parametrize("before", ["ff", "ff ff", "00 ff ff ff", "ff ff 03 fb", "ff ff 01 04 00"])
def test_what_is_left_of_a_broken_packet_costs_no_other(before: str) -> None:
    decoder = FeetechDecoder()
    decoder.expected = 2
    answer = FeetechPacket(2, 0, b"\x00\x08")
    assert decoder.feed(bytes.fromhex(before) + feetech.encode(answer)) == [answer]


def test_an_answer_of_another_length_is_none() -> None:
    decoder = FeetechDecoder()
    decoder.expected = 2
    assert not decoder.feed(feetech.status(1, b"\x00"))
    assert decoder.feed(feetech.status(1, b"\x00\x08"))
    assert decoder.errors == 1


def test_a_wrong_sum_is_counted() -> None:
    decoder = FeetechDecoder()
    assert not decoder.feed(bytes.fromhex("ff ff 01 04 00 00 08 f3"))
    assert decoder.errors == 1


BLOCK = bytes.fromhex(
    "01 fe 00 08 00 00 dc 85 e8 03 00 00 00 00 00 01 ff 07 2c 81 90 05 4a 1e 00 20 01 00 00 0a 00"
)


def test_one_read_of_a_cycle_holds_commands_and_measurements() -> None:
    now = feetech.decode_readings(BLOCK)
    assert (now.torque, now.acceleration, now.goal, now.torque_limit) == (True, 254, 2048, 1000)
    assert (now.goal_velocity, now.lock) == (-1500, 1)
    assert (now.position, now.velocity, now.load) == (2047, -300, -400)
    assert (now.voltage, now.temperature, now.status, now.moving) == (74, 30, 0x20, True)
    assert now.current == 10
    with pytest.raises(ValueError, match="expected 31 bytes"):
        feetech.decode_readings(BLOCK[1:])


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (feetech.ping(3), "ping 3"),
        (feetech.read(3, 56, 2), "read 2 bytes at 56 of 3"),
        (feetech.write(3, 40, b"\1"), "write 01 at 40 of 3"),
        (feetech.sync_read([1, 2], 40, 31), "read 31 bytes at 40 of 1, 2"),
        (feetech.sync_write(42, {1: b"\0\x08", 2: b"\1\0"}), "goals 1: 2048, 2: 1 ticks"),
        (feetech.sync_write(40, {1: b"\1"}), "write at 40 of 1: 01"),
        (feetech.encode(FeetechPacket(254, 5)), "instruction 05 to 254"),
        (feetech.encode(FeetechPacket(254, feetech.SYNC_WRITE, b"\x2a\2\1")), "goals  ticks"),
    ],
)
def test_what_is_sent_can_be_read(frame: bytes, text: str) -> None:
    (packet,) = FeetechDecoder().feed(frame)
    assert feetech.describe_sent(packet) == text


def test_what_is_received_can_be_read() -> None:
    def text(frame: bytes) -> str:
        (packet,) = FeetechDecoder().feed(frame)
        return feetech.describe_received(packet)

    assert text(feetech.status(3)) == "servo 3: ok"
    assert text(feetech.status(3, b"\0\x08", 0x24)) == (
        "servo 3: error: temperature, overload, 00 08"
    )
    assert text(feetech.status(3, BLOCK)) == (
        "servo 3: ok, at 2047 of 2048 ticks, -300 ticks/s, load -40.0%, 7.4 V, 30 deg C, torque on"
    )
