"""Streams of an RPLIDAR: in pieces, damaged, and with lost bytes."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.lidars.base import SampleBuffer
from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.lidars.rplidar.protocol import Answer, Info, RequestDecoder, RplidarDecoder
from gigabrain_drivers.lidars.rplidar.scan_formats import Dense, Samples, encode_dense, encode_node
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.sensors import LaserScan

LIDAR = Lidar(beams=360, rate_hz=10, range_min=0.1, range_max=8.0)
STANDARD = bytes.fromhex("a55a0500004081")
DENSE = rplidar.descriptor(0x85, 84, endless=True)
INFO = Info(0x18, (1, 29), 7, "0123456789ABCDEF" * 2)


def dense_turns(turns: int) -> bytes:
    """Return a stream with 360 samples per turn, from 1 m at 0 deg to 4.59 m at 359 deg."""
    capsules = [[1000 + 10 * (k * 40 + n) for n in range(40)] for k in range(9)]
    return b"".join(
        encode_dense(40.0 * k, capsules[k], begins=turn + k == 0)
        for turn in range(turns)
        for k in range(9)
    )


def samples(found: list[Answer | Samples]) -> list[tuple[float, float]]:
    points = []
    for item in found:
        assert isinstance(item, Samples)
        points += zip(item.angles, item.distances, strict=True)
    return points


@pytest.mark.long
@given(st.data())
def test_a_dense_stream_decodes_in_pieces_of_any_size(data: st.DataObject) -> None:
    stream, decoder, found = DENSE + dense_turns(2), RplidarDecoder(), list[Answer | Samples]()
    while stream:
        size = data.draw(st.integers(1, 400))
        found += decoder.feed(stream[:size])
        stream = stream[size:]

    assert samples(found) == [
        (float(n % 360), float(1000 + 10 * (n % 360))) for n in range(17 * 40)
    ]
    assert decoder.errors == 0


def test_a_turn_begins_at_the_first_sample_after_zero() -> None:
    dense = Dense()
    mm = [1000] * 40
    dense.decode(encode_dense(350.0, mm, begins=False))
    passing = dense.decode(encode_dense(30.0, mm, begins=False))
    after = dense.decode(encode_dense(70.0, mm, begins=False))

    assert passing is not None
    assert (passing.turn_at, passing.angles[9], passing.angles[10]) == (10, 359.0, 360.0)
    assert after is not None
    assert after.turn_at is None


def test_each_turn_has_its_last_sample_also_if_a_capsule_ends_with_it() -> None:
    dense, turn, scans = Dense(), SampleBuffer(LIDAR), list[LaserScan]()
    for number in range(45):  # 9 capsules make a turn, each at another distance
        distances = [1000 * (1 + number // 9)] * 40
        block = encode_dense(number % 9 * 40.0, distances, begins=number == 0)
        item = dense.decode(block)
        scan = turn.add_samples(*item, number * 11_111_111) if item else None
        scans += [scan] if scan else []
    assert [set(scan.ranges_m.tolist()) for scan in scans] == [{2.0}, {3.0}, {4.0}]


@pytest.mark.parametrize("lost", [84, 83, 1])
def test_bytes_lost_from_a_dense_stream_never_falsify_an_angle(lost: int) -> None:
    stream = DENSE + dense_turns(3)
    cut = len(DENSE) + 84 * 12 + 10
    points = samples(RplidarDecoder().feed(stream[:cut] + stream[cut + lost :]))

    assert all(distance == 1000 + 10 * angle for angle, distance in points)
    assert len(points) >= 40 * 26 - 40 * 5


def test_a_lost_capsule_is_noticed_although_all_checksums_are_right() -> None:
    stream = DENSE + dense_turns(2)
    cut = len(DENSE) + 84 * 5
    decoder = RplidarDecoder()
    points = samples(decoder.feed(stream[:cut] + stream[cut + 84 :]))

    assert all(distance == 1000 + 10 * angle for angle, distance in points)


def standard_turns(turns: int) -> bytes:
    return b"".join(
        encode_node(angle, 1000 + 10 * angle, quality=40, begins=angle == 0)
        for _ in range(turns)
        for angle in range(360)
    )


@given(st.integers(40, 1700), st.integers(1, 60))
def test_a_standard_stream_is_in_step_again_after_lost_bytes(at: int, lost: int) -> None:
    stream = standard_turns(2)
    decoder = RplidarDecoder()
    points = samples(decoder.feed(STANDARD + stream[:at] + stream[at + lost :]))

    assert all(distance == 1000 + 10 * angle for angle, distance in points[: at // 5])
    wrong = sum(distance != 1000 + 10 * angle for angle, distance in points)
    assert wrong <= 2  # the cut node may be accepted, as it has no checksum
    assert len(points) >= 700 - lost // 5


def test_a_turn_ends_although_the_first_node_of_the_next_one_was_lost() -> None:
    stream = standard_turns(3)
    found = RplidarDecoder().feed(STANDARD + stream[: 360 * 5] + stream[361 * 5 :])
    begins = [n for n, item in enumerate(found) if isinstance(item, Samples) and item.turn_at == 0]

    assert begins == [0, 400, 719]  # after 400 degrees in the turn without a first node


@given(st.binary(max_size=200))
def test_a_descriptor_is_found_after_any_noise(noise: bytes) -> None:
    decoder = RplidarDecoder()
    decoder.feed(noise)
    decoder.clear()

    assert decoder.feed(b"RP LIDAR System.\r\n" + rplidar.answer(rplidar.INFO, INFO.pack())) == [
        Answer(rplidar.INFO, INFO.pack())
    ]


@given(st.lists(st.binary(max_size=100), max_size=40), st.sampled_from([b"", STANDARD, DENSE]))
def test_decoders_keep_a_bounded_number_of_bytes_and_never_raise(
    pieces: list[bytes], first: bytes
) -> None:
    decoder, requests = RplidarDecoder(), RequestDecoder()
    decoder.feed(first)
    for piece in pieces:
        decoder.feed(piece)
        requests.feed(piece)
        assert len(decoder._buffer) < 200
        assert len(requests._buffer) < 260


def test_a_capsule_with_one_wrong_byte_is_refused() -> None:
    good = encode_dense(40.0, range(1000, 1400, 10), begins=False)
    for at in range(84):
        for pattern in (1, 0x80, 0x55, 0xFF):
            bad = bytearray(good)
            bad[at] ^= pattern
            assert not Dense().is_block(bytes(bad)), (at, pattern)


@pytest.mark.long
def test_with_a_tenth_of_a_percent_of_bytes_wrong_almost_no_dense_sample_is_decoded_wrong() -> None:
    chance = random.Random(5)
    stream = bytearray(dense_turns(400))
    for at in range(len(stream)):
        if chance.random() < 0.001:
            stream[at] ^= chance.randrange(1, 256)
    points = samples(RplidarDecoder().feed(DENSE + bytes(stream)))
    wrong = sum(abs(distance - 1000 - 10 * (angle % 360)) > 1 for angle, distance in points)

    assert len(points) > 0.8 * 144_000
    assert wrong <= 80  # two capsules; two errors that cancel in the XOR are not noticed
