"""The bridge to Foxglove and Lichtblick: viewers see the robot's messages, and some may steer."""

import asyncio
import base64
import contextlib
import json
import math
import stat
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from websockets.asyncio.client import connect

from gigabrain_schemas.arrays import hits_bytes
from gigabrain_schemas.base import Message, Pose, Velocity
from gigabrain_schemas.body import ArmModel, GateStatus, Joint, RobotState
from gigabrain_schemas.brain import Obstacle, OccupancyGrid, PoseInMap, WorldModel
from gigabrain_schemas.examples import EXAMPLES, example
from gigabrain_schemas.objects import Detections
from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.safety import Health
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import (
    ARM_MODEL,
    CAMERA,
    DEPTH,
    DETECTIONS,
    ENABLE,
    ESTOP,
    HEALTH,
    IMAGE,
    LOG,
    MAP,
    OBJECT_MAP,
    PERCEIVED,
    POSE,
    RELEASE,
    SCAN,
    STATE,
    TASK,
    WORLD,
)
from gigabrain_zenoh.config.settings import FoxgloveConfig
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.runtime.services import NameClaim, serve_params
from gigabrain_zenoh.testing.processes import Home, free_port, listens
from gigabrain_zenoh.testing.waiting import PATIENCE_S, until
from gigabrain_zenoh.ui.foxglove.access import topic_to_steer, write_layout
from gigabrain_zenoh.ui.page.access import token_file, tokens
from tests.places import ROOT
from tests.system.foxglove_bridge import Bridge, bridged, hold
from tests.system.foxglove_viewer import Viewer, fields

STANDING = RobotState(
    robot_type="waffle",
    pose=Pose(x=0.0, y=0.0, yaw=0.0),
    velocity=Velocity(),
    gate=GateStatus(mode="enabled", commander="control"),
)
LINKS = ("base", "shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "jaw")
TURN_LEFT = {"linear": {"x": 0, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0.5}}


@pytest.fixture
async def bridge(tmp_path: Path) -> AsyncIterator[Bridge]:
    async with bridged(tmp_path) as made:
        yield made


async def test_a_scan_arrives_in_foxgloves_schema_beam_by_beam(bridge: Bridge) -> None:
    ranges = np.array([1.0, 2.5, math.inf], np.float32).tobytes()
    scan = LaserScan(
        angle_min=-1.5, angle_increment=0.5, range_min=0.1, range_max=3.5, ranges=ranges
    )
    bridge.robot.publish(SCAN, scan)
    async with bridge.viewer() as viewer:
        channel = await viewer.channel("/viz/scan")
        assert (channel["encoding"], channel["schemaName"]) == ("protobuf", "foxglove.LaserScan")
        assert b"start_angle" in base64.b64decode(channel["schema"])
        await viewer.subscribe("/viz/scan")
        await until(lambda: bridge.bus.counters["frames"] > 2, "a frame")
        bridge.robot.publish(SCAN, scan)
        seen = dict(fields(await viewer.message("/viz/scan")))
    assert (seen[2], seen[4], seen[5]) == (b"base_scan", -1.5, -0.5)
    assert struct.unpack("<3d", seen[6]) == (1.0, 2.5, math.inf)


async def test_every_kind_of_message_has_a_channel(bridge: Bridge) -> None:
    published = (STATE, SCAN, WORLD, POSE, MAP, TASK, LOG, OBJECT_MAP)
    for topic in published:
        message = EXAMPLES[topic.type.__name__]
        assert isinstance(message, topic.type)
        bridge.robot.publish(topic, message)
    assert "robot/image/*" not in bridge.patterns
    async with bridge.viewer() as viewer:
        for topic in ("scan", "map", "pose", "tf", "obstacles", "way", "contours", "log",
                      "state_numbers", "world_numbers", "objects"):  # fmt: skip
            assert await viewer.channel(f"/viz/{topic}")
        await until(lambda: "robot/image/*" in bridge.patterns, "pictures are received")
        for camera in (IMAGE, DEPTH, CAMERA, PERCEIVED):
            bridge.robot.publish(camera, example(camera.type), name="front")
        bridge.robot.publish(DETECTIONS, example(Detections))
        for topic in ("image/front", "depth/front", "calibration/front", "annotations/front",
                      "perceived/front"):  # fmt: skip
            assert await viewer.channel(f"/viz/{topic}")
    await until(lambda: "robot/image/*" not in bridge.patterns, "nobody looks")
    assert viewer.server["capabilities"] == [
        "clientPublish", "connectionGraph", "parameters", "parametersSubscribe", "services",
    ]  # fmt: skip


async def steering(bridge: Bridge, viewer: Viewer) -> None:
    """Make the viewer one that has the layout with the secret."""
    await viewer.publish_on(topic_to_steer(bridge.config))
    await hold(viewer, TURN_LEFT, lambda: bridge.steered)


async def test_only_viewers_with_the_layout_can_call_services(bridge: Bridge) -> None:
    asked: list[str] = []

    def grant(what: str) -> Callable[[Message], Awaitable[GateReply]]:
        async def answer(_: Message) -> GateReply:
            asked.append(what)
            gate = replace(example(GateReply).gate, mode="latched")
            return GateReply(ok=True, text=f"{what} done", robot_type="waffle", gate=gate)

        return answer

    for service in (ESTOP, RELEASE, ENABLE):
        bridge.robot.serve(service, grant(service.key))
    bridge.robot.publish(STATE, STANDING)
    async with bridge.viewer() as viewer:
        for name in ("/estop", "/release", "/enable"):
            answer = await viewer.call(name)
            assert (answer["ok"], asked) == (False, [])
            assert "layout file" in answer["text"]
        await steering(bridge, viewer)
        bridge.robot.publish(STATE, STANDING)
        for name in ("/estop", "/release", "/enable"):
            assert await viewer.call(name) == {"ok": True, "text": f"robot{name} done"}
    assert set(asked) == {"robot/estop", "robot/release", "robot/enable"}


async def test_a_refused_service_call_has_a_reason(bridge: Bridge) -> None:
    async with bridge.viewer() as viewer:
        await steering(bridge, viewer)
        answer = await viewer.call("/release")  # no driver serves it
        assert answer["ok"] is False
        assert answer["text"]


async def test_all_viewers_see_parameters_but_only_those_with_the_layout_set_them(
    bridge: Bridge,
) -> None:
    speeds = [0.26]

    def put(text: str) -> None:
        if float(text) > 0.26:
            raise Refused("above the body's own limit")
        speeds.append(float(text))

    bridge.robot.params.add("speed", "a number", lambda: f"{speeds[-1]:g}", put, key="robot.speed")
    serve_params(bridge.robot)
    health = replace(example(Health), process="driver")
    bridge.robot.publish(HEALTH, health, name="driver")
    async with bridge.viewer() as viewer:
        assert (await viewer.parameters())["driver.speed"] == 0.26
        assert await viewer.set_parameters(driver__speed=0.1) == {"driver.speed": 0.26}
        await steering(bridge, viewer)
        assert await viewer.set_parameters(driver__speed=0.1) == {"driver.speed": 0.1}
        assert await viewer.set_parameters(driver__speed=0.5) == {"driver.speed": 0.1}
        assert await viewer.set_parameters(driver__nonsense=1) == {}
        assert await viewer.parameters("driver.speed") == {"driver.speed": 0.1}
    assert speeds == [0.26, 0.1]


async def test_a_late_subscriber_gets_the_map(bridge: Bridge) -> None:
    cells = bytes((0, 100, 255, 50))
    grid = OccupancyGrid(
        resolution=0.05, width=2, height=2, origin_x=-1.0, origin_y=0.5, cells=cells
    )
    bridge.robot.publish(MAP, grid)
    async with bridge.viewer() as viewer:
        await viewer.subscribe("/viz/map")
        seen = dict(fields(await viewer.message("/viz/map")))
    assert seen[2] == b"map"
    assert seen[4] == 2  # columns
    assert seen[9] == bytes(
        (254, 254, 254, 255, 0, 0, 0, 255, 128, 128, 128, 0, 127, 127, 127, 255)
    )


async def test_an_obstacle_is_drawn_at_its_place_with_its_velocity(bridge: Bridge) -> None:
    one = Obstacle(id=7, x=1.5, y=-0.5, velocity_y=0.3, radius=0.2)
    world = WorldModel(scan_ok=True, obstacle_ahead=False, obstacles=(one,))
    bridge.robot.publish(WORLD, world)
    async with bridge.viewer() as viewer:
        await viewer.subscribe("/viz/obstacles")
        bridge.robot.publish(WORLD, world)
        entity = dict(fields(dict(fields(await viewer.message("/viz/obstacles")))[2]))
        assert (entity[2], entity[3]) == (b"odom", b"7")


async def test_a_large_static_obstacle_is_drawn_by_its_visible_outline(bridge: Bridge) -> None:
    y = np.linspace(-1.0, 1.0, 41)
    one = Obstacle(id=7, x=1.5, y=0.0, radius=1.0)
    world = WorldModel(
        scan_ok=True, obstacle_ahead=False, obstacles=(one,), hits=hits_bytes(0.0 * y + 1.5, y)
    )
    here = RobotState(robot_type="mock", pose=Pose(x=0.0, y=0.0, yaw=0.0), velocity=Velocity())
    bridge.robot.publish(STATE, here)
    bridge.robot.publish(WORLD, world)
    async with bridge.viewer() as viewer:
        await viewer.subscribe("/viz/obstacles")
        bridge.robot.publish(WORLD, world)
        entity = dict(fields(dict(fields(await viewer.message("/viz/obstacles")))[2]))
    assert (entity[2], entity[3]) == (b"base_link", b"7")
    assert 10 not in entity  # no cylinders
    points = [data for number, data in fields(entity[11]) if number == 5]
    assert len(points) == 80  # both ends of 40 lines


async def test_the_frames_connect_map_odometry_and_robot(bridge: Bridge) -> None:
    state = EXAMPLES["RobotState"]
    assert isinstance(state, RobotState)
    place = PoseInMap(x=4.0, y=0.0, yaw=0.0, covariance=(0.0,) * 9)
    async with bridge.viewer() as viewer:
        bridge.robot.publish(STATE, state)
        await viewer.subscribe("/viz/tf")
        joined: set[tuple[bytes, bytes]] = set()
        while len(joined) < 3:
            bridge.robot.publish(STATE, state)
            bridge.robot.publish(POSE, place)
            seen = dict(fields(await viewer.message("/viz/tf")))
            joined.add((seen[2], seen[3]))
    expected = {(b"map", b"odom"), (b"odom", b"base_link"), (b"base_link", b"base_scan")}
    assert joined == expected
    assert Pose(x=1.0, y=0.0, yaw=0.0) != state.pose


async def sees_the_arm(viewer: Viewer) -> None:
    """Assert that all links are drawn, and the first one is turned a quarter to the left."""
    await viewer.subscribe("/viz/arm")
    scene = await viewer.message("/viz/arm")
    frames = {dict(fields(entity))[2].decode() for _, entity in fields(scene)}
    assert frames == {f"arm/{name}" for name in LINKS}
    await viewer.subscribe("/viz/arm_tf")
    transforms = [dict(fields(one)) for _, one in fields(await viewer.message("/viz/arm_tf"))]
    (pan,) = (one for one in transforms if one[3] == b"arm/shoulder")
    turn = dict(fields(pan[5]))
    assert pan[2] == b"arm/base"
    assert (turn[3], turn[4]) == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))


async def test_an_arm_is_drawn_for_viewers_that_connect_before_and_after_its_model(
    bridge: Bridge,
) -> None:
    mjcf = (ROOT / "drivers/gigabrain_drivers/bodies/so101/model.xml").read_text("utf-8")
    joints = (Joint(name="shoulder_pan", position=-math.pi / 2),)

    async def talk() -> None:
        while True:
            bridge.robot.publish(STATE, replace(STANDING, joints=joints))
            await asyncio.sleep(0.05)

    talking = asyncio.ensure_future(talk())
    async with bridge.viewer() as early:
        await early.channel("/viz/tf")
        bridge.robot.publish(ARM_MODEL, ArmModel(mjcf=mjcf))
        await sees_the_arm(early)
    async with bridge.viewer() as late:
        await sees_the_arm(late)
    talking.cancel()


async def test_a_viewer_sees_the_connection_graph(bridge: Bridge) -> None:
    bridge.robot.publish(SCAN, EXAMPLES["LaserScan"])  # type: ignore[type-var]
    await NameClaim(bridge.robot).acquire()
    await NameClaim(bridge.bus).acquire()
    async with bridge.viewer() as viewer:
        await viewer.send(op="subscribeConnectionGraph")
        graph = await viewer.connections("robot/scan")
    assert {"name": "robot/scan", "publisherIds": ["driver"]} in graph["publishedTopics"]
    assert {"name": "robot/scan", "subscriberIds": ["foxglove"]} in graph["subscribedTopics"]


def test_the_layout_contains_the_secret_topic_and_only_its_owner_can_read_it(
    tmp_path: Path,
) -> None:
    config = FoxgloveConfig(secret=str(tmp_path / "secret"))
    path = tmp_path / "robot.json"
    path.write_text("of before")
    write_layout(config, path)
    layout = json.loads(path.read_text())
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert layout["configById"]["Teleop!drive"]["topic"] == topic_to_steer(config)
    assert len(topic_to_steer(config)) > 30
    assert set(layout["configById"]) == set(_panels(layout["layout"]))
    with pytest.raises(ConfigError, match="cannot write"):
        write_layout(config, tmp_path / "none" / "robot.json")


def test_the_secret_for_steering_is_no_token_of_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    topic = topic_to_steer(FoxgloveConfig())
    assert topic_to_steer(FoxgloveConfig()) == topic
    made, _ = tokens(token_file(""))
    assert made.operator not in topic
    assert made.viewer not in topic
    path = tmp_path / "gigabrain" / "foxglove" / "secret"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    path.write_text("a b")
    with pytest.raises(ConfigError, match="remove the file for a new one"):
        topic_to_steer(FoxgloveConfig())


def _panels(place: object) -> list[str]:
    if isinstance(place, str):
        return [place]
    assert isinstance(place, dict)
    return [*_panels(place["first"]), *_panels(place["second"])]


async def test_a_viewer_steers_a_robot_and_a_second_bridge_is_refused(
    home: Home,
) -> None:
    from gigabrain_zenoh.launch.deployment import ROBOT
    from gigabrain_zenoh.qa.probe import probing
    from gigabrain_zenoh.testing.processes import endpoint_of

    layout = home.folder / "robot.json"
    wrote = await home.run("foxglove", "--layout", str(layout))
    assert (await wrote.ended(), wrote.err) == (0, "")
    topic = json.loads(layout.read_text())["configById"]["Teleop!drive"]["topic"]
    port = free_port()
    hosts = {"robot": [*ROBOT, "foxglove"]}
    file = home.deployment(body="mock", resume="auto", hosts=hosts, foxglove={"port": port})
    home.start("up", str(file))

    def turns() -> bool:
        return seen.state.velocity.angular_z > 0.3

    async with probing(endpoint_of(file)) as seen:
        await until(lambda: listens(port), "the bridge is there")
        await seen.enable_brain()
        async with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"]) as made:  # type: ignore[list-item]
            viewer = Viewer(made)
            await viewer.publish_on(topic)

            async with asyncio.timeout(PATIENCE_S):
                # on a busy machine the gate may stop the robot, which a held button does not move
                while not turns():
                    with contextlib.suppress(TimeoutError):
                        await hold(viewer, TURN_LEFT, turns, 2.0)
                        break
                    await asyncio.sleep(1.0)  # the button is released
        await seen.at_rest()
        second = await home.run(
            "foxglove", "--port", str(port), "--namespace", "other",
            "--connect", endpoint_of(file).connect[0],
        )  # fmt: skip
    assert await second.ended() == 2
    assert f"cannot listen on 127.0.0.1 port {port}" in second.err
    assert "choose another with --port" in second.err
