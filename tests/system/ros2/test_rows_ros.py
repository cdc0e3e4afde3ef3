"""Every topic and parameter of the gateway, read by real ROS 2: values, frames, stamps, QoS, hash.

The robot is simulated here, so that each value is known, and a body has all that any body may have.
"""

import asyncio
import functools
import math
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
import pytest_asyncio
from msgspec.structs import replace

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import Camera, Joint
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.tasks import Goal, TaskStatus
from gigabrain_schemas.topics import (
    BODY,
    DEPTH,
    IMAGE,
    IMU,
    MAP,
    POSE,
    SAFETY,
    SCAN,
    STATE,
    TASK,
    Topic,
)
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.gateway.gateway import serve
from gigabrain_zenoh.ros2.opening import open_transport
from gigabrain_zenoh.testing import samples
from tests.node.test_ros2_topics import BURGER, GRID, JPEG, READING, TABLE
from tests.ros2.judge import Judge, Program
from tests.ros2.nodes import types
from tests.system.ros2.test_gateway_ros import judge

__all__ = ["judge"]
pytestmark = pytest.mark.asyncio(loop_scope="module")
TICK_S = 0.02
SLOW_TICKS = 10  # period of all messages but states
STAMP = {"sec": 1_795_580_000, "nanosec": 500_000_007}
STAMP_NS = STAMP["sec"] * 10**9 + STAMP["nanosec"]
LENS = (-0.5, 0.5, -0.5, 0.5)
FRONT = Camera(
    name="front",
    width=320,
    height=240,
    intrinsics=(270.0, 271.0, 160.5, 119.5),
    distortion=(0.1, -0.2, 0.0, 0.0, 0.3),
    depth=True,
    x=0.1,
    z=0.2,
)
WAFFLE = replace(BURGER, cameras=(FRONT, Camera(name="rear", width=16, height=16)))
PIXELS = np.arange(320 * 240, dtype=np.uint16).reshape(240, 320)  # [mm]
PICTURE = replace(JPEG, height=240, width=320, data=b"\xff\xd8" + bytes(range(256)) * 160)
NEAR = samples.open_space(deg_15=0.8, deg_200=2.5)
NEAR[90] = math.nan
JOINTS = (
    Joint(name="wheel_left_joint", position=0.5, velocity=1.5),
    Joint(name="wheel_right_joint", position=-0.5, velocity=-1.5),
)
WAY = TaskStatus(path=((0.0, 0.0), (1.0, 0.0), (1.0, 2.0)), goal=Goal(x=1.0, y=2.0, yaw=math.pi))
DEPTHS = DepthImage(frame_id="front", height=240, width=320, planes=pack_depth(PIXELS))
SLOW_MESSAGES: tuple[tuple[Topic[Any], Message, str], ...] = (
    (BODY, samples.body(WAFFLE), ""),
    (SCAN, samples.scan(NEAR), ""),
    (IMU, READING, ""),
    (MAP, GRID, ""),
    (TASK, WAY, ""),
    (IMAGE, PICTURE, "front"),
    (IMAGE, replace(JPEG, frame_id="rear", data=b"\xff\xd8rear"), "rear"),
    (DEPTH, DEPTHS, "front"),
    (SAFETY, SafetyState(verdict="ok"), ""),
)


class SimulatedProcesses:
    """A stand-in for a robot's processes, which publishes their messages."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self._tick = bus, 0
        bus.time.boot = samples.BOOT

    async def run(self) -> None:
        """Publish until cancelled."""
        while True:
            self._bus.time.tick = self._tick = self._tick + 1
            state = samples.state(self._tick, pose=(1.0, 0.0, 0.0), v=0.2, w=-0.3, battery=40.0)
            self._publish(STATE, replace(state, joints=JOINTS))
            here = PoseInMap(x=5.0, y=5.0, yaw=math.pi / 2, covariance=(0.0,) * 9)
            self._bus.publish(POSE, here, basis=self._tick)
            for topic, message, name in SLOW_MESSAGES if self._tick % SLOW_TICKS == 1 else ():
                self._publish(topic, message, name)
            await asyncio.sleep(TICK_S)

    def _publish(self, topic: Topic[Any], message: Message, name: str = "") -> None:
        self._bus.publish(topic, message, name=name, stamp_ns=STAMP_NS, basis=self._tick)


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def gateway(shared_judge: Judge) -> AsyncIterator[None]:
    """A gateway in the judge's domain, on a simulated robot."""
    network, clock, ready = LocalNetwork(), Clock(), asyncio.Event()
    config = Ros2Config(transport="dds", domain=shared_judge.domain, localhost=True)
    simulated, bus = (
        Bus(network.transport(), clock, "driver"),
        Bus(network.transport(), clock, "ros2"),
    )
    async with open_transport(config, types()) as ros:
        ends = [
            asyncio.ensure_future(serve(config, bus, ros, types(), ready.set)),
            asyncio.ensure_future(SimulatedProcesses(simulated).run()),
        ]
        await ready.wait()
        yield
        for end in ends:
            end.cancel()
        await asyncio.gather(*ends, return_exceptions=True)
    await bus.close()
    await simulated.close()


Messages = dict[str, Any]
BATTERY = "gigabrain: battery"


def is_whole(topic: str, report: dict[str, Any]) -> bool:
    """Return whether a message has arrived that contains all data of the robot."""
    if not report["count"]:
        return False
    (value,) = report["values"]
    if topic == "/tf":
        return bool(value["transforms"][0]["header"]["frame_id"] == "map")
    return topic != "/diagnostics" or BATTERY in [each["name"] for each in value["status"]]


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def received(gateway: None, shared_judge: Judge) -> AsyncIterator[Messages]:
    """The newest message of each topic, as received by rclpy."""
    listener = shared_judge.start("listen")
    for topic, (kind, qos) in TABLE.items():
        wanted = {name: getattr(qos, name) for name in ("reliable", "transient_local", "depth")}
        await listener.query("subscribe", topic=topic, type=kind, qos=wanted)
    found = {}
    for topic in TABLE:
        report = await asyncio.to_thread(
            listener.poll, "report", functools.partial(is_whole, topic), topic=topic
        )
        found[topic] = report["values"][-1]
    yield found
    listener.close()


def head(frame: str) -> dict[str, Any]:
    return {"stamp": STAMP, "frame_id": frame}


def about_z(half: float) -> dict[str, float]:
    return {
        "x": 0.0,
        "y": 0.0,
        "z": pytest.approx(math.sin(half)),
        "w": pytest.approx(math.cos(half)),
    }


async def test_ros_knows_type_hash_and_qos_of_every_topic(
    gateway: None, received: Messages, judge: Judge
) -> None:
    listener = judge.start("listen", node="looker")

    def names_us(answer: dict[str, Any]) -> bool:
        return [each["node"] for each in answer["publishers"]] == ["gigabrain"]

    for topic, (kind, qos) in TABLE.items():
        found = await asyncio.to_thread(listener.poll, "endpoints", names_us, topic=topic)
        (each,) = found["publishers"]
        assert (each["type"], each["hash"]) == (kind, types().hash(kind))
        assert (each["reliable"], each["transient_local"]) == (qos.reliable, qos.transient_local)


async def test_scans_have_ranges_angles_and_beams_without_a_return(received: Messages) -> None:
    scan = received["/scan"]
    assert scan["header"] == head("base_scan")
    assert np.array_equal(scan["ranges"], NEAR.astype(float), equal_nan=True)
    assert scan["angle_increment"] == pytest.approx(math.radians(1.0))
    assert (scan["range_min"], scan["range_max"]) == pytest.approx((0.12, 3.5))
    assert (scan["scan_time"], scan["intensities"]) == (pytest.approx(0.1), [])


async def test_odometry_frames_and_joints_are_those_of_the_state(received: Messages) -> None:
    odom = received["/odom"]
    assert (odom["header"], odom["child_frame_id"]) == (head("odom"), "base_footprint")
    assert odom["pose"]["pose"]["position"] == {"x": 1.0, "y": 0.0, "z": 0.0}
    twist = odom["twist"]["twist"]
    assert (twist["linear"]["x"], twist["angular"]["z"]) == (0.2, -0.3)
    joints = received["/joint_states"]
    assert joints["name"] == ["wheel_left_joint", "wheel_right_joint"]
    assert (joints["position"], joints["velocity"]) == ([0.5, -0.5], [1.5, -1.5])
    assert received["/clock"]["clock"] == STAMP


async def test_the_frames_lead_from_the_map_to_each_sensor(received: Messages) -> None:
    moving = {each["child_frame_id"]: each for each in received["/tf"]["transforms"]}
    assert [each["header"]["frame_id"] for each in moving.values()] == [
        "map", "odom", "base_link", "base_link",
    ]  # fmt: skip
    odom = moving["odom"]["transform"]
    assert odom["translation"] == {"x": pytest.approx(5.0), "y": pytest.approx(4.0), "z": 0.0}
    assert odom["rotation"] == about_z(math.pi / 4)
    static = {each["child_frame_id"]: each for each in received["/tf_static"]["transforms"]}
    parents = {name: each["header"]["frame_id"] for name, each in static.items()}
    assert parents == {
        "base_link": "base_footprint", "imu_link": "base_link", "base_scan": "base_link",
        "front_link": "base_link", "front_optical_frame": "front_link",
        "rear_link": "base_link", "rear_optical_frame": "rear_link",
    }  # fmt: skip
    lens = static["front_optical_frame"]["transform"]["rotation"]
    assert tuple(lens[axis] for axis in "xyzw") == LENS


async def test_the_imu_the_battery_and_the_description_arrive(received: Messages) -> None:
    imu = received["/imu"]
    assert imu["header"] == head("imu_link")
    assert imu["linear_acceleration"] == {"x": 1.0, "y": 0.0, "z": 9.8}
    assert imu["angular_velocity"]["z"] == 0.1
    assert imu["orientation"] == about_z(0.0)
    battery = received["/battery_state"]
    assert (battery["percentage"], battery["voltage"]) == (pytest.approx(0.4), 12.0)
    assert battery["present"]
    assert math.isnan(battery["charge"])
    assert 'link name="front_optical_frame"' in received["/robot_description"]["data"]


async def test_the_map_and_the_plan_arrive(received: Messages) -> None:
    grid = received["/map"]
    assert (grid["header"], grid["data"]) == (head("map"), [100, -1])
    info = grid["info"]
    assert (info["width"], info["height"]) == (2, 1)
    assert info["resolution"] == pytest.approx(0.1)
    plan = received["/plan"]
    assert plan["header"] == head("map")
    assert [each["header"] for each in plan["poses"]] == [head("map")] * 3
    places = [each["pose"]["position"] for each in plan["poses"]]
    assert [(at["x"], at["y"]) for at in places] == [(0.0, 0.0), (1.0, 0.0), (1.0, 2.0)]
    assert plan["poses"][1]["pose"]["orientation"] == about_z(math.pi / 4)
    assert plan["poses"][2]["pose"]["orientation"] == about_z(math.pi / 2)


async def test_pictures_arrive_with_the_intrinsics_of_their_camera(received: Messages) -> None:
    for at, name, data, size in (
        ("/camera", "front", PICTURE.data, (320, 240)),
        ("/camera/rear", "rear", b"\xff\xd8rear", (16, 16)),
    ):
        picture, about = received[f"{at}/image/compressed"], received[f"{at}/camera_info"]
        assert picture["header"] == about["header"] == head(f"{name}_optical_frame")
        assert (picture["format"], bytes(picture["data"])) == ("jpeg", data)
        assert (about["width"], about["height"]) == size
    about = received["/camera/camera_info"]
    assert (about["distortion_model"], about["d"]) == ("plumb_bob", [0.1, -0.2, 0.0, 0.0, 0.3])
    assert about["k"] == [270.0, 0.0, 160.5, 0.0, 271.0, 119.5, 0.0, 0.0, 1.0]
    assert about["p"] == [270.0, 0.0, 160.5, 0.0, 0.0, 271.0, 119.5, 0.0, 0.0, 0.0, 1.0, 0.0]
    assert about["r"] == [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


async def test_depth_arrives_in_millimetres_with_its_camera(received: Messages) -> None:
    depth, about = received["/camera/depth/image_raw"], received["/camera/depth/camera_info"]
    assert depth["header"] == about["header"] == head("front_optical_frame")
    assert (depth["encoding"], depth["is_bigendian"], depth["step"]) == ("16UC1", 0, 640)
    pixels = np.frombuffer(bytes(depth["data"]), "<u2").reshape(240, 320)
    assert np.array_equal(pixels, PIXELS)
    assert about["k"][0] == 270.0


async def test_diagnostics_name_the_parts_of_the_robot(received: Messages) -> None:
    found = {each["name"]: each for each in received["/diagnostics"]["status"]}
    assert {"gigabrain: gate", "gigabrain: safety"} <= found.keys()
    assert found[BATTERY]["message"] == "40 %, 12.0 V"
    assert found["gigabrain: cmd_vel"]["message"] == "no commands"
    assert {each["hardware_id"] for each in found.values()} == {"waffle"}


async def called(caller: Program, name: str, **request: Any) -> Any:
    """Return the value of a parameter service's response."""
    kind = "".join(word.title() for word in name.split("_"))
    where = {"service": f"/gigabrain/{name}", "type": f"rcl_interfaces/srv/{kind}"}
    await caller.available(**where)
    await caller.query("call", **where, name=name, **request)
    return (await caller.wait_async("response", name=name))["value"]


async def test_ros_reads_the_parameters_and_cannot_set_them(gateway: None, judge: Judge) -> None:
    caller = judge.start("call")
    names = (await called(caller, "list_parameters"))["result"]["names"]
    assert {"use_sim_time", "transport", "cmd_vel_timeout", "take"} <= set(names)
    asked = ["use_sim_time", "domain", "cmd_vel_timeout", "transport", "leave_out", "nothing"]
    values = (await called(caller, "get_parameters", names=asked))["values"]
    assert [each["type"] for each in values] == [1, 2, 3, 4, 9, 0]
    assert (values[0]["bool_value"], values[1]["integer_value"]) == (True, judge.domain)
    assert (values[2]["double_value"], values[3]["string_value"]) == (0.2, "dds")
    described = await called(caller, "describe_parameters", names=["take"])
    assert [each["read_only"] for each in described["descriptors"]] == [True]
    wanted = [{"name": "take", "value": {"type": 1, "bool_value": True}}]
    (refused,) = (await called(caller, "set_parameters", parameters=wanted))["results"]
    assert (refused["successful"], "read-only" in refused["reason"]) == (False, True)
