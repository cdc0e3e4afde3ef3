"""Endpoints that cannot communicate are found in the graph, with reasons and remedies."""

from typing import Any

import pytest

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.ros2.graph import doubles, nameless, troubles, unreached
from gigabrain_zenoh.ros2.qos import DEFAULT, LATCHED, SENSOR_DATA
from gigabrain_zenoh.ros2.transport import GraphEndpoint

SCAN, TWIST = "sensor_msgs/msg/LaserScan", "geometry_msgs/msg/Twist"
STAMPED = "geometry_msgs/msg/TwistStamped"
DDS, RMW = Ros2Link(transport="dds"), Ros2Link()


def endpoint(node: str, kind: Any, type: str = SCAN, **other: Any) -> GraphEndpoint:
    given = {"topic": "/scan", "hash": "RIHS01_a", "qos": DEFAULT, "ours": False} | other
    return GraphEndpoint(node=node, kind=kind, type=type, **given)


def found(link: Ros2Link, *endpoints: GraphEndpoint) -> list[tuple[str, str, str]]:
    return [(each.kind, each.text, each.remedy) for each in troubles(link, endpoints)]


def test_matching_endpoints_have_no_trouble() -> None:
    sensor = endpoint("/ours", "publisher", qos=SENSOR_DATA)
    assert found(DDS, sensor, endpoint("/rviz", "subscriber", qos=SENSOR_DATA)) == []
    assert found(DDS, endpoint("/a", "publisher"), endpoint("/b", "publisher", TWIST)) == []
    elsewhere = endpoint("/rviz", "subscriber", TWIST, topic="/scan2")
    assert found(DDS, sensor, elsewhere) == []


def test_over_dds_a_reader_that_requests_more_than_is_offered_is_a_trouble() -> None:
    ours = endpoint("/ours", "publisher", qos=SENSOR_DATA, ours=True)
    rviz = endpoint("/rviz", "subscriber")
    assert found(DDS, ours, rviz) == [
        ("qos", "nothing passes from /ours to /rviz: the publisher is best effort, the subscriber "
         "wants reliable", "have /rviz subscribe with best effort, volatile, depth 5"),
    ]  # fmt: skip
    assert found(RMW, ours, rviz) == []


def test_the_remedy_names_the_qos_that_a_publisher_should_offer() -> None:
    theirs = endpoint("/tf", "publisher")
    ours = endpoint("/ours", "subscriber", qos=LATCHED, ours=True)
    ((kind, text, do),) = found(DDS, theirs, ours)
    assert kind == "qos"
    assert "the publisher is volatile, the subscriber wants transient local" in text
    assert do == "have /tf publish with reliable, transient local, depth 1"


def test_two_types_on_one_topic_are_a_trouble_unless_a_node_has_both() -> None:
    twist = endpoint("/teleop", "publisher", TWIST)
    gateway = [endpoint("/ours", "subscriber", each) for each in (TWIST, STAMPED)]
    assert found(DDS, twist, *gateway) == []
    assert found(DDS, twist, gateway[1]) == [
        ("type", f"/teleop has the type {TWIST}, /ours {STAMPED}", "use one type at both ends"),
    ]  # fmt: skip


def test_a_client_of_another_type_than_its_server_is_a_trouble() -> None:
    server = endpoint("/ours", "server", "std_srvs/srv/SetBool")
    client = endpoint("/panel", "client", "std_srvs/srv/Trigger")
    assert [kind for kind, _, _ in found(RMW, server, client)] == ["type"]


@pytest.mark.parametrize(
    ("distro", "do"), [("jazzy", "set distro: humble"), ("humble", "set distro: jazzy")]
)
def test_over_zenoh_humble_cannot_communicate_with_newer_releases(distro: Any, do: str) -> None:
    ours = endpoint("/ours", "publisher", hash="RIHS01_a" if distro == "jazzy" else "")
    theirs = endpoint("/rviz", "subscriber", hash="" if distro == "jazzy" else "RIHS01_a")
    ((kind, text, remedy),) = found(Ros2Link(distro=distro), ours, theirs)
    humble = "/rviz" if distro == "jazzy" else "/ours"
    assert kind == "hash"
    assert text.endswith(f"{humble} has no type hashes, as on Humble")
    assert remedy.startswith(do)
    assert found(Ros2Link(transport="dds", distro=distro), ours, theirs) == []


def test_two_definitions_of_a_type_are_a_trouble_on_either_transport() -> None:
    ends = endpoint("/a", "publisher"), endpoint("/b", "subscriber", hash="RIHS01_b")
    for link in (DDS, RMW):
        ((kind, text, _),) = found(link, *ends)
        assert (kind, text) == ("hash", f"/a and /b have different definitions of {SCAN}")


def test_troubles_between_others_can_be_omitted_and_each_is_reported_once() -> None:
    others = endpoint("/a", "publisher", qos=SENSOR_DATA), endpoint("/b", "subscriber")
    assert troubles(DDS, others, ours_only=True) == []
    assert len(troubles(DDS, (*others, *others))) == 1


def test_over_dds_nodes_of_humble_have_neither_name_nor_hash() -> None:
    odd = endpoint("", "publisher", hash="")
    known = nameless(DDS, [odd, endpoint("/a", "publisher")])
    assert known
    assert known.remedy == "if they run Humble, set distro: humble"
    assert nameless(DDS, [endpoint("/a", "publisher", hash=""), endpoint("", "publisher")]) is None
    assert nameless(RMW, [odd]) is None
    assert nameless(Ros2Link(transport="dds", distro="humble"), [odd]) is None


def test_an_empty_graph_names_the_usual_reasons() -> None:
    assert "ROS_DOMAIN_ID=7" in unreached("dds", 7)
    over_zenoh = unreached("rmw_zenoh", 7, "tcp/127.0.0.1:7447")
    assert "the router tcp/127.0.0.1:7447" in over_zenoh
    assert "RMW_IMPLEMENTATION=rmw_zenoh_cpp and ROS_DOMAIN_ID=7" in over_zenoh


def test_another_node_that_offers_the_same_topics_is_reported_once() -> None:
    names = ["/odom", "/scan", "/tf", "/red/tf_static", "/joint_states", "/diagnostics"]
    goal = {"topic": "/navigate_to_pose/_action/send_goal", "type": "a/action/B_SendGoal"}
    ours = [
        *(endpoint("/gigabrain", "publisher", topic=each, ours=True) for each in names),
        endpoint("/gigabrain", "subscriber", topic="/cmd_vel", ours=True),
        endpoint("/gigabrain", "server", ours=True, **goal),
    ]
    same = [endpoint("/gigabrain", "publisher", topic=each) for each in names]
    nav2 = endpoint("/bt_navigator", "server", **goal)
    do = (
        "give each robot its own `namespace:` or `domain:`; or name in `leave_out:` what the other "
        "node offers"
    )
    assert doubles([*ours, *same, nav2]) == [
        ("twice", "/navigate_to_pose", "/bt_navigator offers it as well", do),
        ("twice", "/odom", "another /gigabrain offers it as well, and 1 more", do),
    ]
    teleop = endpoint("/teleop", "publisher", topic="/cmd_vel")
    rviz = endpoint("/rviz", "subscriber", topic="/odom")
    assert doubles([*ours, teleop, rviz]) == []
