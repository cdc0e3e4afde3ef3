"""The control table of TurtleBot3's board, against literal bytes."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.bodies.turtlebot3.protocol import DynamixelDecoder


def table(**items: bytes) -> bytes:
    """172 zero bytes with `a<address>` put in."""
    data = bytearray(172)
    for name, value in items.items():
        at = int(name[1:]) - 10
        data[at : at + len(value)] = value
    return bytes(data)


def test_one_read_fetches_the_172_bytes_from_address_10() -> None:
    assert opencr.ask().hex(" ") == "ff ff fd 00 c8 07 00 02 0a 00 ac 00 b6 2f"


def test_a_tenth_of_a_metre_and_half_a_radian_per_second() -> None:
    sent = opencr.velocity(0.10, 0.5)
    assert sent.frame.hex(" ") == (
        "ff ff fd 00 c8 1d 00 03 96 00 0a 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 "
        "32 00 00 00 4d 37"
    )
    assert (sent.linear_x, sent.angular_z) == pytest.approx((0.10, 0.5))


def test_zero_velocity() -> None:
    assert opencr.velocity(0.0, 0.0).frame.hex(" ") == (
        "ff ff fd 00 c8 1d 00 03 96 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 "
        "00 00 00 00 06 a0"
    )


def test_the_heartbeat_counts_in_one_byte() -> None:
    assert opencr.heartbeat(7).hex(" ") == "ff ff fd 00 c8 06 00 03 13 00 07 23 a7"
    assert opencr.heartbeat(256 + 7) == opencr.heartbeat(7)


@pytest.mark.parametrize(
    ("wanted", "sent"),
    [(0.009, 0.01), (-0.009, -0.01), (0.004, 0.0), (0.2549, 0.25), (1e9, 100.0), (-1e9, -100.0)],
)
def test_speeds_are_rounded_to_hundredths_and_what_was_sent_is_returned(
    wanted: float, sent: float
) -> None:
    assert opencr.velocity(wanted, wanted).linear_x == pytest.approx(sent)
    assert opencr.velocity(wanted, wanted).angular_z == pytest.approx(sent)


@given(st.floats(-3, 3), st.floats(-3, 3), st.integers(0, 1000), st.booleans())
def test_nothing_that_is_ever_sent_touches_address_14(
    forward: float, turn: float, count: int, on: bool
) -> None:
    frames = (
        opencr.ask(),
        opencr.velocity(forward, turn).frame,
        opencr.heartbeat(count),
        opencr.torque(on),
    )
    for frame in frames:
        (packet,) = DynamixelDecoder().feed(frame)
        (address,) = struct.unpack_from("<H", packet.params)
        length = len(packet.params) - 2
        assert packet.instruction == 2 or not address <= 14 < address + length


def test_items_are_where_the_firmware_has_them() -> None:
    found = opencr.decode_readings(
        table(
            a10=(123456).to_bytes(4, "little"),
            a18=b"\xff\x2a",
            a26=b"\x01\x00\x00\x01",
            a42=struct.pack("<II", 1184, 7444),
            a60=struct.pack("<3f", 0.25, -0.5, 1.5),
            a72=struct.pack("<3f", 0.5, -0.25, 9.75),
            a96=struct.pack("<4f", 0.5, 0.25, -0.25, -0.5),
            a120=struct.pack("<2i", 100, -100),
            a128=struct.pack("<2i", 253, -253),
            a136=struct.pack("<2i", 4096, -8192),
            a149=b"\x01",
        )
    )
    assert found.milliseconds == 123456
    assert found.device_status == -1
    assert found.heartbeat == 42
    assert found.buttons == (True, False)
    assert found.bumpers == (False, True)
    assert found.voltage == pytest.approx(11.84)
    assert found.percentage == pytest.approx(74.44)
    assert found.angular_velocity == (0.25, -0.5, 1.5)
    assert found.linear_acceleration == (0.5, -0.25, 9.75)
    assert found.orientation == (0.25, -0.25, -0.5, 0.5)
    assert found.currents == pytest.approx((0.269, -0.269))
    assert found.velocities == pytest.approx((6.0671, -6.0671), abs=1e-4)
    assert found.ticks == (4096, -8192)
    assert found.torque
    assert not found.watchdog_off


def test_a_velocity_register_of_253_is_two_tenths_of_a_metre_per_second() -> None:
    found = opencr.decode_readings(table(a128=struct.pack("<2i", 253, 1)))
    assert found.velocities[0] * 0.033 == pytest.approx(0.20021, abs=1e-5)
    assert found.velocities[1] * 0.033 == pytest.approx(7.9136e-4, abs=1e-7)
    assert pytest.approx(0.001533981, abs=1e-9) == opencr.RADIANS_PER_TICK
    assert pytest.approx(math.tau) == opencr.RADIANS_PER_TICK * 4096


@pytest.mark.parametrize(
    ("voltage", "register", "percentage"),
    [(1260, 11666, 100.0), (1140, 5000, 50.0), (1049, 4321, 0.0)],
)
def test_the_charge_is_at_most_full_and_empty_where_its_register_stands_still(
    voltage: int, register: int, percentage: float
) -> None:
    found = opencr.decode_readings(table(a42=struct.pack("<II", voltage, register)))
    assert found.percentage == pytest.approx(percentage)


def test_the_switch_of_the_watchdog_is_seen() -> None:
    assert opencr.decode_readings(table(a14=b"\x01")).watchdog_off


@pytest.mark.parametrize("length", [0, 171, 173])
def test_answers_of_another_length_are_refused(length: int) -> None:
    with pytest.raises(ValueError, match=f"expected 172 bytes of the control table, got {length}"):
        opencr.decode_readings(bytes(length))
