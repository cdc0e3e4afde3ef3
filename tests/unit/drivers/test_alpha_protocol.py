"""Alpha's frames: literal bytes, round trips, and damaged or hostile bytes."""

import math
import random
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.bodies.alpha import protocol as alpha
from gigabrain_drivers.bodies.alpha.protocol import AlphaDecoder, AlphaFrame, State, Walk
from gigabrain_drivers.kinematics.legs import WALKER, Gait, Senses, is_valid_gait
from gigabrain_drivers.kinematics.wheels import Twist
from gigabrain_drivers.links.tcp_link import address
from gigabrain_zenoh.errors import ConfigError

# the examples of docs/reference/firmware_alpha.md
STOP_1 = bytes.fromhex("a55a0000020101000000d58d9383")
WALK_2 = bytes.fromhex(
    "a55a2c00010102000000e8030000cdcccc3d000000000000000066666640"
    "9a99193f000000000000003f0000003f00000000e17a943e51c540ed"
)
FORWARD = Gait(0.1, 0.0, 0.0, 3.6, 0.6, (0.0, 0.5, 0.5, 0.0), 0.29)

singles = st.floats(-1000, 1000, width=32)
gaits = st.builds(
    Gait, singles, singles, singles, singles, singles, st.tuples(*[singles] * 4), singles
)


def a_state(**changes: object) -> State:
    legs = tuple((leg + 0.25, leg + 0.5, -leg - 0.75) for leg in range(4))
    senses = Senses(
        joints=legs,
        rates=tuple((-1.5, 2.0, leg * 0.5) for leg in range(4)),
        contacts=(True, False, False, True),
        orientation=(0.0, 0.0, 0.0, 1.0),
        angular_velocity=(0.125, -0.25, 0.5),
        linear_acceleration=(0.0, 0.0, 9.8125),
    )
    state = State(
        milliseconds=1000,
        echo=7,
        refused=3,
        flags=alpha.WALKING,
        voltage=25.5,
        current=3.75,
        percentage=87.5,
        senses=senses,
        torques=tuple(range(12)),
        temperatures=(31.5,) * 11 + (-5.0,),
    )
    return state._replace(**changes)


def test_the_examples_of_the_firmware_page() -> None:
    assert alpha.encode_stop(1) == STOP_1
    assert alpha.encode_walk(Walk(1000, FORWARD), 2) == WALK_2
    frames = AlphaDecoder().feed(STOP_1 + WALK_2)
    assert [(frame.type, frame.sequence) for frame in frames] == [(0x02, 1), (0x01, 2)]
    command = alpha.decode_walk(frames[1])
    assert command
    assert command.seen == 1000
    assert command.gait[:3] == pytest.approx((0.1, 0.0, 0.0))


def test_crc_and_lengths_match_the_firmware_page() -> None:
    assert zlib.crc32(b"123456789") == 0xCBF43926
    assert len(alpha.encode_state(a_state(), 1)) == 248
    assert alpha.encode_state(a_state(), 0x01020304)[:10] == bytes.fromhex("a55aea00810104030201")


def test_the_layout_of_a_state_matches_the_firmware_page() -> None:
    data = alpha.encode_state(a_state(), 5)
    assert struct.unpack_from("<III", data, 10) == (1000, 7, 3)
    assert (data[22], data[23]) == (1, 0b1001)
    assert struct.unpack_from("<3f", data, 24) == (25.5, 3.75, 87.5)
    assert struct.unpack_from("<4f", data, 36) == (0.0, 0.0, 0.0, 1.0)
    assert struct.unpack_from("<3f", data, 52) == (0.125, -0.25, 0.5)
    assert struct.unpack_from("<3f", data, 64) == (0.0, 0.0, 9.8125)
    assert struct.unpack_from("<3f", data, 76) == (0.25, -1.5, 0.0)
    assert struct.unpack_from("<3f", data, 208) == (-3.75, 1.5, 11.0)
    assert struct.unpack_from("<h", data, 220) == (315,)
    assert struct.unpack_from("<h", data, 242) == (-50,)


@given(gaits, st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_command_round_trip(gait: Gait, seen: int, sequence: int) -> None:
    (frame,) = AlphaDecoder().feed(alpha.encode_walk(Walk(seen, gait), sequence))
    assert frame.sequence == sequence
    assert alpha.decode_walk(frame) == Walk(seen, gait)


@given(st.floats(-0.5, 0.5), st.floats(-0.2, 0.2), st.floats(-1, 1))
def test_velocity_round_trip_to_a_millionth(x: float, y: float, turn: float) -> None:
    (frame,) = AlphaDecoder().feed(alpha.encode_walk(Walk(0, WALKER.to_gait(Twist(x, y, turn))), 1))
    command = alpha.decode_walk(frame)
    assert command
    assert WALKER.to_body(command.gait) == pytest.approx((x, y, turn), abs=1e-6)


@pytest.mark.parametrize(
    ("limits", "valid"),
    [
        ({"height": 0.33, "turn": 0.6, "frequency": 5.0, "duty": 0.9}, True),
        ({"height": 0.2, "turn": -0.6, "frequency": 1.0, "duty": 0.5}, True),
        ({"stride_x": 0.15, "stride_y": -0.2}, True),
        ({"height": 0.33001}, False),
        ({"turn": 0.60001}, False),
        ({"stride_x": 0.25001}, False),
    ],
)
def test_limits_are_valid_although_the_wire_rounds_them(
    limits: dict[str, float], valid: bool
) -> None:
    gait = WALKER.to_gait(Twist(0.0, 0.0, 0.0))._replace(**limits)
    (frame,) = AlphaDecoder().feed(alpha.encode_walk(Walk(1000, gait), 2))
    walk = alpha.decode_walk(frame)
    assert walk
    assert is_valid_gait(walk.gait) == valid


def test_state_round_trip() -> None:
    (frame,) = AlphaDecoder().feed(alpha.encode_state(a_state(), 9))
    assert alpha.decode_state(frame) == a_state()


@given(st.lists(st.integers(1, 60), max_size=40))
def test_frames_are_found_in_pieces_of_any_size(cuts: list[int]) -> None:
    stream = (
        alpha.encode_stop(1)
        + alpha.encode_walk(Walk(0, FORWARD), 2)
        + alpha.encode_state(a_state(), 3)
    )
    decoder, found = AlphaDecoder(), list[AlphaFrame]()
    for cut in cuts:
        found += decoder.feed(stream[:cut])
        stream = stream[cut:]
    found += decoder.feed(stream)
    assert [frame.sequence for frame in found] == [1, 2, 3]
    assert decoder.errors == 0


@given(st.binary(max_size=400))
def test_the_decoder_never_raises_and_keeps_at_most_one_frame(noise: bytes) -> None:
    decoder = AlphaDecoder()
    decoder.feed(noise)
    decoder.feed(b"\x00" * 300)
    assert [frame.sequence for frame in decoder.feed(STOP_1)] == [1]
    assert len(decoder._buffer) <= 248


@given(st.binary(min_size=44, max_size=44))
def test_decoding_a_command_never_raises(payload: bytes) -> None:
    command = alpha.decode_walk(AlphaFrame(alpha.WALK, 1, payload))
    assert command is None or all(map(math.isfinite, command.gait.phases))


@given(st.binary(min_size=234, max_size=234))
def test_decoding_a_state_never_raises(payload: bytes) -> None:
    state = alpha.decode_state(AlphaFrame(alpha.STATE, 1, payload))
    assert state is None or 0.99 < math.hypot(*state.senses.orientation) < 1.01


def test_a_damaged_frame_loses_no_other_frame() -> None:
    broken = bytearray(WALK_2)
    broken[20] ^= 1
    decoder = AlphaDecoder()
    assert [f.sequence for f in decoder.feed(STOP_1 + bytes(broken) + STOP_1)] == [1, 1]
    assert decoder.errors == 1


def test_a_length_that_does_not_fit_the_type_is_refused_at_once() -> None:
    wrong = bytearray(WALK_2)
    wrong[2:4] = b"\xff\xff"
    assert [f.sequence for f in AlphaDecoder().feed(bytes(wrong) + STOP_1)] == [1]


def test_a_frame_of_another_version_is_refused() -> None:
    other = bytearray(STOP_1[:-4])
    other[5] = 2
    assert AlphaDecoder().feed(bytes(other) + struct.pack("<I", zlib.crc32(other))) == []


def test_commands_and_states_with_nan_or_infinity_are_refused() -> None:
    walk = alpha.encode_walk(Walk(0, FORWARD._replace(turn=math.nan)), 1)
    assert alpha.decode_walk(AlphaDecoder().feed(walk)[0]) is None
    state = alpha.encode_state(a_state(voltage=math.inf), 1)
    assert alpha.decode_state(AlphaDecoder().feed(state)[0]) is None


def test_sequences_and_times_wrap() -> None:
    assert alpha.is_newer(2, 1)
    assert alpha.is_newer(3, 2**32 - 1)
    assert not alpha.is_newer(1, 1)
    assert not alpha.is_newer(2**32 - 1, 3)
    assert not alpha.is_stale(2**32 - 50, 100)
    assert alpha.is_stale(2**32 - 50, 101)
    assert alpha.is_stale(100, 99)  # in the future: before a restart of the firmware


@pytest.mark.parametrize(("rate", "min_share"), [(0.001, 0.9), (0.05, 0.03)])
def test_byte_errors_never_change_a_command(rate: float, min_share: float) -> None:
    noise, count = random.Random(1), 20_000
    decoder, right = AlphaDecoder(), 0
    for sequence in range(count):
        gait = FORWARD._replace(stride_x=struct.unpack("<f", struct.pack("<f", sequence))[0])
        data = bytearray(alpha.encode_walk(Walk(sequence, gait), sequence))
        for place in range(len(data)):
            if noise.random() < rate:
                data[place] ^= noise.randint(1, 255)
        for frame in decoder.feed(bytes(data)):
            command = alpha.decode_walk(frame)
            assert command
            assert frame.sequence == command.seen == command.gait.stride_x
            right += 1
    assert right > min_share * count


@pytest.mark.parametrize("wrong", ["nowhere", "host:", ":8080", "host:99999", "host:80a"])
def test_an_invalid_address_is_refused(wrong: str) -> None:
    with pytest.raises(ConfigError, match="expected HOST:PORT"):
        address(wrong)


def test_addresses() -> None:
    assert address("192.168.1.10:8080") == ("192.168.1.10", 8080)
    assert address("[::1]:80\n") == ("::1", 80)
