"""Types: CDR as in ROS, conversion from and to JSON, the user's definitions, bad payloads."""

import contextlib
import json
import math
import random
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gigabrain_zenoh.errors import BadPayload, ConfigError
from gigabrain_zenoh.ros2.type_files import DUMMY
from gigabrain_zenoh.ros2.types import Types
from tests.unit.ros2.random_messages import random_fields

ODOMETRY = "nav_msgs/msg/Odometry"
SCAN = "sensor_msgs/msg/LaserScan"
USED = (
    ODOMETRY,
    SCAN,
    "geometry_msgs/msg/TwistStamped",
    "nav2_msgs/action/NavigateThroughPoses_SendGoal_Request",
    "nav_msgs/msg/OccupancyGrid",
    "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/JointState",
    "tf2_msgs/msg/TFMessage",
    "trajectory_msgs/msg/JointTrajectory",
)


@pytest.fixture(scope="session")
def types() -> Types:
    return Types()


def test_a_string_is_encoded_as_on_the_wire(types: Types) -> None:
    name = "std_msgs/msg/String"
    payload = types.encode(name, types.make(name, data="hi"))
    assert payload.hex() == "0001000003000000686900"
    assert types.decode(name, payload).data == "hi"


def test_sizes_are_those_of_ros(types: Types) -> None:
    twist, scan = types.make("geometry_msgs/msg/Twist"), types.make(SCAN, ranges=np.ones(360))
    scan.header.frame_id = "base_scan"
    assert len(types.encode("geometry_msgs/msg/Twist", twist)) == 52
    assert len(types.encode(SCAN, scan)) == 4 + 24 + 28 + 4 + 4 * 360 + 4


def test_big_endian_is_read(types: Types) -> None:
    payload = b"\0\0\0\0" + struct.pack(">d", 1.5) * 6
    assert types.decode("geometry_msgs/msg/Twist", payload).angular.z == 1.5


HASHES = {
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "rmw_dds_common/msg/Gid": ("ab6f21cfbb0a6dbb837161e1110c2051a2850ed9f9c53944d7115d9bcebedf71"),
    "sensor_msgs/msg/LaserScan": "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    "std_msgs/msg/Char": ("3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9"),
    "std_srvs/srv/SetBool": "abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
    "action_msgs/srv/CancelGoal": (
        "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a"
    ),
    "nav_msgs/srv/GetMap": "c8ae77c9995b3554b5ba80e4d4d443f970ac65143102a1d893ec24fc07b31147",
    "nav2_msgs/action/NavigateToPose": (
        "a56dba8a3234a1215e610180dc703ae25bbf406dded8b54887891c9732857eab"
    ),
    "nav2_msgs/action/NavigateToPose_SendGoal": (
        "a4fcb3bee1bf32e21a0e541a943b221aa0826996e2c98f079b47022b256f48b5"
    ),
}


@pytest.mark.parametrize("name", HASHES)
def test_hashes_are_those_of_ros(types: Types, name: str) -> None:
    assert types.hash(name) == f"RIHS01_{HASHES[name]}"


def test_omitted_fields_have_their_defaults(types: Types) -> None:
    message = types.make(ODOMETRY, header={"frame_id": "odom"}, pose={"covariance": [1] * 36})
    assert message.pose.pose.orientation.w == 1.0
    assert message.header.frame_id == "odom"
    assert message.pose.covariance.dtype == np.float64
    assert message.twist.covariance.tolist() == [0.0] * 36


def test_an_unknown_field_or_type_is_named(types: Types) -> None:
    with pytest.raises(ConfigError, match="no field frame"):
        types.make("std_msgs/msg/Header", frame="odom")
    with pytest.raises(ConfigError, match="did you mean 'std_msgs/msg/Header'"):
        types.make("std_msgs/msg/Heade")


def test_a_message_is_the_same_after_conversion_to_json_and_back(types: Types) -> None:
    scan = types.make(SCAN, ranges=[1.0, math.inf, math.nan], angle_min=-math.inf)
    text = json.dumps(types.to_dict(scan), allow_nan=False)
    back = types.from_dict(SCAN, json.loads(text))
    assert types.encode(SCAN, back) == types.encode(SCAN, scan)
    assert json.loads(text)["ranges"] == [1.0, "Infinity", "NaN"]


def test_bytes_are_base64_or_a_list(types: Types) -> None:
    image = "sensor_msgs/msg/Image"
    assert types.to_dict(types.make(image, data=b"\1\2"))["data"] == "AQI="
    for data in ("AQI=", [1, 2]):
        assert types.from_dict(image, {"data": data}).data.tolist() == [1, 2]


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("std_msgs/msg/Header", {"frame": "a"}, "no field frame; known: stamp, frame_id"),
        ("std_msgs/msg/Header", [], "expected an object"),
        ("std_msgs/msg/Header", {"stamp": {"sec": 1.5}}, "stamp.sec: expected a whole number"),
        ("std_msgs/msg/Header", {"stamp": {"nanosec": -1}}, "0 to 4294967295"),
        ("std_msgs/msg/Header", {"frame_id": 3}, "frame_id: expected a text"),
        ("std_msgs/msg/Header", {"frame_id": "a\0b"}, "frame_id: expected a text"),
        ("std_msgs/msg/Bool", {"data": 1}, "expected true or false"),
        ("std_msgs/msg/Float32", {"data": 1e39}, "expected a number up to 3.4e"),
        ("std_msgs/msg/Float64", {"data": "fast"}, "NaN, Infinity or -Infinity"),
        (SCAN, {"ranges": [1.0, "x"]}, r"ranges\[1\]"),
        (SCAN, {"ranges": "AAAA"}, "ranges: expected a list"),
        ("sensor_msgs/msg/Image", {"data": "?"}, "data: expected a list of numbers, or base64"),
        ("geometry_msgs/msg/PoseWithCovariance", {"covariance": [0.0]}, "expected 36 elements"),
    ],
)
def test_an_error_names_the_field_of_a_wrong_value(
    types: Types, name: str, data: Any, words: str
) -> None:
    with pytest.raises(BadPayload, match=words):
        types.from_dict(name, data)


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return folder


def test_definitions_of_the_user_are_read(tmp_path: Path) -> None:
    write(tmp_path, "my_msgs/msg/Thing.msg", "string<=5 name\nPart[<=2] parts\nfloat64 size 2.5")
    write(tmp_path, "my_msgs/msg/Part.msg", "uint8 KIND=3\nuint8 kind 3\nstd_msgs/Header header")
    write(tmp_path, "my_msgs/srv/Fetch.srv", "Thing thing\n---\nbool ok  # done\n")
    types = Types([tmp_path])
    thing = types.make("my_msgs/msg/Thing", name="a", parts=[{}])
    assert (thing.size, thing.parts[0].kind) == (2.5, 3)
    request = types.make("my_msgs/srv/Fetch_Request", thing=thing)
    payload = types.encode("my_msgs/srv/Fetch_Request", request)
    assert types.decode("my_msgs/srv/Fetch_Request", payload).thing.name == "a"
    with pytest.raises(BadPayload, match="at most 5 bytes"):
        types.from_dict("my_msgs/msg/Thing", {"name": "abcdef"})
    with pytest.raises(BadPayload, match="at most 2 elements"):
        types.from_dict("my_msgs/msg/Thing", {"parts": [{}] * 3})


def test_a_definition_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    types = Types([write(tmp_path, "my_msgs/msg/A.msg", "\ufeffuint8 kind 3\n")])
    assert types.make("my_msgs/msg/A").kind == 3


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("my_msgs/msg/A.msg", "?!\n", "no ROS message definition"),
        ("my_msgs/msg/A.msg", "other_msgs/B b\n", "a field of my_msgs/msg/A: .*'other_msgs/msg/B'"),
        ("my_msgs/srv/A.srv", "bool ok\n", "expected 2 parts"),
        ("std_msgs/msg/String.msg", "int32 data\n", "already present"),
        ("my_msgs/notes.txt", "", "no .msg, .srv or .action file"),
        ("my_msgs/msg/A.msg", "int8 x 1000\n", "A.msg: default of x: .* -128 to 127, got 1000"),
        ("my_msgs/msg/A.msg", "float64 x fast\n", "A.msg: default of x: expected a number"),
        ("my_msgs/msg/A.msg", "bool x maybe\n", "A.msg: default of x: expected true or false"),
        (
            "my_msgs/msg/A.msg",
            "string<=3 x abcd\n",
            "A.msg: default of x: .* at most 3 bytes",
        ),
        ("my_msgs/msg/A.msg", "int8[2] x [1, 2, 3]\n", "A.msg: default of x: expected 2 elements"),
        ("my_msgs/msg/A.msg", "uint8[] x AAAA\n", "A.msg: default of x: expected a list"),
        ("my_msgs/msg/A.msg", "byte[] x [256]\n", "A.msg: default of x: .* 0 to 255, got 256"),
        ("my_msgs/msg/A.msg", "std_msgs/Header x 3\n", "A.msg: default of x: .*no default"),
        ("my_msgs/msg/A.msg", "Header[] x [3]\n", "A.msg: default of x: .*no default"),
        ("my_msgs/msg/A.msg", "int32 X=abc\n", "A.msg: constant X: expected a whole number"),
        ("my_msgs/msg/A.msg", "int32 X=[1, 2]\n", "A.msg: a constant is a list"),
        pytest.param(
            "my_msgs/msg/A.msg", f"int32 X={'9' * 5000}\n", "A.msg: .* 5000 digits", id="digits"
        ),
        ("my_msgs/msg/A.msg", "string<=-1[] x\n", "A.msg: x: expected a size of 0 or more"),
        ("my_msgs/msg/A.msg", "int32[-1] x\n", "A.msg: x: expected a size of 0 or more"),
        ("my_msgs/srv/A.srv", "---\nuint8 x -1\n", "A.srv: default of x: .* 0 to 255, got -1"),
        ("my_msgs/msg/A.msg", "A x\n", "A.msg: .*my_msgs/msg/A contains itself"),
        ("my_msgs/msg/A.msg", "A[] x\n", "A.msg: .*my_msgs/msg/A contains itself"),
    ],
)
def test_an_error_names_an_unusable_definition(
    tmp_path: Path, name: str, text: str, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        Types([write(tmp_path, name, text)])
    with pytest.raises(ConfigError, match=r"expected a \.msg"):
        Types([tmp_path / "missing.msg"])


def test_types_that_contain_each_other_are_rejected(tmp_path: Path) -> None:
    write(tmp_path, "my_msgs/msg/A.msg", "B b\n")
    write(tmp_path, "my_msgs/msg/B.msg", "A[2] a\n")
    with pytest.raises(ConfigError, match=r"A\.msg: .*my_msgs/msg/A contains itself"):
        Types([tmp_path])


def test_defaults_are_read_as_in_rosidl(tmp_path: Path) -> None:
    text = (
        "bool on 1\nfloat32 far inf\nfloat64 half 5e-1\nfloat64 one 1\nbyte high 255\n"
        "int8[] none []\nbool[2] both [1, false]\nstring[] names ['a', 'b']\nuint8[2] two [1, 2]\n"
        "string VERSION=1.0\nbool YES=1\nfloat32 NAN=nan\nbyte MAX=255\n"
    )
    types = Types([write(tmp_path, "my_msgs/msg/Odd.msg", text)])
    made = types.make("my_msgs/msg/Odd")
    made.two[0] = 9
    made = types.make("my_msgs/msg/Odd")
    payload = types.encode("my_msgs/msg/Odd", made)
    assert types.to_dict(types.decode("my_msgs/msg/Odd", payload)) == {
        "on": True, "far": "Infinity", "half": 0.5, "one": 1.0, "high": -1, "none": [],
        "both": [True, False], "names": ["a", "b"], "two": [1, 2],
    }  # fmt: skip


@pytest.mark.long
def test_every_type_is_decoded_as_it_was_encoded(types: Types) -> None:
    source = random.Random(1)
    for name in types.messages():
        message = types.from_dict(name, random_fields(types, name, source))
        payload = types.encode(name, message)
        assert types.to_dict(types.decode(name, payload)) == types.to_dict(message), name
        assert types.encode(name, types.decode(name, payload)) == payload, name


@pytest.mark.parametrize("name", USED)
def test_padding_and_bytes_after_a_message_are_ignored(types: Types, name: str) -> None:
    """rclpy's serialize_message leaves random bytes in both."""
    message = types.from_dict(name, random_fields(types, name, random.Random(2)))
    payload, values = types.encode(name, message), types.to_dict(message)

    def same(candidate: bytes) -> bool:
        try:
            return bool(types.to_dict(types.decode(name, candidate)) == values)
        except BadPayload:
            return False

    padded = bytearray(payload)
    for place in range(2, len(payload)):
        other = bytearray(payload)
        other[place] ^= 0xFF
        if same(bytes(other)):
            padded[place] = 0xFF
    assert padded != payload
    assert same(bytes(padded) + b"\xff" * 13)


def damaged(payload: bytes, source: random.Random) -> bytes:
    """Return the payload with flipped bits, changed lengths, missing or additional bytes."""
    body = bytearray(payload)
    for _ in range(source.randint(1, 4)):
        place = source.randrange(len(body) or 1)
        match source.randrange(6):
            case 0 if body:
                body[place] ^= 1 << source.randrange(8)
            case 1 if len(body) > 8:
                place = place // 4 * 4
                length = source.choice((0, 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1, len(body)))
                body[place : place + 4] = length.to_bytes(4, "little")
            case 2:
                del body[place:]
            case 3:
                body += source.randbytes(source.randint(1, 40))
            case 4:
                body[place : place + 8] = source.randbytes(8)
            case _:
                body[place:place] = body[place : place + 16]
    return bytes(body)


def payloads(types: Types, source: random.Random) -> Iterator[tuple[str, bytes]]:
    for name in types.messages():
        message = types.from_dict(name, random_fields(types, name, source))
        yield name, types.encode(name, message)


def is_decoded(types: Types, name: str, payload: bytes) -> bool:
    """Return whether a payload is decoded. Raises any error but BadPayload."""
    try:
        message = types.decode(name, payload)
    except BadPayload:
        return False
    json.dumps(types.to_dict(message), allow_nan=False)
    return True


def decode_damaged(types: Types, rounds: int) -> tuple[int, int]:
    """Decode damaged payloads of all types; return the numbers of tried and decoded ones."""
    source, tried, decoded_count = random.Random(3), 0, 0
    for _ in range(rounds):
        for name, payload in payloads(types, source):
            for _ in range(10):
                tried += 1
                decoded_count += is_decoded(types, name, damaged(payload, source))
    return tried, decoded_count


def test_damaged_payloads_raise_only_bad_payload(types: Types) -> None:
    tried, decoded_count = decode_damaged(types, 1)
    assert tried > 2000
    assert 0 < decoded_count < tried


@pytest.mark.qa
def test_a_million_damaged_payloads_raise_only_bad_payload(types: Types) -> None:
    rounds = 1_000_000 // (10 * len(types.messages())) + 1
    assert decode_damaged(types, rounds)[0] >= 1_000_000


MAX_ALLOCATED = 60  # bytes of Python's objects, for each byte of a payload
PAYLOAD_BYTES = 8000


def test_decoding_allocates_no_more_than_the_length_allows(types: Types) -> None:
    worst: dict[str, float] = {}
    for name in types.messages():  # decoders are generated at the first use, and kept
        with contextlib.suppress(BadPayload):
            types.decode(name, b"\0\1\0\0")
    tracemalloc.start()
    try:
        for name in types.messages():
            for payload in payloads_with_long_sequences():
                tracemalloc.reset_peak()
                before, _ = tracemalloc.get_traced_memory()
                with contextlib.suppress(BadPayload):
                    types.decode(name, payload)
                peak = tracemalloc.get_traced_memory()[1] - before
                worst[name] = max(worst.get(name, 0.0), peak / PAYLOAD_BYTES)
    finally:
        tracemalloc.stop()
    assert {name: ratio for name, ratio in worst.items() if ratio > MAX_ALLOCATED} == {}


def payloads_with_long_sequences() -> Iterator[bytes]:
    """Yield payloads whose first fields are the length of a long sequence."""
    for fill in (b"\0", b"\1\0\0\0"):
        for start in range(0, 16, 4):
            body = bytearray(fill * (PAYLOAD_BYTES // len(fill)))
            body[start : start + 4] = (PAYLOAD_BYTES - 100).to_bytes(4, "little")
            yield b"\0\1\0\0" + bytes(body)


def test_a_payload_beyond_the_limit_is_rejected(types: Types) -> None:
    with pytest.raises(BadPayload, match="not CDR"):
        types.decode("sensor_msgs/msg/Image", b"\0\1\0\0" + bytes((64 << 20) + 1))


def test_an_empty_message_has_a_byte_on_the_wire_and_no_field_in_json(types: Types) -> None:
    name = "std_srvs/srv/Trigger_Request"
    payload = types.encode(name, types.make(name))
    assert payload.hex() == "0001000000"
    assert types.to_dict(types.decode(name, payload)) == {}
    assert getattr(types.decode(name, payload), DUMMY) == 0
