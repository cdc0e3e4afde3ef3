"""The list of ROS topics, services and actions, and our keys beside those of the gateway."""

import io
from typing import Any

from rich.console import Console

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.gateway.topic_list import TopicRow, robot_keys, rows, topic_table
from gigabrain_zenoh.ros2.qos import DEFAULT, LATCHED, SENSOR_DATA
from gigabrain_zenoh.ros2.transport import GraphEndpoint

SCAN, SET_BOOL = "sensor_msgs/msg/LaserScan", "std_srvs/srv/SetBool"
NAVIGATE = "nav2_msgs/action/NavigateToPose"
LINK = Ros2Link(transport="dds", namespace="/red")


def endpoint(topic: str, node: str, kind: Any, type: str = SCAN, **other: Any) -> GraphEndpoint:
    given = {"hash": "", "qos": DEFAULT, "ours": False} | other
    return GraphEndpoint(node=node, kind=kind, topic=topic, type=type, **given)


GRAPH = (
    endpoint("/red/scan", "/red/gigabrain", "publisher", qos=SENSOR_DATA),
    endpoint("/red/scan", "/rviz", "subscriber"),
    endpoint("/red/scan", "/slam", "subscriber", qos=SENSOR_DATA),
    endpoint("/red/estop", "/red/gigabrain", "server", SET_BOOL),
    endpoint("/scan", "/other", "publisher", qos=LATCHED),
    endpoint("/red/gigabrain/get_parameters", "/red/gigabrain", "server",
             "rcl_interfaces/srv/GetParameters"),
    endpoint("/red/navigate_to_pose/_action/send_goal", "/red/gigabrain", "server",
             f"{NAVIGATE}_SendGoal"),
    endpoint("/red/navigate_to_pose/_action/send_goal", "", "client", f"{NAVIGATE}_SendGoal"),
    endpoint("/red/navigate_to_pose/_action/feedback", "/red/gigabrain", "publisher",
             f"{NAVIGATE}_FeedbackMessage"),
)  # fmt: skip


def listed(**options: Any) -> dict[str, TopicRow]:
    return {row.name: row for row in rows(GRAPH, LINK, **options)}


def test_a_topic_has_type_qos_nodes_and_our_key() -> None:
    scan = listed()["/red/scan"]
    assert (scan.kind, scan.type) == ("topic", SCAN)
    assert scan.offered == ("best effort, volatile, depth 5",)
    assert scan.requested == ("best effort, volatile, depth 5", "reliable, volatile, depth 10")
    assert (scan.senders, scan.receivers) == (("/red/gigabrain",), ("/rviz", "/slam"))
    assert scan.robot_keys == ("robot/scan",)


def test_readers_that_get_nothing_are_named() -> None:
    (trouble,) = listed()["/red/scan"].troubles
    assert trouble.startswith("nothing passes from /red/gigabrain to /rviz: the publisher is best")
    assert listed()["/scan"].troubles == ()


def test_services_and_actions_are_one_row_each() -> None:
    found = listed()
    assert list(found) == ["/red/estop", "/red/navigate_to_pose", "/red/scan", "/scan"]
    estop, navigate = found["/red/estop"], found["/red/navigate_to_pose"]
    assert (estop.kind, estop.type, estop.robot_keys) == ("service", SET_BOOL, ("robot/estop",))
    assert (navigate.kind, navigate.type) == ("action", NAVIGATE)
    assert (navigate.senders, navigate.receivers) == (("/red/gigabrain",), ("?",))
    assert navigate.robot_keys == ("robot/goal",)


def test_trajectories_of_joints_are_commands_for_joints() -> None:
    for name in ("joint_trajectory", "follow_joint_trajectory"):
        assert robot_keys(name) == ("robot/joint_cmd",)


def test_all_topics_are_those_of_every_node_and_the_parts_of_actions_as_well() -> None:
    found = listed(all_topics=True)
    assert found["/red/gigabrain/get_parameters"].kind == "service"
    assert found["/red/navigate_to_pose/_action/feedback"].kind == "topic"
    assert "/red/navigate_to_pose" not in found


def test_a_topic_of_other_nodes_has_no_key_of_ours() -> None:
    assert listed()["/scan"].robot_keys == ()


def test_names_of_cameras_lead_to_their_pictures() -> None:
    assert robot_keys("camera/image/compressed") == ("robot/image/*",)
    assert robot_keys("camera/rear/camera_info") == ("robot/image/*",)
    assert robot_keys("camera/depth/image_raw") == ("robot/depth/*",)
    assert robot_keys("nothing") == ()


def test_the_table_has_a_line_for_each_node() -> None:
    console = Console(width=160, file=io.StringIO())
    console.print(topic_table(rows(GRAPH, LINK)))
    lines = [line.split() for line in console.file.getvalue().splitlines()]
    (scan,) = [line for line in lines if line[:1] == ["/red/scan"]]
    assert scan[-3:] == ["/red/gigabrain", "/rviz", "robot/scan"]
    assert ["/slam"] in lines
