import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.lidars.ld import protocol as ld

MANUAL = bytes.fromhex(  # LD19 development manual
    "54 2C 68 08 AB 7E E0 00 E4 DC 00 E2 D9 00 E5 D5 00 E3 D3 00 E4 D0 00 E9 CD 00 E4 CA 00 E2"
    "C7 00 E9 C5 00 E5 C2 00 E5 C0 00 E5 BE 82 3A 1A 50"
)
CAPTURED = bytes.fromhex(  # from a real D200 kit
    "54 2C 74 08 B0 86 00 00 D4 00 00 D4 00 00 D4 00 00 D4 00 00 D4 00 00 D5 00 00 D5 00 00 49"
    "00 00 5F 00 00 B0 00 00 D2 00 00 D4 02 89 1E 09 1F"
)


def frames(draw: st.DrawFn) -> ld.LdFrame:
    speed = draw(st.integers(360, 0xFFFF))
    start = draw(st.integers(0, 35_999))
    width = draw(st.integers(0, min(35_999, speed * 12 * 100 // 2300)))
    points = draw(st.binary(min_size=36, max_size=36))
    return ld.LdFrame(
        speed,
        start,
        (start + width) % 36_000,
        struct.unpack("<12H", points[:24]),
        tuple(points[24:]),
        draw(st.integers(0, 29_999)),
    )


any_frame = st.composite(frames)()


def test_crc8_matches_the_vendors_table() -> None:
    assert [ld.crc8(bytes([n])) for n in (1, 2, 3)] == [0x4D, 0x9A, 0xD7]


def test_the_frame_in_the_manual_decodes_to_its_numbers() -> None:
    frame = ld.decode(MANUAL)

    assert frame is not None
    assert frame.speed == 2152
    assert (frame.start, frame.end) == (32427, 33470)
    assert frame.distances == (224, 220, 217, 213, 211, 208, 205, 202, 199, 197, 194, 192)
    assert frame.confidences == (228, 226, 229, 227, 228, 233, 228, 226, 233, 229, 229, 229)
    assert frame.time_ms == 6714
    assert frame.angles()[0] == 324.27
    assert frame.angles()[11] == pytest.approx(334.70, abs=1e-9)
    assert ld.encode(frame) == MANUAL


def test_a_captured_frame_without_returns_decodes() -> None:
    frame = ld.decode(CAPTURED)

    assert frame is not None
    assert (frame.speed, frame.start, frame.end, frame.time_ms) == (2164, 34480, 35074, 2334)
    assert frame.distances == (0,) * 12
    assert frame.confidences == (212, 212, 212, 212, 212, 213, 213, 73, 95, 176, 210, 212)


def test_angles_continue_above_360_degrees() -> None:
    frame = ld.LdFrame(3600, 35_800, 13, (0,) * 12, (0,) * 12, 0)

    assert frame.angles()[0] == 358.0
    assert frame.angles()[11] == pytest.approx(360.13, abs=1e-9)


@given(any_frame)
def test_frame_round_trip(frame: ld.LdFrame) -> None:
    assert ld.LdDecoder().feed(ld.encode(frame)) == [frame]


@pytest.mark.parametrize("good", [MANUAL, CAPTURED])
def test_a_frame_with_one_damaged_byte_is_refused(good: bytes) -> None:
    for at in range(47):
        for pattern in range(1, 256):
            damaged = bytearray(good)
            damaged[at] ^= pattern
            assert ld.decode(bytes(damaged)) is None, (at, pattern)


@given(any_frame, st.integers(0, 47 * 8 - 1))
def test_any_frame_with_one_flipped_bit_is_refused(frame: ld.LdFrame, bit: int) -> None:
    damaged = bytearray(ld.encode(frame))
    damaged[bit // 8] ^= 1 << bit % 8

    assert ld.decode(bytes(damaged)) is None


@given(any_frame, st.sets(st.integers(0, 47 * 8 - 1), min_size=2, max_size=2))
def test_two_flipped_bits_are_accepted_only_if_they_are_255_bits_apart(
    frame: ld.LdFrame, bits: set[int]
) -> None:
    damaged = bytearray(ld.encode(frame))
    for bit in bits:
        damaged[bit // 8] ^= 0x80 >> bit % 8

    assert ld.decode(bytes(damaged)) is None or max(bits) - min(bits) == 255


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("start", 36_000),  # beyond a turn
        ("end", 36_000),
        ("end", 32_427 - 1),  # almost a full turn in one frame
        ("speed", 0),  # different angles without rotation
    ],
)
def test_a_frame_with_impossible_values_is_refused_although_its_crc_is_right(
    field: str, value: int
) -> None:
    frame = ld.decode(MANUAL)
    assert frame is not None

    assert ld.decode(ld.encode(frame._replace(**{field: value}))) is None


@pytest.mark.long
@given(st.lists(st.sampled_from([MANUAL, CAPTURED]), max_size=6), st.data())
def test_frames_are_found_in_pieces_of_any_size(parts: list[bytes], data: st.DataObject) -> None:
    stream, decoder, found = b"".join(parts), ld.LdDecoder(), []
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        found += decoder.feed(stream[:size])
        stream = stream[size:]

    assert found == [ld.decode(part) for part in parts]
    assert decoder.errors == 0


@given(st.binary(max_size=300))
def test_the_second_frame_after_any_noise_is_found_at_the_latest(noise: bytes) -> None:
    decoder = ld.LdDecoder()
    decoder.feed(noise)

    assert ld.decode(MANUAL) in decoder.feed(MANUAL + MANUAL)


@given(st.lists(st.binary(max_size=100), max_size=50))
def test_the_decoder_keeps_less_than_one_frame(pieces: list[bytes]) -> None:
    decoder = ld.LdDecoder()
    for piece in pieces:
        decoder.feed(piece)
        assert len(decoder._buffer) < 47


def test_bytes_before_the_first_frame_are_no_error_but_later_ones_are() -> None:
    decoder = ld.LdDecoder()

    assert len(decoder.feed(MANUAL[20:] + MANUAL)) == 1
    assert decoder.errors == 0
    assert len(decoder.feed(b"\x00" + MANUAL[:30] + MANUAL)) == 1
    assert decoder.errors == 2  # the stray byte, and the half frame


def test_a_lidar_that_sends_ec_instead_of_2c_is_supported() -> None:
    other = bytes([0x54, 0xEC]) + MANUAL[2:46]

    assert ld.decode(other + bytes([ld.crc8(other)])) == ld.decode(MANUAL)


@pytest.mark.long
def test_with_a_tenth_of_a_percent_of_bytes_wrong_almost_no_frame_is_decoded_wrong() -> None:
    chance = random.Random(3)
    decoder, sent, wrong, right = ld.LdDecoder(), ld.decode(MANUAL), 0, 0
    for _ in range(50):
        stream = bytearray(MANUAL * 400)
        for at in range(len(stream)):
            if chance.random() < 0.001:
                stream[at] ^= chance.randrange(1, 256)
        for frame in decoder.feed(bytes(stream)):
            right += frame == sent
            wrong += frame != sent

    assert wrong <= 3  # 7e-6 of all frames: 0.14 of these 20 000
    assert 18_900 <= right <= 19_250  # of 20 000; (1 - 0.001)^47 = 95.4 %
