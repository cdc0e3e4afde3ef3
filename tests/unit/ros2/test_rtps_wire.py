"""RTPS messages, compared with bytes from the specification and from Fast DDS 2.14.5.

The latter were captured between an rclpy client and server of ROS 2 Jazzy.
"""

import pytest

from gigabrain_zenoh.ros2.rtps_wire import (
    DISPOSED,
    AckNack,
    BadMessage,
    Data,
    DataFragments,
    Gap,
    Heartbeat,
    HeartbeatFragments,
    NackFragments,
    Sample,
    decode_message,
    decode_parameters,
    encode_message,
    encode_parameters,
)

READER, WRITER = bytes.fromhex("00001304"), bytes.fromhex("00001403")
CLIENT, SERVER = (
    bytes.fromhex("010f78fd8b2cd52400000000"),
    bytes.fromhex("010f78fd2e2c130400000000"),
)

FAST_DDS_REQUEST = bytes.fromhex(
    "525450530202010f010f78fd8b2cd524000000000e010c00010f78fd2e2c1304000000000901"
    "08003b0e086b226a04a515075800000010000000130400001403000000000a00000083001800"
    "010f78fd8b2cd5240000000000001304ffffffff000000000f801800010f78fd8b2cd5240000"
    "000000001304ffffffff0000000001000000000100000000000007011c000000130400001403"
    "0000000001000000000000000a000000020000008001380001000000256800000000000000000000"
    "000000007f0000013b0e086bda0606a50f00000000000000640a0000000000000000000000000000"
)
FAST_DDS_REPLY = bytes.fromhex(
    "525450530202010f010f78fd2e2c1304000000000e010c00010f78fd8b2cd524000000000901"
    "08003b0e086bc66ddea615076800000010000000130400001403000000001200000083001800"
    "010f78fd8b2cd524000000000000130400000000120000000f801800010f78fd8b2cd5240000"
    "0000000013040000000012000000010000000001000000000000"
    "0b000000736169642046616c7365000007011c00000013040000140300000000090000000000"
    "00001200000003000000"
)
FAST_DDS_ACKNACK = bytes.fromhex(
    "525450530202010f010f78fd2e2c1304000000000e010c00010f78fd8b2cd524000000000601"
    "1c00000004c7000004c2000000000100000009000000000080ff06000000"
)


def test_a_request_of_fast_dds_names_the_reader_of_its_reply():
    message = decode_message(FAST_DDS_REQUEST, SERVER)

    assert (message.prefix, message.vendor) == (CLIENT, bytes.fromhex("010f"))
    assert message.submessages == [
        Data(
            reader=READER,
            writer=WRITER,
            seq=10,
            payload=bytes.fromhex("0001000000000000"),
            related=Sample(CLIENT + READER, -(1 << 32)),
        ),
        Heartbeat(READER, WRITER, first=1, last=10, serial=2),
    ]


def test_a_reply_of_fast_dds_names_the_request():
    data, heartbeat = decode_message(FAST_DDS_REPLY, CLIENT).submessages

    assert data.related == Sample(CLIENT + READER, 18)
    assert data.payload == bytes.fromhex("0001000000000000 0b000000 7361696420 46616c7365 00 00")
    assert heartbeat == Heartbeat(READER, WRITER, first=9, last=18, serial=3)


def test_submessages_for_another_participant_are_skipped():
    assert decode_message(FAST_DDS_REQUEST, CLIENT).submessages == []


def test_fast_dds_requests_samples_by_a_bitmap():
    (ack,) = decode_message(FAST_DDS_ACKNACK, CLIENT).submessages

    assert ack.missing == tuple(range(1, 10))
    assert (ack.base, ack.serial, ack.final) == (1, 6, False)


def test_our_reply_has_the_identity_of_the_request_in_both_parameters():
    reply = Data(READER, WRITER, 18, b"\0\1\0\0", Sample(CLIENT + READER, 18))

    datagram = encode_message(SERVER, CLIENT, [reply], 1_700_000_000_500_000_000)

    assert datagram.hex(" ", 4) == (
        "52545053 02030000 010f78fd 2e2c1304 00000000 "  # header
        "0e010c00 010f78fd 8b2cd524 00000000 "  # for that participant
        "09010800 00f15365 00000080 "  # time: seconds, and half of 2^32
        "15075400 00001000 00001304 00001403 00000000 12000000 "
        "83001800 010f78fd 8b2cd524 00000000 00001304 00000000 12000000 "
        "0f801800 010f78fd 8b2cd524 00000000 00001304 00000000 12000000 "
        "01000000 00010000"
    )


def test_submessages_have_the_bytes_of_the_specification():
    a, b = b"\0\0\3\xc7", b"\0\0\3\xc2"

    assert Heartbeat(a, b, 1, 2, 7).encode().hex(" ", 4) == (
        "07011c00 000003c7 000003c2 00000000 01000000 00000000 02000000 07000000"
    )
    assert AckNack(a, b, 5, (5, 7, 37), 9).encode().hex(" ", 4) == (
        "06032000 000003c7 000003c2 00000000 05000000 21000000 000000a0 00000080 09000000"
    )
    assert Gap(a, b, 3, 5, (6,)).encode().hex(" ", 4) == (
        "08012000 000003c7 000003c2 00000000 03000000 00000000 05000000 02000000 00000040"
    )
    assert NackFragments(a, b, 4, (2, 3), 1).encode().hex(" ", 4) == (
        "12012000 000003c7 000003c2 00000000 04000000 02000000 02000000 000000c0 01000000"
    )
    assert DataFragments(a, b, 1, 2, 1, 4, 6, b"xy").encode().hex(" ", 4) == (
        "16012400 00001c00 000003c7 000003c2 00000000 01000000 02000000 01000400 06000000 78790000"
    )


@pytest.mark.parametrize(
    "submessage",
    [
        Data(READER, WRITER, 1 << 40, b"\0\1\0\0abcd", Sample(CLIENT + READER, 1)),
        Data(READER, WRITER, 3, b"\0\3\0\0", None, DISPOSED, CLIENT + READER),
        DataFragments(READER, WRITER, 2, 3, 1, 4, 12, b"abcd", Sample(CLIENT + READER, 2)),
        Heartbeat(READER, WRITER, 4, 3, 9, True),
        AckNack(READER, WRITER, 1, (1, 256), 3, False),
        Gap(READER, WRITER, 1, 100, (101, 300)),
        NackFragments(READER, WRITER, 1, (1, 2, 64), 3),
        HeartbeatFragments(READER, WRITER, 1, 60, 3),
    ],
)
def test_a_submessage_is_decoded_as_it_was_encoded(submessage):
    datagram = encode_message(SERVER, CLIENT, [submessage], 0)

    assert decode_message(datagram, CLIENT).submessages == [submessage]


def test_big_endian_submessages_are_decoded():
    body = READER + WRITER + bytes.fromhex("0000000000000001 0000000000000002 00000005")
    datagram = b"RTPS\2\1\1\x10" + CLIENT + b"\7\0\0\x1c" + body

    (heartbeat,) = decode_message(datagram, SERVER).submessages

    assert heartbeat == Heartbeat(READER, WRITER, 1, 2, 5)


def test_the_last_submessage_may_omit_its_length():
    whole = encode_message(SERVER, b"", [Data(READER, WRITER, 1, b"\0\1\0\0" + bytes(8))], 0)
    at = whole.index(b"\x15\x05")
    open_ended = whole[: at + 2] + b"\0\0" + whole[at + 4 :]

    assert (
        decode_message(open_ended, CLIENT).submessages == decode_message(whole, CLIENT).submessages
    )


def test_submessages_before_a_malformed_one_are_kept():
    good = Heartbeat(READER, WRITER, 1, 2, 1)
    datagram = encode_message(SERVER, b"", [good, good], 0)
    wrong = (
        datagram[:-20] + bytes.fromhex("ffffffff") + datagram[-16:]
    )  # its first sample is below 1

    assert decode_message(wrong, CLIENT).submessages == [good]
    assert decode_message(datagram[:-4], CLIENT).submessages == [good]


def test_submessages_with_another_source_are_ignored():
    source = b"\x0c\1\x14\0" + bytes(4) + b"\2\3\0\0" + CLIENT
    datagram = encode_message(SERVER, b"", [Heartbeat(READER, WRITER, 1, 2, 1)], 0)

    assert decode_message(datagram[:20] + source + datagram[20:], CLIENT).submessages == []


@pytest.mark.parametrize("header", [b"", b"RTPS", b"RTPX\2\3" + bytes(14), b"RTPS\3\0" + bytes(14)])
def test_a_datagram_of_another_protocol_is_rejected(header):
    with pytest.raises(BadMessage):
        decode_message(header, CLIENT)


def test_parameters_are_padded_and_end_with_a_sentinel():
    assert encode_parameters([(0x15, b"\2\3"), (0x70, b"")]).hex(" ", 4) == (
        "15000400 02030000 70000000 01000000"
    )


@pytest.mark.parametrize("data", ["", "15000400", "1500040002030000", "15000c0002030000 01000000"])
def test_a_list_of_parameters_that_ends_early_is_rejected(data):
    with pytest.raises(BadMessage):
        list(decode_parameters("<", bytes.fromhex(data)))
