"""The bringup check names the faults of a ROS 2 robot, with remedies."""

import asyncio
import math
from typing import Any

import msgspec
import numpy as np
import pytest

from gigabrain_drivers.bodies.ros2.bringup import (
    Finding,
    TopicStatistics,
    Watched,
    explain,
    findings,
    graph_findings,
)
from gigabrain_drivers.bodies.ros2.frames import FrameTree
from gigabrain_drivers.bodies.ros2.options import Ros2Options
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.qa.conformance.ros2_bringup import watch
from gigabrain_zenoh.ros2.memory import MemoryNetwork
from gigabrain_zenoh.ros2.qos import LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.transport import EndpointKind, GraphEndpoint
from gigabrain_zenoh.ros2.types import Types

STAMPED, TWIST = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
ODOMETRY, SCAN, TF = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan", "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"
LIDAR = Lidar(beams=360, rate_hz=10, range_min=0.1, range_max=8.0, x=-0.032)
NOW_S = 1_700_000_000.0


def options(**changes: Any) -> Ros2Options:
    topics = {
        "command": {"type": STAMPED},
        "odometry": {"name": "odom"},
        "scan": {"name": "scan"},
    } | changes.pop("topics", {})
    given = {"driver": "ros2", "transport": "dds", "domain": 7, "watchdog": 0.5} | changes
    return msgspec.convert(given | {"topics": topics}, Ros2Options)


def endpoint(
    topic: str, type: str, kind: EndpointKind = "publisher", qos: Qos | None = None, **fields: Any
) -> GraphEndpoint:
    node = fields.get("node", "/base")
    return GraphEndpoint(node, kind, topic, type, "", qos or Qos(), fields.get("ours", False))


GOOD_ENDPOINTS = (
    endpoint("/odom", ODOMETRY),
    endpoint("/scan", SCAN, qos=SENSOR_DATA, node="/lidar"),
    endpoint("/cmd_vel", STAMPED, "subscriber"),
)


def only(found: list[Finding], what: str) -> Finding:
    (finding,) = [each for each in found if each.what == what]
    return finding


def test_a_correct_robot_has_no_fault() -> None:
    found = graph_findings(options(), GOOD_ENDPOINTS, LIDAR)
    assert {each.verdict for each in found} == {"ok"}
    assert [each.what for each in found] == ["/odom", "/scan", "/cmd_vel"]
    assert explain(options(), GOOD_ENDPOINTS) == ""


def test_the_remedy_for_an_empty_graph_names_domain_and_network() -> None:
    ours = endpoint("/cmd_vel", STAMPED, ours=True)
    (found,) = graph_findings(options(), [ours])
    assert (found.what, found.verdict) == ("graph", "error")
    assert "ROS_DOMAIN_ID=7" in found.remedy
    zenoh = options(transport="rmw_zenoh", router="tcp/robot:7447")
    (found,) = graph_findings(zenoh, [])
    assert "tcp/robot:7447" in found.remedy
    assert "rmw_zenoh_cpp" in found.remedy


def test_a_missing_topic_is_named_with_others_of_its_type() -> None:
    endpoints = [endpoint("/robot1/odom", ODOMETRY), *GOOD_ENDPOINTS[1:]]
    found = only(graph_findings(options(), endpoints), "/odom")
    assert (found.verdict, found.text) == ("error", "it has no publisher")
    assert "/robot1/odom; write it as topics.odometry.name, or set namespace" in found.remedy
    assert graph_findings(options(namespace="/robot1"), endpoints)[0].verdict == "ok"


def test_a_wrong_type_is_named() -> None:
    endpoints = [endpoint("/odom", "geometry_msgs/msg/PoseStamped"), *GOOD_ENDPOINTS[1:]]
    found = only(graph_findings(options(), endpoints), "/odom")
    assert found.text == f"it is of type geometry_msgs/msg/PoseStamped; expected {ODOMETRY}"
    endpoints = [*GOOD_ENDPOINTS[:2], endpoint("/cmd_vel", TWIST, "subscriber")]
    found = only(graph_findings(options(), endpoints), "/cmd_vel")
    assert found.verdict == "error"
    assert found.remedy == f"write topics: {{command: {{type: {TWIST}}}}}"


def test_a_mismatched_quality_of_service_is_named() -> None:
    wanted = options(topics={"scan": {"qos": "reliable"}})
    found = only(graph_findings(wanted, GOOD_ENDPOINTS), "/scan")
    assert found.verdict == "error"
    assert found.remedy == "write topics: {scan: {qos: best_effort}}"
    wanted = options(topics={"command": {"type": STAMPED, "qos": "best_effort"}})
    found = only(graph_findings(wanted, GOOD_ENDPOINTS), "/cmd_vel")
    assert found.remedy == "write topics: {command: {qos: reliable}}"
    volatile = [*GOOD_ENDPOINTS, endpoint("/tf_static", TF)]
    found = only(graph_findings(options(mounting="tf_static"), volatile), "/tf_static")
    assert "volatile" in found.text


def test_a_robot_that_takes_no_commands_is_an_error_with_alternatives() -> None:
    endpoints = [*GOOD_ENDPOINTS[:2], endpoint("/base/cmd", TWIST, "subscriber")]
    found = only(graph_findings(options(), endpoints), "/cmd_vel")
    assert (found.verdict, found.text) == ("error", "no node takes commands")
    assert "/base/cmd" in found.remedy
    assert "/cmd_vel: no node takes commands" in explain(options(), endpoints)


def test_another_commander_is_a_warning_but_our_driver_and_guard_are_not() -> None:
    mine = [endpoint("/cmd_vel", STAMPED, node=f"/gigabrain_driver{n}") for n in ("", "_guard")]
    assert len(graph_findings(options(), [*GOOD_ENDPOINTS, *mine])) == 3
    endpoints = [*GOOD_ENDPOINTS, *mine, endpoint("/cmd_vel", STAMPED, node="/teleop")]
    *_, found = graph_findings(options(), endpoints)
    assert (found.verdict, found.text) == ("warning", "commanded by /teleop as well")


def test_two_publishers_of_one_topic_are_a_warning() -> None:
    found = only(
        graph_findings(options(), [*GOOD_ENDPOINTS, endpoint("/odom", ODOMETRY, node="/ekf")]),
        "/odom",
    )
    assert (found.verdict, found.text) == ("warning", "2 publishers: /base, /ekf")


def watched(statistics: dict[str, TopicStatistics], frames: FrameTree | None = None) -> Watched:
    return Watched(GOOD_ENDPOINTS, statistics, frames or FrameTree())


def statistics(hz: float = 20.0, offset_s: float = 0.01, **fields: Any) -> TopicStatistics:
    stamp_s = fields.pop("stamp_s", NOW_S - offset_s)
    return TopicStatistics(101, 100 / hz, offset_s, stamp_s, **fields)


GOOD_STATISTICS = {"odometry": statistics(), "scan": statistics(10.0)}


def test_messages_with_correct_rates_and_stamps_are_ok() -> None:
    found = findings(options(), LIDAR, watched(GOOD_STATISTICS))
    assert {each.verdict for each in found} == {"ok"}
    assert [each.what for each in found] == ["/odom", "/scan", "/cmd_vel", "/odom", "/scan"]


@pytest.mark.parametrize(
    ("wrong", "verdict", "text"),
    [
        (TopicStatistics(), "error", "no message came"),
        (TopicStatistics(unreadable="bad"), "error", "bad"),
        (statistics(unusable="odd"), "error", "odd"),
        (statistics(10.0), "warning", "10.0 messages a second; expected 20"),
        (statistics(offset_s=3.0), "warning", "3.0 s behind this machine's clock"),
        (statistics(offset_s=-3.0), "warning", "3.0 s ahead of this machine's clock"),
        (statistics(offset_s=NOW_S - 12.5, stamp_s=12.5), "error", "of a simulation: 12.5 s"),
        (statistics(offset_s=NOW_S, stamp_s=0.0), "error", "its stamps are 0"),
    ],
)
def test_faulty_messages_are_named(wrong: TopicStatistics, verdict: str, text: str) -> None:
    found = findings(options(), LIDAR, watched(GOOD_STATISTICS | {"odometry": wrong}))
    bad = [each for each in found if each.what == "/odom" and each.verdict != "ok"]
    assert len(bad) == 1
    assert bad[0].verdict == verdict
    assert text in bad[0].text
    assert bad[0].remedy


def test_an_imu_without_orientation_is_a_warning() -> None:
    imu = Types().make(
        IMU,
        header={"stamp": {"sec": int(NOW_S)}},
        orientation_covariance=np.array([-1.0] + [0.0] * 8),
    )
    statistics = TopicStatistics()
    statistics.take(imu, int(NOW_S * 1e9), 0.0)
    results = Watched(
        (*GOOD_ENDPOINTS, endpoint("/imu", IMU)), GOOD_STATISTICS | {"imu": statistics}
    )
    found = findings(options(topics={"imu": {}}), LIDAR, results)
    (wrong,) = (each for each in found if each.verdict != "ok")
    assert (wrong.what, wrong.verdict) == ("/imu", "warning")
    assert wrong.text.startswith("it has no orientation")
    assert "topics.imu.name" in wrong.remedy


def tree(types: Types, x: float, yaw: float = 0.0) -> FrameTree:
    frames = FrameTree()
    turn = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    for parent, child, at, rotation in (
        ("base_footprint", "base_link", 0.0, {"w": 1.0}),
        ("base_link", "base_scan", x, turn),
    ):
        frames.add(
            [
                types.make(
                    "geometry_msgs/msg/TransformStamped",
                    header={"frame_id": parent},
                    child_frame_id=child,
                    transform={"translation": {"x": at}, "rotation": rotation},
                )
            ]
        )
    return frames


@pytest.mark.parametrize(
    ("turned", "verdict"), [(math.pi, "ok"), (-3.12, "ok"), (-3.0, "warning"), (0.0, "warning")]
)
def test_a_yaw_of_half_a_turn_is_the_same_in_both_directions(turned: float, verdict: str) -> None:
    frames = tree(Types(), -0.032, turned)
    results = Watched(GOOD_ENDPOINTS, {"scan": statistics(10.0, frame="base_scan")}, frames)
    found = findings(options(), msgspec.structs.replace(LIDAR, yaw=math.pi), results)
    assert only(found, "scan frame").verdict == verdict


@pytest.mark.long
@pytest.mark.parametrize(
    ("mounting", "x", "frame", "verdict", "text"),
    [
        ("file", -0.032, "base_scan", "ok", "x -0.032 m"),
        ("file", 0.1, "base_scan", "warning", "the file says x -0.032"),
        ("tf_static", 0.1, "base_scan", "ok", "x 0.100 m"),
        ("file", 0.1, "laser", "warning", "'laser' is not connected with 'base_footprint'"),
        ("tf_static", 0.1, "laser", "error", "frames of /tf_static: base_footprint, base_link"),
    ],
)
def test_frames_must_be_connected_to_the_base(
    mounting: str, x: float, frame: str, verdict: str, text: str
) -> None:
    topics = {
        "odometry": statistics(child_frame="base_footprint"),
        "scan": statistics(10.0, frame=frame),
    }
    graph = (*GOOD_ENDPOINTS, endpoint("/tf_static", TF, qos=LATCHED))
    results = Watched(graph, topics, tree(Types(), x))
    found = only(findings(options(mounting=mounting), LIDAR, results), "scan frame")
    assert found.verdict == verdict
    assert text in found.text


@pytest.mark.parametrize(
    ("last", "problem"), [(83.0, "its percentage is 83; expected 0 to 1"), (0.83, "")]
)
async def test_a_watch_reports_why_the_driver_drops_the_newest_message(
    last: float, problem: str
) -> None:
    kind, types = "sensor_msgs/msg/BatteryState", Types()
    network, given = MemoryNetwork(types), options(topics={"battery": {}})
    watching = asyncio.create_task(watch(network.transport(), types, given, 0.2))
    publisher = network.transport(Ros2Link(node="base")).publisher("battery_state", kind)
    first, then = (
        types.encode(kind, types.make(kind, voltage=12.0, percentage=share))
        for share in (math.nan, last)
    )
    while not watching.done():
        publisher.publish(first)
        publisher.publish(then)
        await asyncio.sleep(0.01)
    battery = (await watching).statistics["battery"]
    assert battery.count > 0
    assert battery.unusable.startswith(problem)
    assert bool(battery.unusable) == bool(problem)
