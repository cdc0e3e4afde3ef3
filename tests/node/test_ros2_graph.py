"""The gateway's report on the ROS graph: keys of our topics, QoS mismatches, and clocks."""

import asyncio

import pytest

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import DRIVER_NODE, Ros2Config, Ros2Link
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gateway import graph_watch
from gigabrain_zenoh.gateway.gateway import serve
from gigabrain_zenoh.gateway.topic_list import rows
from gigabrain_zenoh.ros2.memory import MemoryNetwork
from gigabrain_zenoh.ros2.qos import DEFAULT
from tests.node.ros2_robot import TYPES
from tests.node.test_ros2_topics import driver

DDS = Ros2Config(transport="dds", domain=7, namespace="/red")
LASER = "sensor_msgs/msg/LaserScan"
STAMPED = "geometry_msgs/msg/TwistStamped"
SECOND_NS = 1_000_000_000


async def test_each_topic_service_and_action_of_the_gateway_has_a_key_of_ours() -> None:
    async with driver(DDS) as robot:
        await robot.body()
        found = rows(robot.node.transport.endpoints(), DDS)
        assert len(found) > 25
        assert [row.name for row in found if not row.robot_keys] == []
        assert {row.kind for row in found} == {"topic", "service", "action"}


async def problems(robot):
    """Return the problems in the gateway's health after the next check of the graph."""
    await robot.states(350)
    return [(each.code, each.text, each.remedy) for each in robot.gateway_bus.problems]


async def test_a_reader_with_a_mismatched_qos_is_a_problem_until_it_leaves() -> None:
    async with driver(DDS) as robot:
        await robot.body()
        assert await problems(robot) == []
        close = robot.node.read("/red/scan", LASER, DEFAULT)
        assert await problems(robot) == [
            ("ros2_qos",
             "/red/scan: nothing passes from /red/gigabrain to /rclpy: the publisher is best "
             "effort, the subscriber wants reliable",
             "have /rclpy subscribe with best effort, volatile, depth 5"),
        ]  # fmt: skip
        robot.node.read("/red/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        await robot.states(60)
        statuses = robot.received("/red/diagnostics")[-1].status
        (graph,) = [each for each in statuses if each.name == "gigabrain: graph"]
        assert (graph.level, graph.message.startswith("/red/scan: nothing passes")) == (1, True)
        close()
        assert await problems(robot) == []


async def test_a_second_robot_with_the_same_names_is_a_problem() -> None:
    async with driver() as robot:
        await robot.body()
        other = robot.node.transport.network.transport(Ros2Link(node="gigabrain"))
        other.publisher("odom", "nav_msgs/msg/Odometry")
        assert [text for code, text, _ in await problems(robot) if code == "ros2_twice"] == [
            "/odom: another /gigabrain offers it as well"
        ]


@pytest.mark.parametrize(
    ("before", "after", "seen"),
    [
        (set(), {"10.9.9.1"}, True),
        ({"10.9.9.1"}, {"10.8.8.1"}, True),
        ({"10.9.9.1"}, set(), False),  # it may come back
        ({"10.9.9.1"}, {"10.8.8.1", "10.9.9.1"}, False),
    ],
)
async def test_a_network_that_appears_or_changes_after_joining_dds_is_a_problem(
    before: set[str], after: set[str], seen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graph_watch, "outer_addresses", lambda: before)
    async with driver(Ros2Config(transport="dds")) as robot:
        await robot.body()
        assert await problems(robot) == []
        monkeypatch.setattr(graph_watch, "outer_addresses", lambda: after)
        found = await problems(robot)
        assert [code for code, _, _ in found] == ["ros2_network"] * seen
        if seen:
            _, text, remedy = found[0]
            assert text.startswith("the network has changed since the gateway joined DDS: then ")
            assert after.pop() in text
            assert "restart" in remedy


async def test_a_publisher_with_another_clock_is_a_problem_while_it_commands() -> None:
    async with driver() as robot:
        await robot.body()
        await robot.states(1)
        network = robot.node.transport.network
        network.now_ns = lambda: robot.clock.unix_ns() + 5 * SECOND_NS
        for _ in range(350):
            robot.node.drive()
            await robot.states(1)
        found = {each.code: each for each in robot.gateway_bus.problems}
        assert found["ros2_clock"].text == (
            "/cmd_vel: the clock of a publisher is 5.0 s ahead of this machine's clock"
        )
        assert "chrony" in found["ros2_clock"].remedy
        assert "ros2_clock" not in {code for code, _, _ in await problems(robot)}


async def test_the_gateway_reports_how_it_has_joined() -> None:
    async with driver(DDS) as robot:
        report = robot.gateway_bus.report()
        assert (report["transport"], report["domain"]) == ("dds", 7)
        assert (report["node"], report["localhost"]) == ("/red/gigabrain", 0)
        assert report["other_nodes"] == 0
        assert "ROS_DOMAIN_ID=7" in report["to_check"]
        robot.node.read("/red/scan", LASER, DEFAULT)
        assert (robot.gateway_bus.report()["other_nodes"]) == 1
        assert robot.gateway_bus.report()["to_check"] == ""


async def beside_a_driver(config: Ros2Config) -> "asyncio.Task[None]":
    """Return the task of a gateway, 2 s after the driver of a ROS 2 robot joined its domain."""
    clock, ros = FakeClock(), MemoryNetwork(TYPES)
    bus = Bus(LocalNetwork().transport(), clock, "ros2")
    running = asyncio.ensure_future(serve(config, bus, ros.transport(config), TYPES, str))
    await clock.advance(SECOND_NS)
    node = ros.transport(Ros2Link(node=DRIVER_NODE))
    node.subscribe("scan", LASER, DEFAULT, lambda _: None)
    node.publisher("cmd_vel", STAMPED)
    assert not running.done()
    await clock.advance(2 * SECOND_NS)
    return running


async def test_a_gateway_ends_if_the_driver_of_a_ros_robot_uses_its_topics() -> None:
    running = await beside_a_driver(Ros2Config())
    with pytest.raises(ExceptionGroup) as ended:
        await asyncio.wait_for(running, 1.0)
    (error,) = ended.value.exceptions
    assert isinstance(error, ConfigError)
    assert str(error) == (
        "ros2: /gigabrain_driver, whose body is a ROS 2 robot, uses /cmd_vel, /scan here as well: "
        "that robot's commands and scans would come to this one, or back to it; set another "
        "`namespace:`, such as /gigabrain, or another `domain:`"
    )


@pytest.mark.parametrize(
    "config", [Ros2Config(namespace="/gigabrain"), Ros2Config(leave_out=("scan", "cmd_vel"))]
)
async def test_a_gateway_with_other_topics_runs_beside_the_driver_of_a_ros_robot(
    config: Ros2Config,
) -> None:
    running = await beside_a_driver(config)
    assert not running.done()
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


@pytest.mark.parametrize("name", ["navigate_to_pos", "/red/map", "diagnostics", ""])
async def test_an_unknown_name_in_leave_out_is_rejected(name: str) -> None:
    config, ros = Ros2Config(leave_out=(name,)), MemoryNetwork(TYPES)
    bus = Bus(LocalNetwork().transport(), FakeClock(), "ros2")
    with pytest.raises(ConfigError, match=r"^ros2: leave_out: no name .*known: .*map, map_save"):
        await asyncio.wait_for(serve(config, bus, ros.transport(config), TYPES, str), 1.0)
