import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.topics import MAP, SIM_SCENE, TOPICS, Topic
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.qa.faults.hostile import leaves, replaced
from tests.unit.schemas.plain import as_map, at, codec, dotted, maps, numbers, refuses

# numbers that may be null: not measured, no obstacle, no limit, any yaw, no clock
NULLABLE = {
    "Body.description.max_rim_speed", "RobotState.link.late_ms",
    "Body.description.joints.0.follow", "Body.description.joints.1.follow",
    "Body.description.arm.floor", "SafetyState.joints.0.rise", "SafetyState.joints.0.fall",
    "RobotState.joints.0.effort", "RobotState.joints.0.temperature",
    "RobotState.joints.0.current", "RobotState.joints.1.current",
    "RobotState.joints.1.effort", "RobotState.joints.1.temperature",
    "WorldModel.distance_ahead",
    *(f"WorldModel.sectors.{index}" for index in (0, 1, 2, 4, 5)),
    "SafetyState.caps.forward", "SafetyState.caps.backward", "SafetyState.caps.left",
    "SafetyState.caps.right", "SafetyState.caps.rotation",
    "SafetyState.caps.turn_left", "SafetyState.caps.turn_right",
    "GoalRequest.yaw", "PoseRequest.yaw", "Zones.places.0.yaw",
    "TaskStatus.distance_remaining", "TaskStatus.eta", "TaskStatus.goal.yaw",
    "TaskStatus.done.0.position_error", "TaskStatus.done.0.heading_error",
    "Description.report.distance_m", "Description.report.contacts",
    "Detections.tags.0.yaw_in_map",
}  # fmt: skip
MAY_BE_EMPTY = {
    "EstopRequest", "DescribeRequest", "AuditRequest", "AuditPage", "ParamRequest", "SimRequest",
    "TaskStatus", "Zones", "MapListRequest", "MapListReply", "ObjectMap",
    "Solids", "ArmPlan",
}  # fmt: skip
NEEDS_ONE = {"GoalRequest", "ZonesRequest", "ObjectsRequest"}  # one of several fields is required
REPORT = ("Description.report.distance_m", "Description.report.contacts")  # may also be texts

# maps whose keys are free, such as rates by key
FREE = {"rejected", "received_hz", "sent_hz", "latency_ms", "counters", "data", "report"}

by_name = pytest.mark.parametrize("name", sorted(EXAMPLES))


@by_name
def test_unknown_fields_are_refused_at_every_depth(name: str) -> None:
    whole = as_map(name)
    for path in maps(whole):
        if path and path[-1] in FREE:
            continue
        bad = replaced(whole, path, {**at(whole, path), "linear_xx": 1.0})
        assert refuses(name, msgspec.msgpack.encode(bad)), path
        assert refuses(name, msgspec.json.encode(bad)), path


@by_name
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, True, False, "0.3", None])
def test_every_number_field_refuses_values_that_are_not_finite_numbers(name: str, bad: Any) -> None:
    for path in numbers(name):
        where = dotted(name, path)
        if (bad is None and where in NULLABLE) or (isinstance(bad, str) and where in REPORT):
            continue
        payload = msgspec.msgpack.encode(replaced(as_map(name), path, bad))
        assert refuses(name, payload), where


def test_null_is_accepted_only_where_it_has_a_meaning() -> None:
    nullable = {
        dotted(name, path)
        for name in EXAMPLES
        for path in numbers(name)
        if not refuses(name, msgspec.msgpack.encode(replaced(as_map(name), path, None)))
    }
    assert nullable == NULLABLE


@by_name
def test_huge_numbers_are_refused(name: str) -> None:
    for path in numbers(name):
        for bad in (1e300, -1e300):
            payload = msgspec.msgpack.encode(replaced(as_map(name), path, bad))
            assert refuses(name, payload), dotted(name, path)


@by_name
def test_counts_refuse_fractions_and_negative_numbers(name: str) -> None:
    whole = as_map(name)
    for path in numbers(name):
        if path[-1] in {"stamp_ns", "seq", "boot", "tick", "basis", "pid", "width", "height"}:
            for bad in (-1, 1.5, 2**64 - 1):
                assert refuses(name, msgspec.msgpack.encode(replaced(whole, path, bad))), path


@pytest.mark.long
@by_name
def test_a_message_cut_at_any_byte_is_refused(name: str) -> None:
    message = EXAMPLES[name]
    for payload in (msgspec.msgpack.encode(message), msgspec.json.encode(message)):
        assert not refuses(name, payload)
        assert all(refuses(name, payload[:length]) for length in range(len(payload)))


@by_name
@pytest.mark.parametrize("trailing", [b"\x00", b"\xc0", b"\x80", b"{}", b"x" * 100])
def test_bytes_behind_the_message_are_refused(name: str, trailing: bytes) -> None:
    assert refuses(name, msgspec.msgpack.encode(EXAMPLES[name]) + trailing)
    assert refuses(name, msgspec.json.encode(EXAMPLES[name]) + trailing)


@pytest.mark.long
@by_name
@given(payload=st.binary(max_size=300))
def test_random_bytes_without_the_required_fields_are_refused(name: str, payload: bytes) -> None:
    fields = msgspec.structs.fields(type(EXAMPLES[name]))
    required = [field.encode_name.encode() for field in fields if field.required]
    assert bool(required) == (name not in MAY_BE_EMPTY | NEEDS_ONE)
    assert refuses(name, b"{}") == (name not in MAY_BE_EMPTY)
    if not refuses(name, payload):
        assert all(word in payload for word in required)


@pytest.mark.long
@by_name
@given(data=st.data())
def test_a_damaged_message_is_refused_or_still_valid(name: str, data: st.DataObject) -> None:
    encode = data.draw(st.sampled_from((msgspec.msgpack.encode, msgspec.json.encode)))
    payload = bytearray(encode(EXAMPLES[name]))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        message = codec(name).decode(bytes(payload))
    except ValueError:
        return
    encoded = msgspec.msgpack.encode(message)
    values = [value for _, value in leaves(msgspec.msgpack.decode(encoded))]
    assert all(math.isfinite(value) for value in values if isinstance(value, float))
    codec(name).decode(encoded)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
def test_a_message_larger_than_its_topic_allows_is_not_decoded(topic: Topic[Any]) -> None:
    decode = Codec(topic.type, topic.max_bytes).decode
    with pytest.raises(ValueError, match=f"^{topic.max_bytes + 1} bytes, at most"):
        decode(b"{" * (topic.max_bytes + 1))
    limit = 8 * 1024 * 1024 if topic in (MAP, SIM_SCENE) else 1024 * 1024
    assert topic.max_bytes <= limit
    with pytest.raises(ValueError, match=rf"^{limit + 1} bytes, at most"):
        decode(b"\x80" * (limit + 1))


def test_an_oversized_message_is_refused_even_if_it_is_valid() -> None:
    oversized = b'{"linear_x": 0.2' + b" " * 1100 + b"}"
    with pytest.raises(ValueError, match="at most 1024 are read"):
        codec("CmdVel").decode(oversized)


@pytest.mark.parametrize(
    "payload",
    [
        b'{"linear_x": NaN}',
        b'{"linear_x": Infinity}',
        b'{"linear_x": -Infinity}',
        b'{"linear_x": 1e999}',
        b'{"linear_x": -1e999}',
        b'{"linear_x": ' + b"9" * 400 + b"}",
        b'{"linear_x": true}',
        b'{"linear_x": "0.3"}',
        b'{"linear_x": null}',
        b'{"linear_x": [0.3]}',
        b'{"linear_x": {"linear_x": 0.3}}',
        b'{"linear_x": 0.3,}',
        b"{'linear_x': 0.3}",
        b'{"linear_x": 0.3} {"linear_x": 0.3}',
        b'{"linear_x": 0.3, "__proto__": {}}',
        b'{"linear_x": 0.3, "source": "\xff"}',
        b'{"linear_x": 0.3, "source": "\\ud800"}',
        b'{"linear_x": 0.3, "source": "' + b"x" * 65 + b'"}',
        '{"linear_x": 0.3}'.encode("utf-16"),
        b"\xef\xbb\xbf" + b'{"linear_x": 0.3}',
        b"[]", b"0.3", b'"linear_x"', b"null", b"", b" ", b"{", b"}",
    ],
)  # fmt: skip
def test_json_that_is_not_a_command_is_refused(payload: bytes) -> None:
    assert refuses("CmdVel", payload)


@pytest.mark.parametrize(
    "start", [b"[", b'{"linear_x":', b'{"linear_x": 1, "a":', b"\x91", b"\x81"]
)
def test_nesting_a_hundred_thousand_deep_is_refused(start: bytes) -> None:
    decode = Codec(CmdVel, 2**21).decode
    with pytest.raises(ValueError, match=r"Expected|unknown|truncated"):
        decode(start * 100_000)


@pytest.mark.parametrize(
    "payload",
    [
        b"\x80",  # an empty map
        b"\xc1",  # a byte that MessagePack never uses
        b"\xdf\xff\xff\xff\xff",  # a map of 4 billion entries
        b"\x81\xa8linear_x\xdd\xff\xff\xff\xff",  # an array of 4 billion
        b"\x81\xa8linear_x\xc6\xff\xff\xff\xff",  # 4 billion bytes
        b"\x81\xa8linear_x\xd7\xff\x00\x00\x00\x00\x00\x00\x00\x00",  # a timestamp
        b"\x81\x01\xcb\x3f\xe0\x00\x00\x00\x00\x00\x00",  # a number for a key
        b"\x81\xa8linear_\xff\x01",  # a key that is no text
        b"\x95\x00\x00\x00\x00\x00",  # an array instead of a map
    ],
)
def test_messagepack_that_is_not_a_command_is_refused(payload: bytes) -> None:
    assert refuses("CmdVel", payload)


def test_a_repeated_field_must_be_valid_twice_and_the_last_value_counts() -> None:
    assert codec("CmdVel").decode(b'{"linear_x": 0.3, "linear_x": 0.1}') == CmdVel(linear_x=0.1)
    assert refuses("CmdVel", b'{"linear_x": NaN, "linear_x": 0.1}')
    twice = b"\x82\xa8linear_x\x01\xa8linear_x\x02"
    assert codec("CmdVel").decode(twice) == CmdVel(linear_x=2.0)


@pytest.mark.parametrize(
    "payload",
    [
        b'{"linear_x": 0.2}',
        b' \r\n\t{ "linear_x" : 2e-1 }\n',
        b"\x81\xa8linear_x\xcb?\xc9\x99\x99\x99\x99\x99\x9a",
    ],
)
def test_a_person_may_send_a_speed_alone(payload: bytes) -> None:
    assert codec("CmdVel").decode(payload) == CmdVel(linear_x=0.2)


def test_the_error_for_a_hostile_message_is_short() -> None:
    payload = msgspec.json.encode({"x" * 900: 1})
    with pytest.raises(ValueError, match="unknown field") as caught:
        codec("CmdVel").decode(payload)
    assert len(str(caught.value)) == 200


@pytest.mark.parametrize(
    ("name", "field", "value"),
    [
        ("LaserScan", "ranges", bytes(7)),
        ("OccupancyGrid", "width", 5),
        ("OccupancyGrid", "width", 2**62),
        ("Image", "height", 3),
        ("JointCommand", "position", [0.0]),
        ("PoseInMap", "covariance", [0.0] * 8),
        ("Imu", "orientation", [0.0, 0.0, 1.0]),
        ("Intent", "trajectory", [[0.5, 0.0, 0.0]]),
        ("Intent", "trajectory", [[0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]]),
        ("Intent", "trajectory", [[0.5, 0.0, 0.0, 0.0]] * 257),
        ("Intent", "progress", 1.01),
        ("SafetyState", "verdict", "fine"),
        ("GoalRequest", "place", "kitchen"),
        ("ZonesRequest", "remove", "lab"),
        ("Zones", "places", [{"name": "lab", "x": 0.0, "y": 0.0}]),
        ("Zones", "zones", [{"name": "a", "kind": "keepout", "points": [[0, 0], [1, 0]]}]),
        ("Zones", "zones", [{"name": "../a", "kind": "keepout", "points": [[0, 0]] * 3}]),
        ("Zones", "zones", [{"name": "a", "kind": "keepout", "points": [[0, 0]] * 257}]),
        ("Zones", "zones", [{"name": "a", "kind": "speed", "points": [[0, 0]] * 3}]),
        ("Zones", "zones", [{"name": "a", "kind": "one_way", "points": [[0, 0]] * 3}]),
        (
            "Zones",
            "zones",
            [{"name": str(i), "kind": "keepout", "points": [[0, 0]] * 256} for i in range(33)],
        ),
    ],
)
def test_contradicting_lengths_are_refused_on_the_wire(name: str, field: str, value: Any) -> None:
    assert refuses(name, msgspec.msgpack.encode({**as_map(name), field: value}))
