"""Discovery data of participants and endpoints, compared with bytes of Fast DDS 2.14.5."""

import pytest

from gigabrain_zenoh.ros2.rtps_discovery import (
    EndpointData,
    ParticipantData,
    choose_address,
    decode_endpoint,
    decode_participant,
    multicast_port,
    participant_ports,
    service_topics,
    service_types,
)
from gigabrain_zenoh.ros2.rtps_wire import BadMessage

PREFIX = bytes.fromhex("010f78fd2e2c130400000000")
FAST_DDS_PARTICIPANT = bytes.fromhex(  # on a host with the address 192.0.2.2
    "0003000015000400020200001600040001 0f000050001000010f78fd2e2c1304000000000000"
    "01c107800400010000003200180001000000246800000000000000000000000000"
    "00c00002023100180001000000256800000000000000000000"
    "00000000c00002020200080014000000000000005800040"
    "03f0c00006200080002000000"
    "2f0000002c0010000b000000656e636c6176653d2f3b000001000000".replace(" ", "")
)
FAST_DDS_READER = bytes.fromhex(
    "000300005a001000010f78fd2e2c1304000000000000130407800400010000002f0018000100"
    "000025680000000000000000000000000000c00002024300040000000000"
    "50001000010f78fd2e2c130400000000000001c1050014001000000072712f6573746f705265"
    "7175657374000700"
    "2c00260000007374645f737276733a3a7372763a3a6464735f3a3a536574426f6f6c5f526571"
    "756573745f000000"
    "70001000010f78fd2e2c13040000000000001304150004000202000016000400010f00001d00"
    "0400000000001a000c00"
    "02000000000000009a999919730008000100000000000000740008000100010100000000"
    "01000000"
)


def test_a_participant_of_fast_dds_is_decoded():
    data = decode_participant(FAST_DDS_PARTICIPANT, bytes.fromhex("010f"))

    assert data.prefix == PREFIX
    assert data.builtin == (("192.0.2.2", 26660),)
    assert data.user == (("192.0.2.2", 26661),)
    assert (data.lease_s, data.endpoints) == (20.0, 0xC3F)


def test_an_endpoint_of_fast_dds_is_decoded():
    assert decode_endpoint(FAST_DDS_READER) == EndpointData(
        guid=PREFIX + bytes.fromhex("00001304"),
        topic="rq/estopRequest",
        type="std_srvs::srv::dds_::SetBool_Request_",
        locators=(("192.0.2.2", 26661),),
    )


def test_our_participant_announces_its_enclave_as_in_ros():
    data = ParticipantData(PREFIX, (("10.0.0.1", 7410),), (("10.0.0.1", 7411),))

    payload = data.encode()

    assert bytes.fromhex("2c0010000b000000656e636c6176653d2f3b0000") in payload
    assert bytes.fromhex("3200180001000000f21c0000 000000000000000000000000 0a000001") in payload
    assert decode_participant(payload, bytes(2)) == data


def test_our_endpoint_announces_its_type_hash_as_in_ros():
    data = EndpointData(PREFIX + b"\0\0\1\4", "rq/aRequest", "a::srv::dds_::B_Request_")

    payload = data._replace(type_hash="RIHS01_00").encode()

    assert bytes.fromhex("2c00180013000000") + b"typehash=RIHS01_00;\0" in payload
    assert decode_endpoint(payload) == data


def test_a_key_names_the_participant_or_endpoint_that_ended():
    participant = ParticipantData(PREFIX, (), ())
    endpoint = EndpointData(PREFIX + b"\0\0\1\3", "a", "b")

    assert decode_participant(participant.encode_key(), bytes(2)).prefix == PREFIX
    assert decode_endpoint(endpoint.encode_key()).guid == endpoint.guid


def test_ports_are_those_of_the_specification():
    assert multicast_port(0) == 7400
    assert participant_ports(0, 0) == (7410, 7411)
    assert participant_ports(42, 3) == (17916, 17917)


def test_services_have_the_dds_names_of_ros():
    assert service_topics("/robot1/estop") == ("rq/robot1/estopRequest", "rr/robot1/estopReply")
    assert service_types("std_srvs/srv/SetBool") == (
        "std_srvs::srv::dds_::SetBool_Request_",
        "std_srvs::srv::dds_::SetBool_Response_",
    )
    assert service_types("nav2_msgs/action/NavigateToPose_SendGoal") == (
        "nav2_msgs::action::dds_::NavigateToPose_SendGoal_Request_",
        "nav2_msgs::action::dds_::NavigateToPose_SendGoal_Response_",
    )


@pytest.mark.parametrize(
    ("change", "matched"),
    [
        ({}, True),
        ({"topic": "rq/bRequest"}, False),
        ({"type": "other"}, False),
        ({"reliable": False}, False),  # a best-effort writer for a reliable reader
        ({"durability": 1}, True),  # a writer may offer more than is requested
        ({"partitioned": True}, False),
        ({"guid": PREFIX + b"\0\0\1\4"}, False),  # two readers
    ],
)
def test_a_writer_matches_readers_whose_qos_it_satisfies(change, matched):
    reader = EndpointData(PREFIX + b"\0\0\1\4", "rq/aRequest", "T")
    writer = EndpointData(PREFIX + b"\0\0\2\3", "rq/aRequest", "T")._replace(**change)

    assert reader.matches(writer) is writer.matches(reader) is matched


def test_a_transient_local_reader_does_not_match_a_volatile_writer():
    writer = EndpointData(PREFIX + b"\0\0\2\3", "a", "T")

    assert not writer.matches(EndpointData(PREFIX + b"\0\0\1\4", "a", "T", durability=1))


def test_data_go_only_to_the_host_that_announced_them():
    locators = [("192.0.2.9", 7410), ("10.0.0.5", 7410)]
    own = {"127.0.0.1", "192.0.2.2"}

    assert choose_address(locators, "10.0.0.5", own) == ("10.0.0.5", 7410)
    assert choose_address(locators, "10.0.0.6", own) is None
    assert choose_address([("192.0.2.2", 7412)], "127.0.0.1", own) == ("192.0.2.2", 7412)
    assert choose_address(locators, "127.0.0.1", own) is None


@pytest.mark.parametrize("address", ["00000000", "efff0001", "ffffffff"])
def test_multicast_and_zero_addresses_are_not_used(address):
    locator = bytes.fromhex("3200180001000000f21c0000000000000000000000000000" + address)
    payload = FAST_DDS_PARTICIPANT[:-4] + locator + FAST_DDS_PARTICIPANT[-4:]

    assert len(decode_participant(payload, bytes(2)).builtin) == 1


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\0\1\0\0",
        b"\0\3\0\0\1\0\0\0",  # without a GUID
        FAST_DDS_READER[:-4],  # without an end
        FAST_DDS_READER.replace(b"\x10\0\0\0rq", b"\xff\0\0\0rq"),  # a name beyond its parameter
    ],
)
def test_malformed_discovery_data_are_rejected(payload):
    with pytest.raises(BadMessage):
        decode_endpoint(payload)
