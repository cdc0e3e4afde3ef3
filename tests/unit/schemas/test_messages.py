from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas import examples
from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import (
    CmdVel,
)
from gigabrain_schemas.examples import EXAMPLES, export
from gigabrain_schemas.topics import SERVICES, TOPICS, messages
from gigabrain_zenoh.qa.faults.hostile import leaves
from tests.unit.schemas.plain import as_map, codec, dotted, refuses

HEADER = {"stamp_ns", "seq", "boot", "tick", "basis"}

# fields that a client must send; it may leave out all others
REQUIRED: dict[str, set[str]] = {
    "LaserScan": {"angle_min", "angle_increment", "range_min", "range_max", "ranges"},
    "Imu": {"orientation", "angular_velocity", "linear_acceleration"},
    "Image": {"frame_id", "encoding", "height", "width", "data"},
    "DepthImage": {"frame_id", "height", "width", "planes"},
    "CameraInfo": {"camera"},
    "RobotState": {"robot_type", "pose", "velocity"},
    "Body": {"description", "link"},
    "ArmModel": {"mjcf"},
    "WorldModel": {"scan_ok", "obstacle_ahead"},
    "Objects": {"objects"},
    "Detections": {"camera", "width", "height"},
    "Labels": {"labels"},
    "ObjectMap": set(),
    "Solids": set(),
    "PoseRequest": {"x", "y"},
    "PoseReply": {"ok", "text"},
    "ObjectsRequest": set(),
    "ObjectsReply": {"ok", "text"},
    "PoseInMap": {"x", "y", "yaw", "covariance"},
    "OccupancyGrid": {"resolution", "width", "height", "origin_x", "origin_y", "cells"},
    "Intent": {"behaviour", "reason"},
    "ArmPlan": set(),
    "Twist": {"linear_x"},
    "JointSpeeds": {"name", "velocity"},
    "CmdVel": {"linear_x"},
    "JointCommand": {"name"},
    "SafetyState": {"verdict"},
    "Health": {
        "process", "pid", "host", "uptime_s", "cpu", "rss_bytes", "received_hz", "sent_hz",
        "rejected", "latency_ms", "counters",
    },
    "LogRecord": {"process", "level", "event", "text"},
    "ButtonState": {"pressed"},
    "AuditRecord": {"process", "what", "source"},
    "AuditRequest": set(),
    "AuditPage": set(),
    "EstopRequest": set(),
    "ReleaseRequest": {"estop_generation"},
    "EnableRequest": {"source"},
    "LimpRequest": {"limp"},
    "GateReply": {"ok", "text", "robot_type", "gate"},
    "GoalRequest": set(),
    "GoalReply": {"ok", "text"},
    "MissionRequest": {"mission"},
    "MissionReply": {"ok", "text"},
    "MapRequest": {"name"},
    "MapReply": {"ok", "text"},
    "MapListRequest": set(),
    "MapListReply": set(),
    "MapLoadRequest": {"name"},
    "Zones": set(),
    "ZonesRequest": set(),
    "ZonesReply": {"ok", "text"},
    "TaskRequest": {"do"},
    "TaskReply": {"ok", "text"},
    "AcceptedRequest": {"service", "request"},
    "InputLog": {"began_ns", "keys", "taken"},
    "TaskStatus": set(),
    "ParamRequest": set(),
    "ParamReply": {"ok", "text"},
    "SimScene": {"version", "world", "bodies", "kinds", "owners", "sizes", "places", "colours"},
    "SimPoses": {"version", "poses"},
    "SimRequest": set(),
    "SimReply": {"ok", "text"},
    "DescribeRequest": set(),
    "Description": {"process", "pid", "host", "version"},
}  # fmt: skip

NEEDED = {  # one of several fields is required, and the example has only this one
    ("JointCommand", "position"), ("GoalRequest", "x"), ("GoalRequest", "y"),
    ("ZonesRequest", "zone"), ("ObjectsRequest", "ids"),
}  # fmt: skip

by_name = pytest.mark.parametrize("name", sorted(EXAMPLES))


def test_the_table_has_the_keys_and_rates_of_the_design() -> None:
    assert {topic.at("*"): (topic.type.__name__, topic.hz) for topic in TOPICS} == {
        "robot/scan": ("LaserScan", 10),
        "robot/imu": ("Imu", 100),
        "robot/state": ("RobotState", 50),
        "robot/body": ("Body", 1),
        "robot/arm_model": ("ArmModel", 1),
        "robot/image/*": ("Image", 10),
        "robot/depth/*": ("DepthImage", 10),
        "robot/camera/*": ("CameraInfo", 1),
        "robot/world": ("WorldModel", 10),
        "robot/perceived/*": ("Objects", 10),
        "robot/detections": ("Detections", 5),
        "robot/labels/*": ("Labels", 1),
        "robot/objects": ("ObjectMap", 1),
        "robot/solids": ("Solids", 5),
        "robot/pose": ("PoseInMap", 10),
        "robot/map": ("OccupancyGrid", 1),
        "robot/zones": ("Zones", 0.5),
        "robot/intent": ("Intent", 50),
        "robot/arm_plan": ("ArmPlan", 1),
        "robot/teleop": ("Twist", 20),
        "robot/joint_teleop": ("JointSpeeds", 20),
        "robot/cmd_vel": ("CmdVel", 50),
        "robot/joint_cmd": ("JointCommand", 50),
        "robot/safety": ("SafetyState", 20),
        "robot/health/*": ("Health", 1),
        "robot/button": ("ButtonState", 20),
        "robot/log": ("LogRecord", 10),
        "robot/task": ("TaskStatus", 5),
        "robot/request_log": ("AcceptedRequest", 10),
        "robot/input_log/*": ("InputLog", 2),
        "robot/sim_scene": ("SimScene", 1),
        "robot/sim_poses": ("SimPoses", 10),
        "robot/audit": ("AuditRecord", 10),
    }
    assert [service.at("*") for service in SERVICES] == [
        "robot/estop", "robot/release", "robot/enable", "robot/limp", "robot/goal",
        "robot/mission", "robot/task_change", "robot/map_save", "robot/sim_change",
        "robot/map_load", "robot/map_list", "robot/zones_change", "robot/pose_set",
        "robot/objects_change", "robot/audit_log", "robot/param/*", "robot/describe/*",
    ]  # fmt: skip


def test_a_value_is_stale_after_the_allowed_number_of_missed_periods() -> None:
    assert {topic.key: topic.stale_after_ns for topic in TOPICS} == {
        "robot/scan": 250_000_000,
        "robot/imu": 50_000_000,
        "robot/state": 250_000_000,
        "robot/body": 5_000_000_000,
        "robot/arm_model": 5_000_000_000,
        "robot/image": 500_000_000,
        "robot/depth": 250_000_000,
        "robot/camera": 5_000_000_000,
        "robot/world": 250_000_000,
        "robot/perceived": 500_000_000,
        "robot/detections": 1_000_000_000,
        "robot/labels": 5_000_000_000,
        "robot/objects": 5_000_000_000,
        "robot/solids": 2_000_000_000,
        "robot/pose": 500_000_000,
        "robot/map": 5_000_000_000,
        "robot/zones": 10_000_000_000,
        "robot/intent": 100_000_000,
        "robot/arm_plan": 5_000_000_000,
        "robot/teleop": 250_000_000,
        "robot/joint_teleop": 250_000_000,
        "robot/cmd_vel": 100_000_000,
        "robot/joint_cmd": 100_000_000,
        "robot/safety": 150_000_000,
        "robot/health": 5_000_000_000,
        "robot/button": 200_000_000,
        "robot/log": 500_000_000,
        "robot/task": 1_000_000_000,
        "robot/request_log": 500_000_000,
        "robot/input_log": 2_500_000_000,
        "robot/sim_scene": 5_000_000_000,
        "robot/sim_poses": 500_000_000,
        "robot/audit": 500_000_000,
    }


def test_no_stream_blocks_its_sender_and_only_stops_have_the_first_priority() -> None:
    assert {topic.congestion for topic in TOPICS} == {"drop"}
    urgent = {each.key for each in (*TOPICS, *SERVICES) if each.priority == "real_time"}
    assert urgent == {"robot/button", "robot/estop"}


def test_every_message_has_an_example_with_all_its_fields() -> None:
    assert {message.__name__ for message in messages()} == set(EXAMPLES) == set(REQUIRED)
    unused = {
        dotted(name, path)
        for name in EXAMPLES
        for path, value in leaves(as_map(name))
        if value is None
    }
    not_ended = {  # only goals that ended have errors
        f"TaskStatus.{task}.{error}_error"
        for task in ("current", "queue.0")
        for error in ("position", "heading")
    }
    of_other_kinds = {  # zones have the fields of their kind; a request has one subject
        "Zones.zones.0.max_speed", "Zones.zones.0.lane_width", "Zones.zones.1.lane_width",
        "Zones.zones.2.max_speed", "ZonesRequest.zone.max_speed", "ZonesRequest.zone.lane_width",
        "ZonesRequest.place", "Zones.places.1.yaw", "GoalRequest.tag",
    }  # fmt: skip
    elsewhere = {"WorldModel.sectors.3", "Description.report.min_clearance_m"}
    assert unused == elsewhere | not_ended | of_other_kinds


@pytest.mark.parametrize("message", messages())
def test_every_message_is_frozen_and_documented_and_has_the_header(
    message: type[Message],
) -> None:
    assert message.__struct_config__.frozen
    assert message.__doc__
    assert message.__doc__.strip().endswith(".")
    assert set(message.__struct_fields__) >= HEADER


def test_the_golden_folder_contains_the_examples_byte_for_byte() -> None:
    stored = {path.name: path.read_bytes() for path in examples.FOLDER.iterdir()}
    assert stored == examples.files()
    assert len(stored) == 126


@by_name
def test_golden_files_decode_to_the_example(name: str) -> None:
    for kind in ("msgpack", "json"):
        payload = (examples.FOLDER / f"{name}.{kind}").read_bytes()
        decoded = codec(name).decode(payload)
        # compared encoded: a scan may hold nan, which does not equal itself
        assert msgspec.msgpack.encode(decoded) == msgspec.msgpack.encode(EXAMPLES[name])


def test_writing_the_golden_files_removes_those_of_removed_messages(tmp_path: Path) -> None:
    (tmp_path / "Gone.json").write_text("{}")
    examples.write(tmp_path)
    assert not (tmp_path / "Gone.json").exists()
    assert (tmp_path / "CmdVel.msgpack").read_bytes() == examples.files()["CmdVel.msgpack"]


def test_the_wire_format_is_a_map_of_named_fields() -> None:
    assert msgspec.msgpack.encode(CmdVel(linear_x=0.5, seq=3)) == (
        b"\x8a\xa8stamp_ns\x00\xa3seq\x03\xa4boot\x00\xa4tick\x00\xa5basis\x00"
        b"\xa8linear_x\xcb\x3f\xe0\x00\x00\x00\x00\x00\x00\xa8linear_y\xcb"
        b"\x00\x00\x00\x00\x00\x00\x00\x00\xa9angular_z\xcb\x00\x00\x00\x00\x00\x00\x00\x00"
        b"\xa6source\xa0\xa8operator\xc2"
    )


def test_the_export_is_a_schema_per_message_and_two_tables(tmp_path: Path) -> None:
    written = export(tmp_path / "new")
    assert {path.stem for path in written} == {*EXAMPLES, "topics", "services"}
    schema = msgspec.json.decode((tmp_path / "new" / "CmdVel.json").read_bytes())
    assert schema["$defs"]["CmdVel"]["required"] == ["linear_x"]
    assert schema["$defs"]["CmdVel"]["additionalProperties"] is False
    topics = msgspec.json.decode((tmp_path / "new" / "topics.json").read_bytes())
    assert next(row for row in topics if row["key"] == "robot/cmd_vel") == {
        "key": "robot/cmd_vel", "message": "CmdVel", "rate_hz": 50, "stale_after_ms": 100,
        "priority": "interactive_high", "congestion": "drop", "express": False, "keep": False,
        "depth": 16, "max_bytes": 1024,
    }  # fmt: skip
    services = msgspec.json.decode((tmp_path / "new" / "services.json").read_bytes())
    assert services[0] == {
        "key": "robot/estop", "request": "EstopRequest", "reply": "GateReply",
        "priority": "real_time", "max_bytes": 65536,
    }  # fmt: skip


@by_name
def test_only_fields_with_a_default_may_be_left_out(name: str) -> None:
    whole = as_map(name)
    for key in whole:
        rest = {k: v for k, v in whole.items() if k != key}
        expected = key in REQUIRED[name] or (name, key) in NEEDED
        assert refuses(name, msgspec.msgpack.encode(rest)) is expected, key
        assert refuses(name, msgspec.json.encode(rest)) is expected, key
    minimal = {key: whole[key] for key in REQUIRED[name]}
    if name not in {one for one, _ in NEEDED}:
        assert not refuses(name, msgspec.msgpack.encode(minimal))
