"""The driver of a ROS 2 robot, with the robot's nodes in memory and a fake clock."""

import contextlib
import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from gigabrain_drivers.bodies.ros2.driver import Ros2Driver
from gigabrain_drivers.bodies.ros2.link import RETRY_NS, all_types
from gigabrain_drivers.bodies.ros2.options import Ros2Options
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.ros2.memory import MemoryNetwork, MemoryTransport
from gigabrain_zenoh.ros2.qos import LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.transport import Received
from gigabrain_zenoh.testing.waiting import settle, until

MS = 1_000_000
STAMPED, TWIST = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
TOPICS: dict[str, Any] = {
    "command": {"type": STAMPED, "hz": 20, "step": 0.01},
    "odometry": {"hz": 20, "child_frame": "base_footprint"},
    "scan": {},
    "imu": {},
    "battery": {"full": 100},
    "joints": {},
}


class Robot:
    """The robot's nodes. It obeys a command at once."""

    def __init__(self, network: MemoryNetwork, clock: FakeClock, command: str = STAMPED) -> None:
        self.network, self.clock, self.types = network, clock, network.types
        self.obeyed: list[tuple[float, float]] = []
        self.x = self.yaw = self.speed = self.turn = 0.0
        self.child_frame, self.reports = "base_footprint", True
        self._command = command
        self.start()

    def start(self) -> None:
        self.node: MemoryTransport = self.network.transport(Ros2Link(node="turtlebot3_node"))
        self.x = self.yaw = self.speed = self.turn = 0.0
        self.node.subscribe("cmd_vel", self._command, Qos(), self._obey)
        kinds = {"odom": "nav_msgs/msg/Odometry", "imu": "sensor_msgs/msg/Imu",
                 "battery_state": "sensor_msgs/msg/BatteryState",
                 "joint_states": "sensor_msgs/msg/JointState"}  # fmt: skip
        self.publishers = {n: (self.node.publisher(n, k, Qos()), k) for n, k in kinds.items()}
        scan = "sensor_msgs/msg/LaserScan"
        self.publishers["scan"] = self.node.publisher("scan", scan, SENSOR_DATA), scan
        tf = "tf2_msgs/msg/TFMessage"
        self.publishers["/tf_static"] = self.node.publisher("/tf_static", tf, LATCHED), tf

    async def die(self) -> None:
        await self.node.__aexit__(None, None, None)
        self.publishers = {}

    def send(self, topic: str, **fields: Any) -> None:
        if topic in self.publishers:
            publisher, kind = self.publishers[topic]
            publisher.publish(self.types.encode(kind, self.types.make(kind, **fields)))

    def header(self, frame: str) -> dict[str, Any]:
        sec, nanosec = divmod(self.clock.unix_ns(), 1_000_000_000)
        return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}

    def odometry(self, **pose: float) -> None:
        half = self.yaw / 2
        at = {"position": {"x": self.x} | pose,
              "orientation": {"z": math.sin(half), "w": math.cos(half)}}  # fmt: skip
        moves = {"linear": {"x": self.speed}, "angular": {"z": self.turn}}
        self.send(
            "odom",
            header=self.header("odom"),
            child_frame_id=self.child_frame,
            pose={"pose": at},
            twist={"twist": moves},
        )

    def scan(self, ranges: list[float], frame: str = "base_scan") -> None:
        self.send(
            "scan",
            header=self.header(frame),
            angle_increment=math.tau / len(ranges),
            range_max=100.0,
            ranges=np.array(ranges, np.float32),
        )

    def _obey(self, received: Received) -> None:
        message = self.types.decode(self._command, received.payload)
        twist = message.twist if self._command == STAMPED else message
        self.speed, self.turn = twist.linear.x, twist.angular.z
        self.obeyed.append((round(self.speed, 3), round(self.turn, 3)))
        if self._command == STAMPED:
            self.stamp = message.header.stamp.sec + message.header.stamp.nanosec / 1e9


class Bench:
    """A driver, a robot, and a fake clock."""

    def __init__(self, options: Ros2Options, *, command: str = STAMPED) -> None:
        self.clock = FakeClock()
        self.network = MemoryNetwork(all_types(), self.clock.unix_ns)
        self.robot = Robot(self.network, self.clock, command)
        body = load_robot("turtlebot3_ros2")
        self.driver = Ros2Driver(
            body,
            options,
            Run(folder=Path(), link="real"),
            clock=self.clock,
            opener=lambda: self.network.transport(Ros2Link(node="gigabrain_driver")),
        )

    async def pass_ms(self, ms: int) -> None:
        """Advance the clock; the robot reports every 50 ms."""
        for _ in range(ms // 10):
            await self.clock.advance(10 * MS)
            if self.robot.reports and self.clock.now_ns() % (50 * MS) == 0:
                self.robot.x += self.robot.speed * 0.05
                self.robot.yaw += self.robot.turn * 0.05
                self.robot.odometry()
            await settle()

    async def lost_after_ms(self) -> int:
        """Advance the clock until the link is lost; return the time [ms] that it took."""
        for ms in range(0, 2000, 10):
            if not (await self.driver.read_state()).link.connected:
                return ms
            await self.pass_ms(10)
        raise AssertionError("never lost")

    async def found_after_ms(self) -> int:
        for ms in range(0, 5000, 10):
            if (await self.driver.read_state()).link.connected:
                return ms
            await self.pass_ms(10)
        raise AssertionError(f"never found: {self.driver.problem}")

    async def drive(self, ms: int, linear_x: float = 0.2, angular_z: float = 0.0) -> None:
        for _ in range(ms // 20):
            await self.driver.set_base_velocity(linear_x, 0.0, angular_z)
            await self.pass_ms(20)


def options_with(**changes: Any) -> Ros2Options:
    given = {"driver": "ros2", "transport": "dds", "watchdog": "none", "topics": TOPICS} | changes
    return msgspec.convert(given, Ros2Options)


@contextlib.asynccontextmanager
async def running(options: Ros2Options | None = None, **more: Any) -> AsyncIterator[Bench]:
    bench = Bench(options or options_with(), **more)
    await bench.driver.open()
    try:
        await until(lambda: bench.driver.link.transport, "the driver's node")
        yield bench
    finally:
        bench.robot.speed = bench.robot.turn = 0.0
        bench.driver._connected = False  # so that close waits for nothing: the clock stands still
        await bench.driver.close()


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    async with running() as bench:
        yield bench


async def test_a_robot_is_found_once_it_reports_and_takes_commands(bench: Bench) -> None:
    assert not (await bench.driver.read_state()).link.connected
    assert bench.driver.problem == "odom: no message yet"
    assert await bench.found_after_ms() <= 60
    assert (await bench.driver.read_state()).link.reconnects == 0


@pytest.mark.parametrize("error", [OSError(24, "Too many open files"), RuntimeError("no thread")])
async def test_an_error_while_joining_is_reported_and_joining_is_tried_again(
    error: Exception,
) -> None:
    bench = Bench(options_with())
    link, good = bench.driver.link, bench.driver.link._opener

    def fails() -> Any:
        raise error

    link._opener = fails
    await bench.driver.open()
    await until(lambda: str(error) in link.problem, "the fault")
    link._opener = good
    await bench.clock.advance(RETRY_NS)
    await until(lambda: link.transport, "the driver's node")
    await bench.driver.close()


async def test_commands_arrive_in_the_robots_steps_and_are_repeated(bench: Bench) -> None:
    await bench.found_after_ms()
    bench.robot.obeyed.clear()
    sent = await bench.driver.set_base_velocity(0.0999, 0.0, -1.239)
    assert (sent.linear_x, sent.angular_z) == pytest.approx((0.09, -1.23))
    assert bench.robot.obeyed == [(0.09, -1.23)]
    assert bench.robot.stamp == pytest.approx(bench.clock.unix_ns() / 1e9, abs=1e-3)
    await bench.drive(200, 0.09, -1.23)
    assert 4 <= len(bench.robot.obeyed) <= 6


async def test_a_robot_is_not_commanded_before_its_first_message(bench: Bench) -> None:
    bench.robot.reports = False
    await bench.drive(200)
    assert set(bench.robot.obeyed) <= {(0.0, 0.0)}


async def test_without_commands_the_robot_gets_zero_within_100_ms(bench: Bench) -> None:
    await bench.found_after_ms()
    await bench.drive(200)
    assert bench.robot.speed > 0.19
    await bench.pass_ms(100)
    assert bench.robot.speed == 0.0
    before = len(bench.robot.obeyed)
    await bench.pass_ms(500)
    assert 10 <= len(bench.robot.obeyed) - before <= 13  # zero is repeated


async def test_nan_and_excessive_speeds_do_not_reach_the_robot(bench: Bench) -> None:
    await bench.found_after_ms()
    sent = await bench.driver.set_base_velocity(math.nan, 0.0, 1.0)
    assert (sent.linear_x, sent.angular_z) == (0.0, 0.0)
    sent = await bench.driver.set_base_velocity(9.0, 0.0, 0.0)
    assert sent.linear_x == pytest.approx(0.21)


async def test_a_silent_robot_is_stopped_lost_and_found_again(bench: Bench) -> None:
    await bench.found_after_ms()
    await bench.drive(200)
    bench.robot.reports = False
    assert await bench.lost_after_ms() <= 250
    assert "odom: no message for" in bench.driver.problem
    assert bench.robot.speed == 0.0
    bench.robot.reports = True
    assert await bench.found_after_ms() <= 3000
    assert (await bench.driver.read_state()).link.reconnects == 1


async def test_a_robot_whose_nodes_died_is_lost_and_found_again(bench: Bench) -> None:
    await bench.found_after_ms()
    await bench.drive(1000)
    pose = (await bench.driver.read_state()).pose
    assert pose.x > 0.15
    await bench.robot.die()
    assert await bench.lost_after_ms() <= 250
    bench.robot.start()  # its odometry begins at 0
    assert await bench.found_after_ms() <= 3000
    assert (await bench.driver.read_state()).pose.x == pytest.approx(pose.x, abs=0.02)


async def test_a_reset_of_the_odometry_loses_the_link_for_a_moment(bench: Bench) -> None:
    await bench.found_after_ms()
    await bench.drive(1000)
    pose = (await bench.driver.read_state()).pose
    bench.robot.x = 0.0
    assert await bench.lost_after_ms() <= 250
    assert "was the robot restarted" in bench.driver.problem
    assert await bench.found_after_ms() <= 3000
    assert (await bench.driver.read_state()).pose.x == pytest.approx(pose.x, abs=0.03)


async def test_nan_in_the_odometry_loses_the_link(bench: Bench) -> None:
    await bench.found_after_ms()
    bench.robot.odometry(x=math.nan)
    assert await bench.lost_after_ms() <= 250
    assert "NaN" in bench.driver.problem
    assert await bench.found_after_ms() <= 3000


async def test_odometry_with_another_child_frame_is_rejected_by_name(bench: Bench) -> None:
    bench.robot.child_frame = "camera"
    await bench.pass_ms(100)
    assert "its child frame is 'camera'; expected 'base_footprint'" in bench.driver.problem


async def test_a_robot_without_a_subscriber_of_our_type_is_a_problem() -> None:
    async with running(command=TWIST) as bench:
        await bench.pass_ms(200)
        assert bench.driver.problem == "cmd_vel: no node takes our commands"


async def test_a_robot_that_takes_twist_without_a_stamp_is_driven() -> None:
    topics = TOPICS | {"command": {"type": TWIST}}
    async with running(options_with(topics=topics), command=TWIST) as bench:
        await bench.found_after_ms()
        await bench.drive(100, 0.123)
        assert bench.robot.speed == 0.123


async def test_all_sensors_are_converted_to_our_messages(bench: Bench) -> None:
    await bench.found_after_ms()
    robot = bench.robot
    robot.scan([1.0] * 230)
    robot.send("imu", angular_velocity={"z": 0.5}, linear_acceleration={"z": 9.81})
    robot.send("battery_state", voltage=12.0, percentage=83.3)
    robot.send("joint_states", name=["wheel_left_joint"], position=[1.5], velocity=[2.0])
    state = await bench.driver.read_state()
    assert state.battery
    assert state.battery.percentage == pytest.approx(83.3)
    assert state.joints[0].position == 1.5
    assert state.imu
    assert state.imu.angular_velocity == (0.0, 0.0, 0.5)
    scan = await bench.driver.get_sensor_data("scan")
    assert isinstance(scan, LaserScan)
    assert len(np.frombuffer(scan.ranges, "<f4")) == 220
    assert (await bench.driver.get_sensor_data("imu")) is not None


async def test_an_inertial_unit_without_orientation_is_logged_once(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    await bench.found_after_ms()
    for _ in range(3):
        bench.robot.send("imu", orientation_covariance=np.array([-1.0] + [0.0] * 8))
    state = await bench.driver.read_state()
    assert state.imu
    assert state.imu.orientation == (0.0, 0.0, 0.0, 0.0)
    assert [each for each in caplog.messages if "tilt_stop" in each] == [
        "imu: it has no orientation (orientation_covariance[0] is -1), so tilt_stop cannot stop "
        "the robot; have a filter add it, such as imu_filter_madgwick, and write its topic as "
        "topics.imu.name"
    ]
    bench.robot.send("imu")
    assert "imu: it has an orientation" in caplog.messages


async def test_values_of_silent_sensors_are_no_longer_reported(bench: Bench) -> None:
    await bench.found_after_ms()
    for _ in range(5):
        bench.robot.send("imu", linear_acceleration={"z": 9.81})
        bench.robot.send("battery_state", voltage=12.0, percentage=83.3)
        bench.robot.send("joint_states", name=["wheel_left_joint"], position=[1.5])
        await bench.pass_ms(200)
    before = await bench.driver.read_state()
    assert before.imu
    assert before.battery
    assert before.joints
    await bench.pass_ms(2000)
    after = await bench.driver.read_state()
    assert (after.imu, after.battery, after.joints) == (None, None, ())
    assert after.link.connected


async def test_malformed_messages_are_dropped_and_counted(bench: Bench) -> None:
    await bench.found_after_ms()
    bench.robot.publishers["scan"][0].publish(b"\0\1\0\0nonsense")
    bench.robot.scan([1.0])
    assert (await bench.driver.get_sensor_data("scan")) is None or bench.driver.link.errors
    assert (await bench.driver.read_state()).link.errors == 1


def link(types: Any, parent: str, child: str, x: float, yaw: float) -> dict[str, Any]:
    turned = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    return {
        "header": {"frame_id": parent},
        "child_frame_id": child,
        "transform": {"translation": {"x": x}, "rotation": turned},
    }


async def test_with_tf_static_scans_are_transformed_by_the_robots_frames() -> None:
    async with running(options_with(mounting="tf_static")) as bench:
        robot = bench.robot
        robot.scan([1.0, 9.0, 9.0, 9.0])
        assert await bench.driver.get_sensor_data("scan") is None  # its frame is not known yet
        await bench.pass_ms(60)
        assert "/tf_static does not connect 'base_footprint'" not in bench.driver.problem
        robot.send(
            "/tf_static",
            transforms=[
                link(robot.types, "base_footprint", "base_link", 0.0, 0.0),
                link(robot.types, "base_link", "base_scan", -0.032, math.pi),
            ],
        )
        assert await bench.found_after_ms() <= 3000
        robot.scan([1.0, 2.0, 3.0, 4.0])
        scan = await bench.driver.get_sensor_data("scan")
        assert isinstance(scan, LaserScan)
        ranges = np.frombuffer(scan.ranges, "<f4")
        assert ranges[[110, 165, 0, 55]] == pytest.approx([1.0, 2.0, 3.0, 4.0])


async def test_closing_sends_zero_until_the_robot_is_at_rest(bench: Bench) -> None:
    await bench.found_after_ms()
    await bench.drive(200)
    bench.robot.obeyed.clear()
    await bench.driver.stop()
    assert bench.robot.obeyed == [(0.0, 0.0)]
