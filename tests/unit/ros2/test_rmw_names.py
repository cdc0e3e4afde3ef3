"""Keys, tokens and attachments of rmw_zenoh, compared with values from its source code."""

import struct

import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.ros2.qos import Qos
from gigabrain_zenoh.ros2.rmw_names import (
    Attachment,
    NodeName,
    gid_of,
    parse_attachment,
    parse_qos,
    parse_token,
    qos_text,
    topic_key,
)
from gigabrain_zenoh.ros2.transport import GraphEndpoint

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
NODE = NodeName(0, "aabbccddeeff00112233445566778899", "/", "talker")
TOKEN = (
    "@ros2_lv/0/aabbccddeeff00112233445566778899/0/1/MP/%/%/talker/%chatter/"
    f"std_msgs::msg::dds_::String_/{HASH}/::,7:,:,:,,"
)
GID = bytes.fromhex("08c81ed95e4d6afbe8905ae04ab9bf58")


def test_a_topics_key_has_domain_name_type_and_hash() -> None:
    key = topic_key(3, "/robot1/chatter", "std_msgs/msg/String", HASH)
    assert key == f"3/robot1/chatter/std_msgs::msg::dds_::String_/{HASH}"


def test_a_publishers_token_equals_that_of_the_ros_talker() -> None:
    token = NODE.endpoint_token(
        1, "publisher", "/chatter", "std_msgs/msg/String", HASH, Qos(depth=7)
    )
    assert token == TOKEN
    assert gid_of(token) == GID


def test_a_node_in_a_namespace_has_its_slashes_replaced() -> None:
    node = NodeName(5, "ab", "/fleet/robot1", "gigabrain")
    assert node.token == "@ros2_lv/5/ab/0/0/NN/%/%fleet%robot1/gigabrain"
    assert parse_token(node.token, "") == "/fleet/robot1/gigabrain"


def test_a_token_is_parsed_into_its_endpoint() -> None:
    endpoint = parse_token(TOKEN, "ab")
    assert endpoint == GraphEndpoint(
        "/talker", "publisher", "/chatter", "std_msgs/msg/String", HASH, Qos(depth=7), False
    )


def test_a_token_of_humble_has_no_hash() -> None:
    endpoint = parse_token(TOKEN.replace(HASH, "TypeHashNotSupported"), NODE.zid)
    assert isinstance(endpoint, GraphEndpoint)
    assert (endpoint.hash, endpoint.ours) == ("", True)


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Qos(depth=42), "::,:,:,:,,"),
        (Qos(depth=7), "::,7:,:,:,,"),
        (Qos(reliable=False, depth=5), "2::,5:,:,:,,"),
        (Qos(transient_local=True, depth=1), ":1:,1:,:,:,,"),
    ],
)
def test_the_qos_text_omits_default_values(qos: Qos, text: str) -> None:
    assert qos_text(qos) == text
    assert parse_qos(text) == qos


def test_the_depth_of_a_parsed_qos_is_limited() -> None:
    assert parse_qos("1:2:2,0:1,2:,:,,") == Qos(depth=1)
    assert parse_qos("::,99999999:,:,:,,").depth == 1000


@pytest.mark.parametrize(
    "key",
    [
        "",
        "0/chatter",
        "@ros2_lv/0/ab/0/0/NN/%/%",
        "@ros2_lv/0//0/0/NN/%/%/talker",
        "@ros2_lv/0/ab/0/1/XX/%/%/talker/a/b/c/::,:,:,:,,",
        "@ros2_lv/0/ab/0/1/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/x/::",
        "@ros2_lv/0/ab/0/1/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/x/::,x:,:,:,,",
        "@ros2_lv/0/ab/0/1/MP/%/%/talker/%chatter",
    ],
)
def test_a_malformed_token_is_rejected(key: str) -> None:
    with pytest.raises(ValueError, match=r"token|QoS|invalid literal"):
        parse_token(key, "")


def test_an_attachment_has_the_33_bytes_of_the_source_code() -> None:
    data = Attachment(1, 1_700_000_000_000_000_000, GID).to_bytes()
    assert data.hex() == "010000000000000000002a36fe9c971710" + GID.hex()
    assert parse_attachment(data) == Attachment(1, 1_700_000_000_000_000_000, GID)


def test_the_long_form_of_77_bytes_is_parsed_and_answered_in_the_same_form() -> None:
    data = (
        b"\x0fsequence_number"
        + struct.pack("<q", 9)
        + b"\x10source_timestamp"
        + struct.pack("<q", 17)
        + b"\x0asource_gid\x10"
        + GID
    )
    attachment = parse_attachment(data)
    assert (len(data), attachment) == (77, Attachment(9, 17, GID, named=True))
    answered = attachment.answered().to_bytes()
    assert (len(answered), answered[:24], answered[49:]) == (77, data[:24], data[49:])


@pytest.mark.parametrize("data", [b"", bytes(33), bytes(32), bytes(77), bytes(1000)])
def test_a_malformed_attachment_is_rejected(data: bytes) -> None:
    with pytest.raises(ValueError, match="expected 33 or 77"):
        parse_attachment(data)


@pytest.mark.parametrize("type", ["String", "std_msgs/String", "std_msgs/msg/a b", "../msg/X", ""])
def test_a_type_with_an_invalid_name_is_rejected(type: str) -> None:
    with pytest.raises(ConfigError, match="std_msgs/msg/String"):
        topic_key(0, "/a", type, HASH)
