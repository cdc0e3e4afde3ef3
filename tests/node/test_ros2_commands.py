"""ROS drives a robot in memory: /cmd_vel through the gate, e-stop and release, in ticks."""

import math

import pytest

from gigabrain_schemas.requests import EnableRequest, MapReply
from gigabrain_schemas.topics import ENABLE, MAP_SAVE, STATE
from gigabrain_zenoh.client import requests
from gigabrain_zenoh.client.requests import enable
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.testing.in_memory import ticks_until
from tests.node.ros2_robot import RosRobot

TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """Prevent that a slow disk of this machine delays the answer, and the e-stop is repeated."""
    monkeypatch.setattr(requests, "FIRST_S", 1.9)


async def released(robot):
    """Let the robot start, and release it by the ROS service."""
    await robot.go(60)
    assert (await robot.node.call("/release", TRIGGER)).success
    await robot.go(5)
    assert robot.mode == "idle"


async def test_the_first_command_enables_and_the_body_follows(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(10, x=0.0)
        assert robot.mode == "idle"
        speeds = await robot.streams(50)
        assert robot.mode == "enabled"
        assert robot.state.gate.commander == "ros2"
        assert speeds[-1] == pytest.approx(0.2)
        assert robot.gateway_bus.rejected.total() == 0


@pytest.mark.parametrize("every", [1, 2, 5, 10])
async def test_a_killed_publisher_brakes_the_body_within_120_ms_of_its_period(tmp_path, every):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(100, every)
        speeds = await robot.go(60)  # the last command is a period old, less a tick
        assert speeds[0] == pytest.approx(0.2)
        braking = ticks_until(speeds, lambda speed: speed < 0.199)
        assert braking - 1 <= 1 + 120 / 20
        assert speeds[-1] == 0.0
        assert "silence" not in robot.causes or robot.mode == "idle"


async def test_a_late_publisher_neither_brakes_the_body_nor_loses_it(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(100, 5)
        speeds = [*await robot.go(3), *await robot.streams(100, 5)]  # 160 ms once
        assert min(speeds) == pytest.approx(0.2)
        await robot.go(12)  # 340 ms: it brakes, but stays enabled
        assert robot.mode == "enabled"
        assert (await robot.streams(40, 5))[-1] == pytest.approx(0.2)
        assert robot.state.gate.enables == 1


async def test_the_body_is_idle_within_half_a_second_after_the_last_command(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(50)
        await robot.go(25)
        assert robot.state.gate.commander == "ros2"
        await robot.go(22)
        assert (robot.mode, robot.state.gate.commander) == ("idle", "")
        assert (await robot.streams(30))[-1] == pytest.approx(0.2)


async def test_while_the_brain_drives_commands_of_ros_are_refused_and_reported(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.go(50)
        await enable(robot.operator, "control")
        await robot.go(5)
        robot.node.read("/diagnostics", DIAGNOSTICS)
        await robot.streams(60, x=-0.2)
        assert robot.state.gate.commander == "control"
        status = {each.name: each for each in robot.node.received["/diagnostics"][-1].status}
        found = status["gigabrain: cmd_vel"]
        assert found.level == 1
        assert "control drives" in found.message
        assert robot.gateway_bus.counters["cmd_vel_commander"] == 30
        (problem,) = robot.gateway_bus.problems
        assert problem.code == "ros2_cmd_vel"


async def test_with_the_setting_take_ros_takes_the_body_from_the_brain(tmp_path):
    async with RosRobot(tmp_path, config=Ros2Config(take=True)) as robot:
        await released(robot)
        await robot.go(50)
        await enable(robot.operator, "control")
        await robot.go(20)
        speeds = await robot.streams(60, x=-0.1)
        assert robot.state.gate.commander == "ros2"
        assert speeds[-1] == pytest.approx(-0.1)


async def test_a_body_that_another_has_taken_is_not_taken_back(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(50)
        request = EnableRequest(source="ann", take=True)
        (reply,) = await robot.operator.ask(ENABLE, request)
        assert reply.ok
        await robot.streams(100)
        assert robot.state.gate.commander == ""  # ann has sent nothing
        assert robot.mode == "idle"
        assert (await robot.streams(50))[-1] == 0.0
        await robot.streams(4, x=0.0)
        assert (await robot.streams(40))[-1] == pytest.approx(0.2)


@pytest.mark.parametrize("x", [math.nan, math.inf])
async def test_nan_never_reaches_the_wheels_and_brakes(tmp_path, x):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(50)
        speeds = await robot.streams(30, x=x)
        assert speeds[-1] == 0.0
        assert robot.gateway_bus.counters["cmd_vel_not_finite"] == 15
        assert robot.counters["refused_not_finite"] == 0


async def test_broken_payloads_are_counted_and_move_nothing(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        publisher = robot.node.transport.publisher("/cmd_vel", "geometry_msgs/msg/Twist")
        for payload in (b"", b"\x00\x01\x00\x00", b"\xff" * 60, b"\x00\x01\x00\x00" + b"\x01" * 20):
            publisher.publish(payload)
        assert (await robot.go(10))[-1] == 0.0
        assert robot.gateway_bus.counters["cmd_vel_broken"] == 4
        assert (await robot.streams(30))[-1] == pytest.approx(0.2)


def stamped(robot, age_ms, x=0.2, frame="base_link"):
    at = robot.state.stamp_ns - age_ms * 1_000_000
    stamp = {"sec": at // 10**9, "nanosec": at % 10**9}
    robot.node.publish(
        "/cmd_vel", "geometry_msgs/msg/TwistStamped",
        header={"stamp": stamp, "frame_id": frame}, twist={"linear": {"x": x}},
    )  # fmt: skip


async def test_a_stamped_twist_is_refused_by_its_stamp_if_old_or_in_the_future(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        for age_ms, code in ((300, "stale"), (-200, "future")):
            for _ in range(20):
                stamped(robot, age_ms)
                assert (await robot.go(1))[-1] == 0.0
            assert robot.gateway_bus.counters[f"cmd_vel_{code}"] == 20
        for _ in range(50):
            stamped(robot, 20)
            speeds = await robot.go(1)
        assert speeds[-1] == pytest.approx(0.2)
        assert robot.mode == "enabled"


async def test_a_sideways_command_is_refused_by_a_body_that_cannot_do_it(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        for _ in range(30):
            robot.node.drive(0.0, y=0.3)
            await robot.go(1)
        assert robot.mode == "idle"
        assert robot.gateway_bus.counters["cmd_vel_sideways"] == 30


async def test_a_gateway_that_dies_while_it_drives_stops_the_body(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(50)
        await robot._stack.aclose()
        speeds = await robot.go(40)
        assert ticks_until(speeds, lambda speed: speed < 0.199) <= 7
        assert speeds[-1] == 0.0
        assert robot.mode == "idle"


async def test_an_estop_from_ros_stops_the_body_within_a_tick(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(50)
        response = await robot.node.call("/estop", SET_BOOL, data=True)
        assert response.success
        assert "e-stop number 1" in response.message
        speeds = await robot.streams(40)
        assert speeds[1] == 0.0
        assert robot.mode == "latched"
        assert robot.causes == ["estop"]


async def test_only_the_service_release_ends_an_estop(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(50)
        await robot.node.call("/estop", SET_BOOL, data=True)
        await robot.go(2)
        refused = await robot.node.call("/estop", SET_BOOL, data=False)
        assert not refused.success
        assert "release" in refused.message
        refused = await robot.node.call("/release", TRIGGER)
        assert (refused.success, "at rest" in refused.message) == (False, True)
        await robot.go(30)
        assert robot.mode == "latched"
        response = await robot.node.call("/release", TRIGGER)
        assert response.success
        await robot.go(1)
        assert robot.mode == "idle"


async def test_commands_that_continue_through_estop_and_release_move_nothing(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(50)
        await robot.node.call("/estop", SET_BOOL, data=True)
        await robot.streams(40)
        assert (await robot.node.call("/release", TRIGGER)).success
        assert max(await robot.streams(100)) == 0.0
        await robot.go(25)
        assert (await robot.streams(40))[-1] == pytest.approx(0.2)


async def test_enable_lets_the_brain_drive_and_takes_the_body_from_ros_alone(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.streams(50)
        response = await robot.node.call("/enable", TRIGGER)
        assert response.success
        await robot.streams(20)
        assert robot.state.gate.commander == "control"
        (reply,) = await robot.operator.ask(ENABLE, EnableRequest(source="ann", take=True))
        assert reply.ok
        response = await robot.node.call("/enable", TRIGGER)
        assert (response.success, "ann drives" in response.message) == (False, True)


async def test_services_name_the_driver_when_it_is_silent(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await robot.go(20)
        await robot.kill("driver")
        await robot.clock.advance(1_000_000_000)
        response = await robot.node.call("/release", TRIGGER)
        assert (response.success, "driver" in response.message) == (False, True)
        robot.node.drive()
        await robot.clock.advance(20_000_000)
        assert robot.gateway_bus.counters["cmd_vel_no_robot"] == 1


async def test_map_save_names_the_setting_that_makes_a_map(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await robot.go(5)
        response = await robot.node.call("/map_save", TRIGGER)
        assert (response.success, "mapping: slam" in response.message) == (False, True)


async def test_maps_that_are_saved_within_a_second_have_different_names(tmp_path):
    async with RosRobot(tmp_path) as robot:
        names = []

        async def save(request):
            names.append(request.name)
            return MapReply(ok=True, text="saved")

        robot.operator.serve(MAP_SAVE, save)
        for _ in range(3):
            await robot.go(5)
            assert (await robot.node.call("/map_save", TRIGGER)).success
        assert len(set(names)) == 3


async def test_the_gateway_sends_only_its_health_without_commands(tmp_path):
    async with RosRobot(tmp_path) as robot:
        await released(robot)
        await robot.go(100)
        assert robot.gateway_bus.sent.keys() <= {"robot/health/ros2"}
        assert STATE.key in robot.gateway_bus.received
