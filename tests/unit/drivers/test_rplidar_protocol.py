import pyrplidar_protocol
import pytest
import rplidar as roboticia
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.lidars.rplidar.protocol import (
    Answer,
    Info,
    Request,
    RequestDecoder,
    RplidarDecoder,
)
from gigabrain_drivers.lidars.rplidar.scan_formats import (
    Dense,
    Express,
    Samples,
    Standard,
    encode_dense,
    encode_express,
    encode_node,
)

STANDARD = bytes.fromhex("a55a0500004081")
INFO = Info(0x18, (1, 29), 7, "0123456789ABCDEF" * 2)

distances = st.integers(0, 16_000)
shifts = st.integers(0, 63)


@pytest.mark.parametrize(
    ("encoded", "expected"),
    [
        (rplidar.request(rplidar.STOP), "a5 25"),
        (rplidar.request(rplidar.GET_INFO), "a5 50"),
        (rplidar.express_request(), "a5 82 05 00 00 00 00 00 22"),
        (rplidar.conf_request(rplidar.MODE_TYPICAL), "a5 84 04 7c 00 00 00 59"),
        (rplidar.request(rplidar.SET_PWM, (660).to_bytes(2, "little")), "a5 f0 02 94 02 c1"),
        (rplidar.request(rplidar.GET_BOARD, bytes(4)), "a5 ff 04 00 00 00 00 5e"),
        (rplidar.request(rplidar.SET_SPEED, (600).to_bytes(2, "little")), "a5 a8 02 58 02 55"),
        (rplidar.descriptor(0x81, 5, endless=True), "a5 5a 05 00 00 40 81"),
        (rplidar.descriptor(0x82, 84, endless=True), "a5 5a 54 00 00 40 82"),
        (rplidar.descriptor(rplidar.INFO, 20), "a5 5a 14 00 00 00 04"),
        (rplidar.descriptor(rplidar.HEALTH, 3), "a5 5a 03 00 00 00 06"),
        (encode_node(10.0, 2000.0, quality=15, begins=True), "3d 01 05 40 1f"),
    ],
)
def test_bytes_match_the_vendors_document(encoded: bytes, expected: str) -> None:
    assert encoded == bytes.fromhex(expected)


def test_the_node_in_the_document_decodes_to_its_numbers() -> None:
    assert RplidarDecoder().feed(STANDARD + bytes.fromhex("3d0105401f")) == [
        Samples((10.0,), (2000.0,), 0)
    ]


def test_info_and_health_round_trip_and_match_pyrplidar() -> None:
    health = rplidar.Health(1, 0x0102)
    wire = rplidar.answer(rplidar.INFO, INFO.pack()) + rplidar.answer(rplidar.HEALTH, health.pack())
    first, second = RplidarDecoder().feed(wire)

    assert isinstance(first, Answer)
    assert isinstance(second, Answer)
    assert (Info.read(first.data), rplidar.Health.read(second.data)) == (INFO, health)
    theirs = pyrplidar_protocol.PyRPlidarDeviceInfo(INFO.pack())
    assert (theirs.model, theirs.firmware_major, theirs.firmware_minor) == (0x18, 1, 29)
    assert theirs.serialnumber == INFO.serial


@given(st.integers(0, 0xFF), st.binary(max_size=32))
def test_requests_are_found_in_single_bytes(command: int, data: bytes) -> None:
    payload = data if command >= 0x80 else b""
    decoder = RequestDecoder()
    wire = b"\x00garbage" + rplidar.request(command, payload)
    found = [request for byte in wire for request in decoder.feed(bytes([byte]))]

    assert found == [Request(command, payload)]


def test_a_request_with_a_wrong_checksum_is_dropped_and_the_next_one_is_found() -> None:
    bad = bytearray(rplidar.express_request())
    bad[3] ^= 1
    decoder = RequestDecoder()

    assert decoder.feed(bytes(bad) + rplidar.request(rplidar.STOP)) == [Request(rplidar.STOP)]
    assert decoder.errors == 1


@given(st.floats(0, 359.9), distances, st.booleans(), st.integers(0, 63))
def test_standard_nodes_decode_as_in_two_other_clients(
    angle: float, distance: float, begins: bool, quality: int
) -> None:
    wire = encode_node(angle, distance, quality=quality, begins=begins)
    ours = Standard().decode(wire)
    theirs = pyrplidar_protocol.PyRPlidarMeasurement(wire)

    assert ours == Samples((theirs.angle,), (theirs.distance,), 0 if theirs.start_flag else None)
    assert roboticia._process_scan(wire) == (begins, quality, ours.angles[0], ours.distances[0])
    assert ours.angles[0] == pytest.approx(angle % 360, abs=1 / 64)


@given(
    st.floats(0, 359.9),
    st.floats(0.5, 60),
    st.lists(st.tuples(distances, shifts), min_size=32, max_size=32),
)
def test_express_capsules_decode_as_in_pyrplidar(
    start: float, width: float, points: list[tuple[int, int]]
) -> None:
    mm, q3 = [p[0] for p in points], [p[1] for p in points]
    first = encode_express(start, mm, q3, begins=True)
    second = encode_express(start + width, mm, q3, begins=False)
    express = Express()
    assert express.decode(first) is None
    ours = express.decode(second)
    capsule = pyrplidar_protocol.PyRPlidarScanCapsule
    theirs = capsule._parse_capsule(capsule(first), capsule(second))

    assert ours is not None
    assert list(ours.distances) == [t.dist_mm_q2 / 4 for t in theirs] == mm
    for angle, other in zip(ours.angles, theirs, strict=True):
        assert abs((angle - other.get_angle() + 180) % 360 - 180) < 0.05


def test_express_capsules_decode_as_in_rplidar_roboticia_but_for_its_shifted_angles() -> None:
    """rplidar-roboticia returns the angle of the next sample: a known fault, shifted back here."""
    mm = list(range(1000, 1320, 10))
    first, second = (encode_express(s, mm, begins=False) for s in (40.0, 72.0))
    express = Express()
    express.decode(first)
    ours = express.decode(second)
    packet = roboticia.ExpressPacket.from_string(first)
    theirs = [roboticia._process_express_scan(packet, 72.0, n + 1) for n in range(32)]

    assert ours is not None
    assert [t[3] for t in theirs] == list(ours.distances)
    assert [t[2] for t in theirs] == pytest.approx([a + 1.0 for a in ours.angles])


@given(
    st.floats(0, 359.9),
    st.floats(0.5, 60),
    st.lists(st.integers(0, 0xFFFF), min_size=40, max_size=40),
)
def test_dense_capsules_decode_as_in_pyrplidar_but_for_its_swapped_bytes(
    start: float, width: float, mm: list[int]
) -> None:
    first = encode_dense(start, mm, begins=True)
    second = encode_dense(start + width, mm, begins=False)
    dense = Dense()
    assert dense.decode(first) is None
    ours = dense.decode(second)
    capsule = pyrplidar_protocol.PyRPlidarScanDenseCapsule
    theirs = capsule._parse_capsule(capsule(first), capsule(second))

    assert ours is not None
    assert list(ours.distances) == mm
    swapped = [int.from_bytes((t.dist_mm_q2 >> 2).to_bytes(2, "big"), "little") for t in theirs]
    assert swapped == mm
    for angle, other in zip(ours.angles, theirs, strict=True):
        assert abs((angle - other.get_angle() + 180) % 360 - 180) < 0.05
