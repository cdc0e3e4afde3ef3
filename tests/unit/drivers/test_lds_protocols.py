"""The protocols of LDS-01 and LDS-03, the lidars of TurtleBot3: packets, cut streams, noise."""

from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.lidars.lds import lds01, lds03

LDS01 = (
    "fa a0 b8 0b 01 00 e8 03 00 00 02 00 e9 03 00 00 03 00 ea 03 00 00 "
    "04 00 eb 03 00 00 05 00 00 00 00 00 06 00 ac 0d 00 00"
)
LDS03 = "aa 55 15 02 01 05 81 05 af 57 90 a1 0f 68 c9 0f"

samples = st.integers(0, 0xFFFF)
packets01 = st.builds(
    lds01.Lds01Packet,
    number=st.integers(0, 59),
    rpm=st.integers(0, 6000).map(lambda tenths: tenths / 10),
    intensities=st.tuples(*[samples] * 6),
    ranges=st.tuples(*[samples] * 6),
)
samples03 = st.builds(
    lds03.Lds03Sample,
    angle=st.just(0.0),
    distance=st.integers(0, 0x3FFF),
    quality=st.integers(0, 255),
    reflective=st.booleans(),
)


def turn01(begin: int = 0, count: int = 60) -> list[lds01.Lds01Packet]:
    return [
        lds01.Lds01Packet((begin + n) % 60, 300.0, (7,) * 6, tuple(range(1000, 1006)))
        for n in range(count)
    ]


def test_an_lds01_packet_has_six_samples() -> None:
    first = bytes.fromhex(LDS01) + b"??"  # its checksum is not documented
    decoder = lds01.Lds01Decoder()
    assert decoder.feed(first) == []
    assert decoder.feed(b"\xfa\xa1") == [
        lds01.Lds01Packet(0, 300.0, (1, 2, 3, 4, 5, 6), (1000, 1001, 1002, 1003, 0, 3500))
    ]
    assert decoder.errors == 0


def test_lds01_commands_are_letters() -> None:
    assert (lds01.START, lds01.STOP) == (b"b", b"e")


@given(packets01)
def test_lds01_packet_round_trip(packet: lds01.Lds01Packet) -> None:
    following = bytes([0xFA, 0xA0 + (packet.number + 1) % 60])
    assert lds01.Lds01Decoder().feed(lds01.encode(packet) + following) == [packet]


@given(st.integers(0, 59), st.integers(1, 100))
def test_lds01_packets_are_found_in_pieces_of_any_size(begin: int, size: int) -> None:
    sent = turn01(begin, 61)
    stream = b"".join(map(lds01.encode, sent))
    decoder, found = lds01.Lds01Decoder(), []
    for at in range(0, len(stream), size):
        found += decoder.feed(stream[at : at + size])
    assert found == sent[:-1]
    assert decoder.errors == 0


@given(st.binary(max_size=300))
def test_lds01_packets_are_found_after_any_noise(noise: bytes) -> None:
    sent = turn01(5, 20)
    decoder = lds01.Lds01Decoder()
    decoder.feed(noise)
    found = decoder.feed(b"".join(map(lds01.encode, sent)))
    assert found[-17:] == sent[2:-1]


def test_an_lds01_packet_with_missing_bytes_is_dropped() -> None:
    frames = [lds01.encode(packet) for packet in turn01(0, 4)]
    frames[1] = frames[1][:-3]
    decoder = lds01.Lds01Decoder()
    assert [packet.number for packet in decoder.feed(b"".join(frames))] == [0, 2]
    assert decoder.errors == 1


def test_noise_does_not_fill_the_decoders() -> None:
    decoder01, decoder03 = lds01.Lds01Decoder(), lds03.Lds03Decoder()
    for _ in range(20):
        decoder01.feed(b"\xfa\xa0" * 2000)
        decoder03.feed(b"\xaa\x55\x00\xff\x01\x00\x01" * 500)
    assert len(decoder01._buffer) < 50
    assert len(decoder03._buffer) < 800


def test_lds03_commands_are_those_of_the_vendor() -> None:
    assert lds03.START.hex(" ") == "aa 55 f0 0f"
    assert lds03.STOP.hex(" ") == "aa 55 f5 0a"
    assert lds03.command(0xFC).hex(" ") == "aa 55 fc 03"


def test_an_lds03_packet_has_its_angles() -> None:
    decoder = lds03.Lds03Decoder()
    expected = lds03.Lds03Packet(
        begins=True,
        rate=1.0,
        samples=(
            lds03.Lds03Sample(10.0, 1000, 100, False),
            lds03.Lds03Sample(11.0, 1010, 90, False),
        ),
    )
    assert decoder.feed(bytes.fromhex(LDS03)) == [expected]
    assert lds03.encode(expected).hex(" ") == LDS03


def test_lds03_angles_wrap_at_zero() -> None:
    first, last = (lds03.Lds03Sample(angle, 500, 50, False) for angle in (359.0, 1.0))
    sent = (first, lds03.Lds03Sample(0.0, 500, 50, False), last)
    (packet,) = lds03.Lds03Decoder().feed(lds03.encode(lds03.Lds03Packet(False, 0.0, sent)))
    assert [sample.angle for sample in packet.samples] == [359.0, 0.0, 1.0]


@given(st.lists(samples03, min_size=1, max_size=255), st.booleans())
def test_lds03_samples_round_trip(many: list[lds03.Lds03Sample], begins: bool) -> None:
    packet = lds03.Lds03Packet(begins, 10.0 if begins else 0.0, tuple(many))
    assert lds03.Lds03Decoder().feed(lds03.encode(packet)) == [packet]


@given(st.binary(max_size=200), st.integers(1, 30))
def test_lds03_packets_are_found_after_any_noise(noise: bytes, size: int) -> None:
    packet = lds03.Lds03Packet(True, 10.0, (lds03.Lds03Sample(0.0, 1234, 56, False),) * 20)
    stream = noise + bytes(1000) + lds03.encode(packet)
    decoder, found = lds03.Lds03Decoder(), []
    for at in range(0, len(stream), size):
        found += decoder.feed(stream[at : at + size])
    assert found[-1:] == [packet]


def test_lds03_packets_with_one_flipped_bit_are_refused() -> None:
    for bit in range(16 * 8):
        frame = bytearray.fromhex(LDS03)
        frame[bit // 8] ^= 1 << bit % 8
        assert lds03.Lds03Decoder().feed(bytes(frame)) == []
