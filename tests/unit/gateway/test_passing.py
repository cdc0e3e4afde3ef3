"""One key to one ROS topic, or back: what is refused, and what arrives."""

import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import Body
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.examples import example
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY, MAP, SCAN, WORLD, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import BadPayload, ConfigError, Refused
from gigabrain_zenoh.gateway.passing import (
    Converter,
    Passage,
    check_fields,
    check_writer,
    fitting_qos,
    route,
)
from gigabrain_zenoh.ros2.memory import MemoryNetwork
from gigabrain_zenoh.ros2.qos import DEFAULT, LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.security.authority import issue, new_fleet

TYPES = Types()
STRING, LASER = "std_msgs/msg/String", "sensor_msgs/msg/LaserScan"
POSE = "geometry_msgs/msg/PoseStamped"
LINK = Ros2Link(transport="dds", node="pass")


@pytest.mark.parametrize(
    ("source", "target", "type", "form", "words"),
    [
        ("a", "b", "std_msgs/String", "fields", "a ROS topic, which starts with /, and a Zenoh"),
        ("/a", "/b", "std_msgs/String", "fields", "a ROS topic, which starts with /, and a Zenoh"),
        ("robot/world", "/w", "std_msgs/Strin", "json", "did you mean 'std_msgs/msg/String'"),
        ("robot/world", "/w", "std_srvs/srv/SetBool", "json", "no ROS message type"),
        ("robot/world", "/a b", "std_msgs/String", "json", "is no ROS name"),
        ("robot/world", "/w", "sensor_msgs/LaserScan", "json", "a type with one string field"),
        ("robot/wor*ld", "/w", "std_msgs/String", "json", "expected a key expression"),
        ("/a", "notes", "std_msgs/String", "fields", "a key below robot/"),
        ("/a", "robot/*", "std_msgs/String", "fields", "one key"),
        ("/a", "robot/Big/x", "std_msgs/String", "fields", "a name after robot/"),
    ],
)
def test_a_wrong_route_is_refused_in_one_line(
    source: str, target: str, type: str, form: Any, words: str
) -> None:
    with pytest.raises(ConfigError, match=words) as error:
        route(source, target, type, form, TYPES)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "key",
    ["robot/cmd_vel", "robot/joint_cmd", "robot/teleop", "robot/intent", "robot/scan",
     "robot/safety", "robot/estop", "robot/release", "robot/goal", "robot/health/driver"],
)  # fmt: skip
def test_ros_writes_to_no_key_of_the_robot(key: str) -> None:
    with pytest.raises(Refused, match="through the gateway"):
        route("/a", key, "std_msgs/String", "json", TYPES)


def test_an_identity_that_may_not_write_the_key_is_named(tmp_path: Path) -> None:
    new_fleet("home", tmp_path / "home")
    issued = {
        role: issue(tmp_path / "home", role, robot="red", process=process)
        for role, process in {"operator": "", "process": "mine", "robot": ""}.items()
    }
    with pytest.raises(Refused, match="operator@red may not write robot/notes; make an identity"):
        check_writer(str(issued["operator"]), "robot/notes")
    for keys in ("", str(issued["process"]), str(issued["robot"])):
        check_writer(keys, "robot/notes")


def test_a_route_names_both_ends() -> None:
    there = route("robot/world", "/world", "std_msgs/String", "json", TYPES)
    back = route("/chatter", "robot/notes", STRING, "fields", TYPES)
    assert str(there) == "robot/world -> /world (std_msgs/msg/String, as json)"
    assert str(back) == "/chatter -> robot/notes (std_msgs/msg/String, as fields)"


def test_a_message_without_a_field_of_the_type_is_refused_at_once() -> None:
    wrong = route("robot/world", "/w", STRING, "fields", TYPES)
    with pytest.raises(ConfigError, match=r"no field in common: scan_ok, .* and data; "):
        check_fields(TYPES, wrong, WORLD)
    with pytest.raises(ConfigError, match="leave out --as cdr"):
        check_fields(TYPES, wrong._replace(form="cdr"), WORLD)
    check_fields(TYPES, route("robot/scan", "/s", LASER, "fields", TYPES), SCAN)


def converter(source: str, target: str, type: str, form: Any) -> Converter:
    return Converter(TYPES, route(source, target, type, form, TYPES))


def test_json_of_our_schema_goes_into_the_text() -> None:
    world = example(WorldModel)
    cdr = converter("robot/world", "/world", STRING, "json").of_message(world)
    text = TYPES.decode(STRING, cdr).data
    assert msgspec.json.decode(text, type=WorldModel) == world


def test_fields_of_the_same_names_are_passed_arrays_as_numbers() -> None:
    scan = example(LaserScan)
    made = TYPES.decode(LASER, converter("robot/scan", "/s", LASER, "fields").of_message(scan))
    assert made.range_max == pytest.approx(scan.range_max)
    assert made.ranges.tobytes() == scan.ranges_m.astype("<f4").tobytes()
    assert made.header.frame_id == ""


def test_json_and_messagepack_of_ones_own_key_become_fields_the_rest_is_left_out() -> None:
    made = converter("robot/mine", "/p", POSE, "fields")
    values = {"pose": {"position": {"x": 1.5, "w": 9}, "note": 1}, "more": [1]}
    for encode in (msgspec.json.encode, msgspec.msgpack.encode):
        assert TYPES.decode(POSE, made.of_payload(encode(values))).pose.position.x == 1.5


@pytest.mark.parametrize(
    ("form", "payload", "words"),
    [
        ("fields", b"{", "truncated"),
        ("fields", b"[1]", "no field of std_msgs/msg/String"),
        ("fields", b'{"date": 1}', "no field of std_msgs/msg/String"),
        ("fields", b'{"data": 1}', "data: expected a text"),
        ("json", b"\xc1", "MessagePack"),
        ("json", msgspec.msgpack.encode(msgspec.msgpack.Ext(9, b"x")), "Ext"),
        ("cdr", b"\x00\x01\x00\x00\xff\xff\xff\x7f", "std_msgs/msg/String"),
        ("fields", b" " * 1_048_577, "at most 1048576"),
    ],
)
def test_what_does_not_fit_is_refused(form: Any, payload: bytes, words: str) -> None:
    with pytest.raises(BadPayload, match=words):
        converter("robot/mine", "/p", STRING, form).of_payload(payload)


def test_types_of_ones_own_pass_as_well(tmp_path: Path) -> None:
    (tmp_path / "tank_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "tank_msgs" / "msg" / "Level.msg").write_text("string name\nfloat32[] litres\n")
    types = Types([tmp_path])
    there = Converter(types, route("robot/tank", "/tank", "tank_msgs/Level", "fields", types))
    cdr = there.of_payload(b'{"name": "left", "litres": [1.5, "NaN"]}')
    back = Converter(types, route("/tank", "robot/tank", "tank_msgs/Level", "fields", types))
    assert back.to_payload(cdr) == b'{"name":"left","litres":[1.5,"NaN"]}'


def string(text: str) -> bytes:
    return TYPES.encode(STRING, TYPES.make(STRING, data=text))


def test_a_key_gets_fields_json_or_cdr_of_ros() -> None:
    def of(form: Any, cdr: bytes) -> bytes:
        return converter("/chatter", "robot/notes", STRING, form).to_payload(cdr)

    assert of("fields", string("hi")) == b'{"data":"hi"}'
    assert of("json", string('{"a": 1}')) == b'{"a": 1}'
    assert of("cdr", string("hi")) == string("hi")
    with pytest.raises(BadPayload, match="not JSON"):
        of("json", string("hi"))
    with pytest.raises(BadPayload, match="at most 1048576"):
        of("fields", string("x" * 1_048_577))
    with pytest.raises(BadPayload, match="not CDR"):
        of("fields", b"")


class Ends:
    """A bus in memory, and a node of ROS in memory."""

    def __init__(self) -> None:
        self.clock, self.network = FakeClock(), LocalNetwork()
        self.ros = MemoryNetwork(TYPES, self.clock.unix_ns)
        self.bus = Bus(self.network.transport(), self.clock, "pass")
        self.robot = Bus(self.network.transport(), self.clock, "robot")
        self.node = self.ros.transport(Ros2Link(node="rclpy"))
        self.got: list[Any] = []

    def passage(self, *words: Any, topic: Topic[Any] | None = None) -> Passage:
        made = route(*words, TYPES)
        return Passage(made, self.bus, self.ros.transport(LINK), TYPES, LINK, topic)

    def read(self, topic: str, type: str = STRING, qos: Qos = DEFAULT) -> Any:
        return self.node.subscribe(
            topic, type, qos, lambda one: self.got.append(TYPES.decode(type, one.payload))
        )

    def listen(self, key: str) -> Any:
        transport = self.network.transport()
        return transport.subscribe(key, lambda _, payload: self.got.append(payload) or True, 1)


@pytest.fixture
async def ends() -> AsyncIterator[Ends]:
    made = Ends()
    yield made
    await made.bus.close()
    await made.robot.close()


async def test_a_key_is_read_only_while_ros_reads(ends: Ends) -> None:
    passage = ends.passage("robot/world", "/world", STRING, "json", topic=WORLD)
    ends.robot.publish(WORLD, example(WorldModel))
    assert (ends.bus.listens, passage.counts["passed"]) == ([], 0)
    close = ends.read("/world")
    assert ends.bus.listens == ["robot/world"]
    ends.robot.publish(WORLD, example(WorldModel))
    assert json.loads(ends.got[0].data)["obstacle_ahead"] == example(WorldModel).obstacle_ahead
    close()
    ends.robot.publish(WORLD, example(WorldModel))
    assert (ends.bus.listens, passage.counts["passed"], len(ends.got)) == ([], 1, 1)


async def test_ones_own_key_passes_and_what_cannot_is_dropped_and_counted(
    ends: Ends, caplog: pytest.LogCaptureFixture
) -> None:
    passage = ends.passage("robot/mine", "/mine", STRING, "fields")
    ends.read("/mine")
    send = ends.network.deliver
    send("robot/mine", b'{"date": 1}')
    send("robot/mine", b"{")
    send("robot/mine", b'{"data": "hi"}')
    assert [one.data for one in ends.got] == ["hi"]
    assert passage.counts == {"dropped": 2, "passed": 1}
    (warning,) = caplog.messages
    assert warning == "dropped a message: no field of std_msgs/msg/String in it"


async def test_a_topic_that_is_kept_is_latched_for_ros(ends: Ends) -> None:
    ends.passage("robot/map", "/our_map", STRING, "json", topic=MAP)
    ends.read("/our_map", qos=LATCHED)
    assert ends.bus.listens == ["robot/map"]


async def test_ros_is_read_only_while_somebody_reads_the_key(ends: Ends) -> None:
    passage = ends.passage("/chatter", "robot/notes", STRING, "fields")
    passage.look()
    talker = ends.node.publisher("/chatter", STRING)
    talker.publish(string("early"))
    assert talker.readers == 0
    close = ends.listen("robot/notes")
    assert talker.readers == 1
    talker.publish(string("hi"))
    close()
    assert talker.readers == 0
    talker.publish(string("late"))
    assert (ends.got, passage.counts) == ([b'{"data":"hi"}'], {"passed": 1})


async def test_the_reader_takes_what_publishers_offer(ends: Ends) -> None:
    talker = ends.node.publisher("/chatter", STRING, LATCHED)
    talker.publish(string("before"))
    ends.listen("robot/notes")
    passage = ends.passage("/chatter", "robot/notes", STRING, "fields")
    passage.look()
    assert ends.got == [b'{"data":"before"}']
    ends.node.publisher("/chatter", STRING, SENSOR_DATA).publish(string("lost"))
    passage.look()
    ends.node.publisher("/chatter", STRING, SENSOR_DATA).publish(string("sensor"))
    assert ends.got[-1] == b'{"data":"sensor"}'
    made = route("/chatter", "robot/notes", STRING, "fields", TYPES)
    assert fitting_qos(made, ()) == Qos(reliable=False, depth=10)


async def test_another_type_on_the_topic_is_reported_once(
    ends: Ends, caplog: pytest.LogCaptureFixture
) -> None:
    ends.node.publisher("/chatter", LASER)
    passage = ends.passage("/chatter", "robot/notes", STRING, "fields")
    for _ in range(3):
        passage.look()
    assert caplog.messages == [
        f"/chatter: /rclpy has the type {LASER}, /pass {STRING}; use one type at both ends"
    ]


async def test_the_key_that_this_body_obeys_is_refused(ends: Ends) -> None:
    body = example(Body)
    obeyed = replace(body, description=replace(body.description, control_topic="robot/drive"))
    ends.robot.publish(BODY, obeyed)
    talker = ends.node.publisher("/chatter", STRING)
    ends.listen("robot/drive")
    passage = ends.passage("/chatter", "robot/drive", STRING, "fields")
    with pytest.raises(Refused, match="robot/drive belongs to the robot"):
        await passage.run()
    talker.publish(string("drive"))
    assert ends.got == []
