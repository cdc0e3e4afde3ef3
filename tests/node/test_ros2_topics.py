"""Each topic of the gateway, read by a ROS node in memory: type, QoS, rate, content."""

import math
from contextlib import asynccontextmanager

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import Camera, Joint
from gigabrain_schemas.brain import OccupancyGrid, PoseInMap
from gigabrain_schemas.safety import Health, SafetyState
from gigabrain_schemas.sensors import Image, Imu, ImuData
from gigabrain_schemas.tasks import Goal, TaskStatus
from gigabrain_schemas.topics import (
    BODY,
    DEPTH,
    HEALTH,
    IMAGE,
    IMU,
    MAP,
    POSE,
    SAFETY,
    SCAN,
    STATE,
    TASK,
)
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.ros2.qos import DEFAULT, LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.testing import samples
from tests.node.ros2_robot import TICK_NS, RosNode, gateway_on

CAMERAS = (
    Camera(name="front", width=16, height=16, depth=True, x=0.1, z=0.2),
    Camera(name="rear", width=16, height=16),
)
BURGER = replace(samples.WAFFLE, wheel_separation=0.16, wheel_radius=0.033, cameras=CAMERAS)
GRID = OccupancyGrid(
    resolution=0.1, width=2, height=1, origin_x=0.0, origin_y=0.0, cells=b"\x64\xff"
)
JPEG = Image(frame_id="front", encoding="jpeg", height=16, width=16, data=b"\xff\xd8jpeg")
DEPTH_PICTURE = DepthImage(
    frame_id="front", height=16, width=16, planes=pack_depth(np.full((16, 16), 750, np.uint16))
)
READING = Imu(
    orientation=(0.0, 0.0, 0.0, 1.0),
    angular_velocity=(0.0, 0.0, 0.1),
    linear_acceleration=(1.0, 0.0, 9.8),
)
ABOUT = "sensor_msgs/msg/CameraInfo"
PICTURE, RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
TF, DIAGNOSTICS = "tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray"
TABLE = {
    "/scan": ("sensor_msgs/msg/LaserScan", SENSOR_DATA),
    "/odom": ("nav_msgs/msg/Odometry", DEFAULT),
    "/tf": (TF, Qos(depth=100)),
    "/tf_static": (TF, LATCHED),
    "/map": ("nav_msgs/msg/OccupancyGrid", LATCHED),
    "/imu": ("sensor_msgs/msg/Imu", SENSOR_DATA),
    "/joint_states": ("sensor_msgs/msg/JointState", DEFAULT),
    "/battery_state": ("sensor_msgs/msg/BatteryState", DEFAULT),
    "/plan": ("nav_msgs/msg/Path", DEFAULT),
    "/diagnostics": (DIAGNOSTICS, DEFAULT),
    "/robot_description": ("std_msgs/msg/String", LATCHED),
    "/camera/image/compressed": (PICTURE, SENSOR_DATA),
    "/camera/camera_info": (ABOUT, SENSOR_DATA),
    "/camera/depth/image_raw": (RAW, SENSOR_DATA),
    "/camera/depth/camera_info": (ABOUT, SENSOR_DATA),
    "/camera/rear/image/compressed": (PICTURE, SENSOR_DATA),
    "/camera/rear/camera_info": (ABOUT, SENSOR_DATA),
    "/clock": ("rosgraph_msgs/msg/Clock", Qos(reliable=False, depth=1)),
}


class Driver:
    """A stand-in for a robot's processes, which publishes their messages."""

    def __init__(self, bus, gateway_bus, node, clock):
        self.bus, self.gateway_bus, self.node, self.clock, self.tick = (
            bus,
            gateway_bus,
            node,
            clock,
            0,
        )
        bus.time.boot = samples.BOOT

    async def publish(self, topic, message, **about):
        self.bus.time.tick = self.tick
        self.bus.publish(topic, message, **about)
        await self.clock.advance(0)

    async def body(self, about=BURGER, *, real=False):
        await self.publish(BODY, samples.body(about, real=real))

    async def states(self, count=1, **about):
        for _ in range(count):
            self.tick += 1
            changed = {name: about[name] for name in ("imu", "joints") if name in about}
            plain = {name: value for name, value in about.items() if name not in changed}
            await self.publish(STATE, replace(samples.state(self.tick, **plain), **changed))
            await self.clock.advance(TICK_NS)

    def read(self, topic, qos=None):
        """Subscribe with the QoS of ROS tools, unless `qos` is given."""
        kind, offered = TABLE[topic]
        return self.node.read(topic, kind, qos or offered)

    def received(self, topic):
        return self.node.received[topic]


@asynccontextmanager
async def driver(config=None):
    network, clock = LocalNetwork(), FakeClock()
    async with gateway_on(network, clock, config) as (gateway_bus, ros):
        bus = Bus(network.transport(), clock, "driver")
        yield Driver(bus, gateway_bus, RosNode(ros, clock), clock)
        await bus.close()


async def test_the_topics_have_the_types_and_qos_that_ros_tools_expect():
    async with driver() as robot:
        await robot.body()
        assert robot.node.topics() == TABLE


SERVED = {
    "/estop": "std_srvs/srv/SetBool",
    "/release": "std_srvs/srv/Trigger",
    "/enable": "std_srvs/srv/Trigger",
    "/map_save": "std_srvs/srv/Trigger",
}


async def test_services_actions_and_parameters_have_the_names_that_ros_tools_expect():
    async with driver() as robot:
        servers = {
            each.topic: each.type
            for each in robot.node.transport.endpoints()
            if not each.ours and each.kind == "server"
        }
        assert SERVED.items() <= servers.items()
        actions = {"navigate_to_pose", "navigate_through_poses"}
        goals = {f"/{name}/_action/send_goal" for name in actions}
        parameters = {"/gigabrain/get_parameters", "/gigabrain/list_parameters"}
        assert goals | parameters <= set(servers)


async def test_topics_have_the_namespace_and_those_in_leave_out_are_missing():
    config = Ros2Config(namespace="/robot1", leave_out=("scan", "/camera/depth/image_raw"))
    async with driver(config) as robot:
        await robot.body()
        left = set(TABLE) - {"/scan", "/camera/depth/image_raw"}
        assert set(robot.node.topics()) == {f"/robot1{topic}" for topic in left}


async def publish_everything(robot):
    """Publish every message that the gateway can pass on."""
    await robot.body()
    await robot.states(3)
    for topic, message, name in (
        (IMU, READING, ""), (SCAN, samples.scan(samples.open_space()), ""), (MAP, GRID, ""),
        (TASK, TaskStatus(path=((0.0, 0.0), (1.0, 0.0))), ""),
        (IMAGE, JPEG, "front"), (IMAGE, replace(JPEG, frame_id="rear"), "rear"),
        (DEPTH, DEPTH_PICTURE, "front"), (SAFETY, SafetyState(verdict="ok"), ""),
    ):  # fmt: skip
        await robot.publish(topic, message, name=name)
    await robot.clock.advance(1_100_000_000)


async def test_topics_without_a_reader_are_neither_received_nor_encoded():
    async with driver() as robot:
        await publish_everything(robot)
        assert robot.gateway_bus.counters["published"] == 0
        unread = {"scan", "map", "imu", "task", "image/front", "depth/front", "health/*", "safety"}
        listens = set(robot.gateway_bus.listens)
        assert listens.isdisjoint({f"robot/{key}" for key in unread})


@pytest.mark.parametrize("topic", TABLE)
async def test_a_topic_is_published_from_its_first_reader_until_the_last_leaves(topic):
    async with driver() as robot:
        await robot.body()
        before = sorted(robot.gateway_bus.listens)
        close = robot.read(topic)
        other = robot.read(topic)
        await publish_everything(robot)
        count = len(robot.received(topic))
        assert count >= 2  # one for each reader
        assert robot.gateway_bus.counters["published"] == count / 2
        close()
        assert len(robot.gateway_bus.listens) >= len(before)
        other()
        assert sorted(robot.gateway_bus.listens) == before
        await publish_everything(robot)
        assert len(robot.received(topic)) == count


@pytest.mark.parametrize("topic", ["/map", "/tf_static", "/robot_description"])
async def test_late_readers_receive_the_latched_message(topic):
    async with driver() as robot:
        await publish_everything(robot)
        robot.read(topic)
        await robot.clock.advance(0)
        assert len(robot.received(topic)) == 1
        robot.read(topic)
        await robot.clock.advance(0)
        assert len(robot.received(topic)) == 2


async def test_an_unchanged_description_is_published_once():
    async with driver() as robot:
        robot.read("/robot_description")
        for _ in range(5):
            await robot.body()
        assert len(robot.received("/robot_description")) == 1
        await robot.body(replace(BURGER, body_height=0.4))
        assert len(robot.received("/robot_description")) == 2


async def test_odometry_and_transforms_are_published_with_each_state():
    async with driver() as robot:
        await robot.body()
        for topic in ("/odom", "/tf", "/joint_states", "/clock"):
            robot.read(topic)
        joints = (Joint(name="wheel_left_joint", position=0.5),)
        await robot.states(50, pose=(1.0, 2.0, 0.0), v=0.2, joints=joints)
        for topic in ("/odom", "/tf", "/joint_states", "/clock"):
            assert len(robot.received(topic)) == 50
        odom, tf = robot.received("/odom")[-1], robot.received("/tf")[-1]
        assert odom.pose.pose.position.y == 2.0
        assert (
            odom.header.stamp == tf.transforms[0].header.stamp == robot.received("/clock")[-1].clock
        )
        found = [(each.header.frame_id, each.child_frame_id) for each in tf.transforms]
        assert found == [("odom", "base_footprint"), ("base_link", "wheel_left_link")]
        assert (odom.header.stamp.sec, odom.header.stamp.nanosec) == (1_000_000_000, 980_000_000)


async def test_tf_has_the_map_only_while_the_robot_is_localized():
    async with driver() as robot:
        robot.read("/tf")
        await robot.states(2, pose=(1.0, 0.0, 0.0))
        there = PoseInMap(x=5.0, y=5.0, yaw=math.pi / 2, covariance=(0.0,) * 9)
        await robot.publish(POSE, there, basis=2)
        await robot.states(1, pose=(2.0, 0.0, 0.0))
        in_map, in_odom = robot.received("/tf")[-1].transforms
        assert (in_map.header.frame_id, in_map.child_frame_id) == ("map", "odom")
        assert (in_odom.header.frame_id, in_odom.child_frame_id) == ("odom", "base_footprint")
        at = in_map.transform
        assert (at.translation.x, at.translation.y) == pytest.approx((5.0, 4.0))
        assert (at.rotation.z, at.rotation.w) == pytest.approx((0.70710678, 0.70710678))
        await robot.publish(POSE, replace(there, localized=False), basis=3)
        await robot.states(1)
        assert len(robot.received("/tf")[-1].transforms) == 1


async def test_an_old_pose_in_the_map_is_not_published_as_a_transform():
    async with driver() as robot:
        robot.read("/tf")
        await robot.states(2)
        await robot.publish(POSE, PoseInMap(x=0.0, y=0.0, yaw=0.0, covariance=(0.0,) * 9), basis=2)
        await robot.states(1)
        assert len(robot.received("/tf")[-1].transforms) == 2
        await robot.states(60)
        assert len(robot.received("/tf")[-1].transforms) == 1


async def test_an_imu_stream_replaces_the_readings_in_states():
    async with driver() as robot:
        robot.read("/imu")
        data = ImuData(
            orientation=READING.orientation,
            angular_velocity=READING.angular_velocity,
            linear_acceleration=(0.0, 0.0, 9.8),
        )
        await robot.states(3, imu=data)
        assert len(robot.received("/imu")) == 3
        for _ in range(10):
            await robot.publish(IMU, READING)
            await robot.states(1, imu=data)
        assert [each.linear_acceleration.x for each in robot.received("/imu")[3:]] == [1.0] * 10


async def test_the_battery_is_published_once_a_second():
    async with driver() as robot:
        robot.read("/battery_state")
        await robot.states(150, battery=40.0)
        assert len(robot.received("/battery_state")) == 3
        assert robot.received("/battery_state")[-1].percentage == pytest.approx(0.4)


async def test_pictures_have_the_stamp_of_their_camera_info():
    async with driver() as robot:
        await robot.body()
        for topic in ("/camera/image/compressed", "/camera/camera_info", "/camera/depth/image_raw",
                      "/camera/depth/camera_info", "/camera/rear/camera_info"):  # fmt: skip
            robot.read(topic)
        await robot.publish(IMAGE, JPEG, name="front", stamp_ns=5_000_000_007)
        await robot.publish(DEPTH, DEPTH_PICTURE, name="front", stamp_ns=6_000_000_008)
        (picture,), (about,) = (
            robot.received("/camera/image/compressed"),
            robot.received("/camera/camera_info"),
        )
        assert (picture.header.stamp.sec, picture.header.stamp.nanosec) == (5, 7)
        assert picture.header == about.header
        assert picture.data.tobytes() == JPEG.data
        (depth,) = robot.received("/camera/depth/image_raw")
        assert depth.header == robot.received("/camera/depth/camera_info")[0].header
        assert depth.header.stamp.sec == 6
        assert depth.data[:2].tolist() == [238, 2]  # 750 mm
        assert robot.received("/camera/rear/camera_info") == []


async def test_malformed_depth_is_dropped_and_counted():
    async with driver() as robot:
        await robot.body()
        robot.read("/camera/depth/image_raw")
        broken = replace(DEPTH_PICTURE, planes=(b"broken",) * 4)
        await robot.publish(DEPTH, broken, name="front")
        assert robot.received("/camera/depth/image_raw") == []
        assert robot.gateway_bus.counters["not_converted"] == 1
        await robot.publish(DEPTH, DEPTH_PICTURE, name="front")
        assert len(robot.received("/camera/depth/image_raw")) == 1


async def test_topics_of_cameras_follow_the_body():
    async with driver() as robot:
        await robot.body(replace(BURGER, cameras=()), real=True)
        plain = {topic for topic in TABLE if "camera" not in topic} - {"/clock"}
        assert set(robot.node.topics()) == plain
        await robot.body(replace(BURGER, cameras=CAMERAS[1:]), real=True)
        assert set(robot.node.topics()) - plain == {
            "/camera/image/compressed", "/camera/camera_info",
        }  # fmt: skip
        await robot.body(replace(BURGER, cameras=()), real=True)
        assert set(robot.node.topics()) == plain


async def test_a_camera_whose_topics_would_clash_with_the_first_one_gets_others():
    names = ("depth", "image", "depth_camera")
    further = tuple(Camera(name=name, width=16, height=16, depth=True) for name in names)
    async with driver() as robot:
        await robot.body(replace(BURGER, cameras=(CAMERAS[0], *further)))
        topics = [
            each.topic for each in robot.node.transport.endpoints() if each.kind == "publisher"
        ]
        assert len(topics) == len(set(topics))
        cameras = {topic.rpartition("/camera_info")[0] for topic in topics if "info" in topic}
        apart = ("", "/depth_camera_", "/image_camera", "/depth_camera")
        assert cameras == {f"/camera{at}{part}" for at in apart for part in ("", "/depth")}


async def test_a_path_ends_with_an_empty_one():
    async with driver() as robot:
        robot.read("/plan")
        moving = TaskStatus(path=((0.0, 0.0), (1.0, 0.0)), goal=Goal(x=1.0, y=0.0))
        for status in (TaskStatus(), moving, moving, TaskStatus(), TaskStatus()):
            await robot.publish(TASK, status)
        assert [len(each.poses) for each in robot.received("/plan")] == [0, 2, 2, 0]


HEALTHY = Health(process="perception", pid=7, host="robot", uptime_s=5, cpu=0.2, rss_bytes=10**8,
                 received_hz={}, sent_hz={}, rejected={}, latency_ms={}, counters={})  # fmt: skip


async def diagnosed(robot):
    """Return (level, text) of the newest diagnostics by name."""
    await robot.states(60)
    statuses = robot.received("/diagnostics")[-1].status
    assert {each.hardware_id for each in statuses} == {"waffle"}
    return {each.name: (each.level, each.message) for each in statuses}


async def test_diagnostics_have_levels_of_gate_safety_battery_and_processes():
    async with driver() as robot:
        await robot.body()
        robot.read("/diagnostics")
        problem = Cause(code="x", text="no map", remedy="save one")
        await robot.publish(HEALTH, HEALTHY, name="perception")
        await robot.publish(HEALTH, replace(HEALTHY, process="decision", problems=(problem,)),
                        name="decision")  # fmt: skip
        await robot.states(1)
        await robot.publish(SAFETY, SafetyState(verdict="slow", causes=(problem,)))
        found = await diagnosed(robot)
        assert found["gigabrain: gate"] == (0, "enabled control")
        assert found["gigabrain: safety"][0] == 3  # stale: the verdict is older than a second
        assert found["gigabrain: battery"] == (0, "100 %, 12.0 V")
        assert found["gigabrain: perception"] == (0, "runs")
        assert found["gigabrain: decision"] == (1, "no map (save one)")
        assert found["gigabrain: cmd_vel"] == (0, "no commands")
        await robot.states(200)
        assert (await diagnosed(robot))["gigabrain: perception"][0] == 3


async def test_diagnostics_of_a_silent_robot_are_stale():
    async with driver() as robot:
        await robot.body()
        robot.read("/diagnostics")
        await robot.clock.advance(2_000_000_000)
        statuses = {each.name: each for each in robot.received("/diagnostics")[-1].status}
        assert statuses["gigabrain: gate"].level == 3
        assert "driver" in statuses["gigabrain: gate"].message


async def test_a_pose_is_composed_from_the_poses_of_its_tick():
    async with driver() as robot:
        robot.read("/tf")
        await robot.states(1, pose=(0.0, 0.0, 0.0))
        await robot.states(1, pose=(1.0, 0.0, 0.0))
        here = PoseInMap(x=0.0, y=0.0, yaw=0.0, covariance=(0.0,) * 9)
        await robot.publish(POSE, here, basis=3)  # before the state of its tick
        await robot.states(1, pose=(3.0, 0.0, 0.0))
        assert robot.received("/tf")[-1].transforms[0].transform.translation.x == pytest.approx(
            -3.0
        )
