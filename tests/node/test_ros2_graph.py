"""The gateway's report on the ROS graph: our keys, QoS mismatches, and clocks."""

from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.gateway.topic_list import rows
from gigabrain_zenoh.ros2.qos import DEFAULT
from tests.node.test_ros2_topics import driver

DDS = Ros2Config(transport="dds", domain=7, namespace="/red")
LASER = "sensor_msgs/msg/LaserScan"
SECOND_NS = 1_000_000_000


async def test_each_topic_service_and_action_of_the_gateway_has_a_key_of_ours() -> None:
    async with driver(DDS) as robot:
        await robot.body()
        found = rows(robot.node.transport.endpoints(), DDS)
        assert len(found) > 25
        assert [row.name for row in found if not row.robot_keys] == []
        assert {row.kind for row in found} == {"topic", "service", "action"}


async def problems(robot):
    """Return the problems in the gateway's health once it has looked at the graph again."""
    await robot.states(350)
    return [(one.code, one.text, one.remedy) for one in robot.gateway_bus.problems]


async def test_a_reader_that_wants_more_is_a_problem_until_it_goes() -> None:
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
        statuses = robot.got("/red/diagnostics")[-1].status
        (graph,) = [one for one in statuses if one.name == "gigabrain: graph"]
        assert (graph.level, graph.message.startswith("/red/scan: nothing passes")) == (1, True)
        close()
        assert await problems(robot) == []


async def test_a_commander_with_another_clock_is_a_problem_while_it_commands() -> None:
    async with driver() as robot:
        await robot.body()
        await robot.states(1)
        network = robot.node.transport.network
        network.now_ns = lambda: robot.clock.unix_ns() + 5 * SECOND_NS
        for _ in range(350):
            robot.node.drive()
            await robot.states(1)
        found = {one.code: one for one in robot.gateway_bus.problems}
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
