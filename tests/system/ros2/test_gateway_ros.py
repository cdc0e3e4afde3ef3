"""A whole robot with the gateway, in processes, read and driven by real ROS 2 over DDS."""

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import pytest
import pytest_asyncio

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.topics import STATE
from gigabrain_zenoh.client.requests import press_estop, release
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import BodyLost, Refused
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import Home, free_port
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.judge import Judge

pytestmark = pytest.mark.asyncio(loop_scope="module")
STAMPED = "geometry_msgs/msg/TwistStamped"
TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
DEFAULT: dict[str, Any] = {}
SENSOR = {"reliable": False, "depth": 5}
LATCHED = {"transient_local": True, "depth": 1}
READ = {
    "/scan": ("sensor_msgs/msg/LaserScan", SENSOR),
    "/odom": ("nav_msgs/msg/Odometry", DEFAULT),
    "/tf": ("tf2_msgs/msg/TFMessage", {"depth": 100}),
    "/tf_static": ("tf2_msgs/msg/TFMessage", LATCHED),
    "/joint_states": ("sensor_msgs/msg/JointState", DEFAULT),
    "/battery_state": ("sensor_msgs/msg/BatteryState", DEFAULT),
    "/robot_description": ("std_msgs/msg/String", LATCHED),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", DEFAULT),
    "/clock": ("rosgraph_msgs/msg/Clock", {"reliable": False, "depth": 1}),
}


class Robot:
    """A running robot, with the states from its bus."""

    def __init__(self, home: Home, bus: Any, router: str) -> None:
        self.home, self.bus, self.router = home, bus, router
        self.states: list[RobotState] = []
        bus.subscribe(STATE, lambda _, state: self.states.append(state))

    @property
    def now(self) -> RobotState:
        """The newest state."""
        return self.states[-1]

    async def becomes(self, mode: str) -> None:
        """Wait until the gate has a mode."""
        await until(lambda: self.states and self.now.gate.mode == mode, mode)


@contextlib.asynccontextmanager
async def running(home: Home, judge: Judge | None, **parts: Any) -> AsyncIterator[Robot]:
    """Yield a robot whose gateway joins the judge's domain; without a judge, its own router."""
    router = f"tcp/127.0.0.1:{free_port()}"
    parts = {"body": "turtlebot3_burger", "world": "arena"} | parts
    given: dict[str, Any] = {"transport": "rmw_zenoh"}
    if judge:
        given = {"transport": "dds", "domain": judge.domain, "localhost": True}
    parts["ros2"] = parts.get("ros2", {}) | given
    file = home.deployment(router=router, **parts)
    home.start("up", str(file))
    session = connect(Endpoint(connect=(router,)), "test", timeout_s=None)
    async with asyncio.timeout(400), session as bus:
        made = Robot(home, bus, router)
        await until(lambda: home.processes("ros2"), "the gateway runs")
        await until(lambda: made.states, "states")
        yield made


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def robot(shared_home: Home, shared_judge: Judge) -> AsyncIterator[Robot]:
    """A robot that the tests share; each test starts its own programs."""
    async with running(shared_home, shared_judge) as made:
        await made.becomes("latched")
        yield made


@pytest.fixture
def judge(shared_judge: Judge) -> Iterator[Judge]:
    """The domain that the tests share; the programs end with the test."""
    yield shared_judge
    shared_judge.close()


async def released(robot: Robot) -> None:
    """Release the robot, as soon as it has been at rest for long enough."""
    while robot.now.gate.mode == "latched":
        with contextlib.suppress(Refused, BodyLost):
            await release(robot.bus, robot.now.gate.estop_generation)
        count = len(robot.states)
        await until(lambda: len(robot.states) > count + 10, "states")  # noqa: B023


async def driving(robot: Robot, driver: Any, **how: Any) -> None:
    """Let a program drive; if the gate of a busy machine stops it, pause and try again."""
    while True:
        await driver.query("drive", linear=0.15, hz=20.0, **how)
        with contextlib.suppress(TimeoutError):
            await until(lambda: robot.now.velocity.linear_x > 0.12, "it drives", 10.0)
            return
        await driver.query("rest")
        await asyncio.sleep(1.0)


async def diagnosed(judge: Judge) -> Callable[[str], str]:
    """Return a function that returns the newest text of a status in /diagnostics, by name."""
    listener = judge.start("listen", node="diagnosed")
    kind, qos = READ["/diagnostics"]
    await listener.query("subscribe", topic="/diagnostics", type=kind, qos=qos, stream=True)

    def text(name: str) -> str:
        received = listener.seen("message", topic="/diagnostics")
        lines = received[-1]["value"]["status"] if received else []
        return next((each["message"] for each in lines if each["name"] == f"gigabrain: {name}"), "")

    return text


def frames(transforms: Any) -> set[str]:
    return {each["child_frame_id"] for each in transforms["transforms"]}


def complete(report: Any) -> bool:
    """Return whether a message has arrived; one with frames must have more than the base's.

    The gateway knows the body's description up to a second later than the first state.
    """
    if not report["count"]:
        return False
    newest = report["values"][-1]
    return "transforms" not in newest or len(frames(newest)) > 1


async def test_rclpy_receives_topics_with_values_frames_and_qos(robot: Robot, judge: Judge) -> None:
    listener = judge.start("listen")
    for topic, (kind, qos) in READ.items():
        await listener.query("subscribe", topic=topic, type=kind, qos=qos)
    values: dict[str, Any] = {}
    for topic in READ:
        report = await asyncio.to_thread(listener.poll, "report", complete, topic=topic)
        values[topic] = report["values"][-1]
    scan = values["/scan"]
    assert (scan["header"]["frame_id"], len(scan["ranges"])) == ("base_scan", 360)
    assert scan["range_max"] == pytest.approx(3.5)
    odom = values["/odom"]
    assert (odom["header"]["frame_id"], odom["child_frame_id"]) == ("odom", "base_footprint")
    assert frames(values["/tf"]) == {"base_footprint", "wheel_left_link", "wheel_right_link"}
    assert frames(values["/tf_static"]) == {"base_link", "imu_link", "base_scan"}
    assert values["/joint_states"]["name"] == ["wheel_left_joint", "wheel_right_joint"]
    assert 0.0 < values["/battery_state"]["percentage"] <= 1.0
    assert values["/robot_description"]["data"].startswith("<?xml")
    names = {each["name"] for each in values["/diagnostics"]["status"]}
    assert {"gigabrain: gate", "gigabrain: safety", "gigabrain: cmd_vel"} <= names
    stamp, now = odom["header"]["stamp"], values["/clock"]["clock"]
    assert abs(stamp["sec"] - now["sec"]) <= 2


async def test_rclpy_drives_by_cmd_vel_and_the_body_stops_if_it_is_killed(
    robot: Robot, judge: Judge
) -> None:
    await released(robot)
    driver = judge.start("drive")
    await driving(robot, driver)
    assert robot.now.gate.commander == "ros2"
    driver.kill()
    await until(lambda: abs(robot.now.velocity.linear_x) < 0.01, "it stands")
    await robot.becomes("idle")
    assert robot.now.gate.commander == ""


async def test_a_stamped_twist_drives_unless_its_stamp_is_old(robot: Robot, judge: Judge) -> None:
    await released(robot)
    driver, text = judge.start("drive"), await diagnosed(judge)
    await driving(robot, driver, type=STAMPED)
    assert robot.now.gate.commander == "ros2"
    await driver.query("drive", linear=0.15, type=STAMPED, late_s=5.0)
    await until(lambda: "stamp is 5." in text("cmd_vel"), "it is named")
    await until(lambda: abs(robot.now.velocity.linear_x) < 0.01, "it stands")
    await driver.query("rest")
    await robot.becomes("idle")


async def test_enable_lets_the_brain_drive_and_commands_of_ros_are_refused(
    robot: Robot, judge: Judge
) -> None:
    await released(robot)
    driver, caller = judge.start("drive"), judge.start("call", node="caller")
    text = await diagnosed(judge)
    await caller.available(service="/enable", type=TRIGGER)
    while robot.now.gate.commander != "control":  # on a busy machine the gate may stop it
        name = f"enable-{len(caller.seen('response'))}"
        await caller.query("call", service="/enable", type=TRIGGER, name=name)
        assert (await caller.wait_async("response", name=name))["value"]["success"]
        count = len(robot.states)
        await until(lambda: len(robot.states) > count + 10, "states")  # noqa: B023
    await driver.query("drive", linear=0.15)
    await until(lambda: "control drives; end that first" in text("cmd_vel"), "it is named")
    assert robot.now.gate.commander in ("control", "")
    await driver.query("rest")
    await press_estop(robot.bus, "a test")
    await robot.becomes("latched")


async def test_rclpy_stops_and_releases_by_services(robot: Robot, judge: Judge) -> None:
    await released(robot)
    driver, caller = judge.start("drive"), judge.start("call", node="caller")
    await driving(robot, driver)
    await caller.available(service="/estop", type=SET_BOOL)
    await caller.query("call", service="/estop", type=SET_BOOL, data=True)
    response = await caller.wait_async("response", service="/estop")
    assert response["value"]["success"]
    await until(lambda: robot.now.gate.mode == "latched", "it is latched")
    await until(lambda: robot.now.velocity.linear_x < 0.01, "it stands")
    await caller.query("call", service="/estop", type=SET_BOOL, data=False, name="undo")
    refused = await caller.wait_async("response", name="undo")
    assert not refused["value"]["success"]
    await driver.query("rest")
    await asyncio.sleep(1.0)
    await caller.available(service="/release", type=TRIGGER)
    await caller.query("call", service="/release", type=TRIGGER)
    response = await caller.wait_async("response", service="/release")
    assert response["value"]["success"], response
    await robot.becomes("idle")


async def test_a_killed_gateway_does_not_disturb_the_robot_and_ros_finds_it_again(
    robot: Robot, judge: Judge
) -> None:
    listener = judge.start("listen")
    kind, qos = READ["/odom"]
    await listener.query("subscribe", topic="/odom", type=kind, qos=qos)
    await asyncio.to_thread(listener.poll, "report", lambda each: each["count"] > 5, topic="/odom")
    (before,) = robot.home.processes("ros2")
    others = set(robot.home.processes()) - {before}
    os.kill(before, signal.SIGKILL)
    await until(lambda: robot.home.processes("ros2") not in ([], [before]), "it is restarted")
    count = (await listener.query("report", topic="/odom"))["count"]
    await asyncio.to_thread(
        listener.poll, "report", lambda each: each["count"] > count + 20, topic="/odom"
    )
    assert others <= set(robot.home.processes())
