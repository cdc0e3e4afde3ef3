"""The bridge to Foxglove and Lichtblick: what a viewer sees is what was said, and who may steer."""

import asyncio
import base64
import contextlib
import json
import math
import socket
import stat
import struct
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import numpy as np
import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from gigabrain_drivers.catalog import load_robot
from gigabrain_schemas.arrays import hits_bytes
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import Obstacle, OccupancyGrid, PoseInMap, Twist, WorldModel
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_schemas.topics import (
    BODY,
    IMAGE,
    LOG,
    MAP,
    POSE,
    SCAN,
    STATE,
    TASK,
    TELEOP,
    WORLD,
)
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.foxglove_bridge.layout import topic_to_steer, write_layout
from gigabrain_zenoh.foxglove_bridge.server import run
from gigabrain_zenoh.foxglove_bridge.steering import velocity_of
from gigabrain_zenoh.health import answer_to_name
from gigabrain_zenoh.settings import FoxgloveConfig
from gigabrain_zenoh.transport import LocalNetwork
from tests.foxglove_rig import Viewer, fields
from tests.stack import PATIENCE_S, Home, free_port, until

LEFT = {"linear": {"x": 0, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0.5}}


class Bridge:
    """A robot that says what a test wants, and the bridge beside it."""

    def __init__(self, folder: Path) -> None:
        self.config = FoxgloveConfig(port=free_port(), tokens=str(folder / "tokens.json"))
        network = LocalNetwork()
        self.robot = Bus(network.transport(), Clock(), "driver")
        self.bus = Bus(network.transport(), Clock(), "foxglove")
        self.steered: list[Twist] = []
        self.robot.subscribe(TELEOP, lambda _key, twist: self.steered.append(twist))
        body = load_robot("turtlebot3_waffle").description()
        self.robot.publish(BODY, Body(description=body, link="sim"))

    @property
    def turns(self) -> list[float]:
        return [twist.angular_z for twist in self.steered]

    @contextlib.asynccontextmanager
    async def viewer(self) -> AsyncIterator[Viewer]:
        url = f"ws://127.0.0.1:{self.config.port}"
        async with connect(url, subprotocols=["foxglove.sdk.v1"]) as made:  # type: ignore[list-item]
            yield Viewer(made)


@pytest.fixture
async def bridge(tmp_path: Path) -> AsyncIterator[Bridge]:
    made, ready = Bridge(tmp_path), asyncio.Event()
    serving = asyncio.ensure_future(run(made.config, made.bus, ready.set))
    await ready.wait()
    yield made
    serving.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await serving


async def hold(viewer: Viewer, content: object, done: Callable[[], object]) -> None:
    """Say it again and again, as the Teleop panel does while a button is held."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            await viewer.publish(content)
            await asyncio.sleep(0.04)
            if done():
                return


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


async def test_every_kind_of_message_has_a_channel_to_be_drawn_from(bridge: Bridge) -> None:
    said = (STATE, SCAN, WORLD, POSE, MAP, TASK, LOG)
    for topic in said:
        message = EXAMPLES[topic.type.__name__]
        assert isinstance(message, topic.type)
        bridge.robot.publish(topic, message)
    picture = Image(frame_id="cam", encoding="mono8", height=1, width=2, data=b"\x00\xff")
    bridge.robot.publish(IMAGE, picture, name="front")
    async with bridge.viewer() as viewer:
        for topic in ("scan", "map", "pose", "tf", "obstacles", "way", "image/front", "log",
                      "state_numbers", "world_numbers"):  # fmt: skip
            assert await viewer.channel(f"/viz/{topic}")
    assert viewer.server["capabilities"] == ["clientPublish", "connectionGraph"]


async def test_who_comes_late_is_given_the_map(bridge: Bridge) -> None:
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


async def test_an_obstacle_is_drawn_where_it_is_and_with_where_it_goes(bridge: Bridge) -> None:
    one = Obstacle(id=7, x=1.5, y=-0.5, velocity_y=0.3, radius=0.2)
    world = WorldModel(scan_ok=True, obstacle_ahead=False, obstacles=(one,))
    bridge.robot.publish(WORLD, world)
    async with bridge.viewer() as viewer:
        await viewer.subscribe("/viz/obstacles")
        bridge.robot.publish(WORLD, world)
        entity = dict(fields(dict(fields(await viewer.message("/viz/obstacles")))[2]))
        assert (entity[2], entity[3]) == (b"odom", b"7")


async def test_what_is_large_and_stands_is_drawn_as_what_was_seen_of_it(bridge: Bridge) -> None:
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
    assert 10 not in entity  # cylinders
    points = [data for number, data in fields(entity[11]) if number == 5]
    assert len(points) == 80  # both ends of 40 lines


async def test_the_frames_join_map_and_robot(bridge: Bridge) -> None:
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


async def test_a_viewer_sees_who_talks_to_whom(bridge: Bridge) -> None:
    bridge.robot.publish(SCAN, EXAMPLES["LaserScan"])  # type: ignore[type-var]
    await answer_to_name(bridge.robot)
    await answer_to_name(bridge.bus)
    async with bridge.viewer() as viewer:
        await viewer.say(op="subscribeConnectionGraph")
        graph = await viewer.connections("robot/scan")
    assert {"name": "robot/scan", "publisherIds": ["driver"]} in graph["publishedTopics"]
    assert {"name": "robot/scan", "subscriberIds": ["foxglove"]} in graph["subscribedTopics"]


async def test_the_teleop_panel_steers_and_a_viewer_that_vanishes_stops(bridge: Bridge) -> None:
    topic = topic_to_steer(bridge.config)
    async with bridge.viewer() as viewer:
        await viewer.publish_on(topic)
        await hold(viewer, LEFT, lambda: bridge.turns)
        assert bridge.turns[-1] == 0.5
        await hold(viewer, {"linear_x": 9.0}, lambda: bridge.steered[-1].linear_x)
        assert bridge.steered[-1].linear_x == 0.26  # no faster than the body can
    await until(lambda: bridge.steered[-1].linear_x == 0.0, "a last word")


async def test_of_two_viewers_one_steers(bridge: Bridge) -> None:
    topic = topic_to_steer(bridge.config)
    async with bridge.viewer() as one, bridge.viewer() as two:
        for viewer in (one, two):
            await viewer.publish_on(topic)
        await hold(one, LEFT, lambda: bridge.turns)
        for _ in range(5):
            await two.publish({"angular_z": -0.5})
            await hold(one, LEFT, lambda: True)
        await hold(one, {"angular_z": 0.25}, lambda: bridge.turns[-1] == 0.25)
    assert -0.5 not in bridge.turns


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"\xff" * 9, b"[]", b"null", {"linear_x": "fast"}, {"linear_x": 1, "more": 1},
     b'{"linear_x": NaN}', b'{"linear_x": 1e999}', {"linear": {"x": 1, "w": 1}, "angular": {}},
     {"linear": {"z": 1}, "angular": {}}, b'{"linear_x": 0.1' + b" " * 2000 + b"}"],
    ids=str,
)  # fmt: skip
async def test_what_is_no_velocity_steers_nobody(bridge: Bridge, content: object) -> None:
    async with bridge.viewer() as viewer:
        await viewer.publish_on(topic_to_steer(bridge.config))
        await viewer.publish(content)
        await hold(viewer, LEFT, lambda: bridge.turns)
    assert {twist.linear_x for twist in bridge.steered} == {0.0}


@pytest.mark.parametrize("topic", ["/teleop", "/teleop/", "/cmd_vel", "robot/cmd_vel", ""])
async def test_who_does_not_know_the_topic_may_look_and_not_drive(
    bridge: Bridge, topic: str
) -> None:
    async with bridge.viewer() as stranger, bridge.viewer() as owner:
        await stranger.publish_on(topic)
        await owner.publish_on(topic_to_steer(bridge.config))
        for _ in range(10):
            await stranger.publish({"angular_z": -0.5})
            await asyncio.sleep(0.02)
        await hold(owner, LEFT, lambda: bridge.turns)
    assert -0.5 not in bridge.turns


async def test_noise_floods_and_vanishing_viewers_disturb_no_other(bridge: Bridge) -> None:
    scan = EXAMPLES["LaserScan"]
    assert isinstance(scan, LaserScan)
    bridge.robot.publish(SCAN, scan)
    async with bridge.viewer() as viewer:
        await viewer.subscribe("/viz/scan")
        with socket.create_connection(("127.0.0.1", bridge.config.port)) as raw:
            raw.sendall(b"\x00\xff" * 500)
        with contextlib.suppress(ConnectionClosed):  # who does not hear complaints is cut off
            async with bridge.viewer() as noisy:
                await noisy.publish_on(topic_to_steer(bridge.config))
                for _ in range(300):
                    await noisy.publish(b"\xff")
                    await noisy.say(op="nonsense")
        for _ in range(5):
            bridge.robot.publish(SCAN, scan)
            await viewer.message("/viz/scan")
    assert bridge.turns == []


def test_a_velocity_is_read_as_the_panel_sends_it_and_as_we_do() -> None:
    assert velocity_of(json.dumps(LEFT).encode()).angular_z == 0.5
    assert velocity_of(b'{"linear_x": 0.2, "linear_y": 0.1}').linear_y == 0.1
    with pytest.raises(ValueError, match="moves in x and y"):
        velocity_of(b'{"linear": {"z": 1}, "angular": {}}')


def test_the_layout_holds_the_topic_and_only_its_owner_can_read_it(tmp_path: Path) -> None:
    config = FoxgloveConfig(tokens=str(tmp_path / "tokens.json"))
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


def _panels(place: object) -> list[str]:
    if isinstance(place, str):
        return [place]
    assert isinstance(place, dict)
    return [*_panels(place["first"]), *_panels(place["second"])]


async def test_a_robot_turns_as_a_viewer_tells_it_and_a_second_bridge_says_what_to_do(
    home: Home,
) -> None:
    from gigabrain_zenoh.deployment import ROBOT
    from tests.onlooker import looking_on
    from tests.stack import endpoint_of

    layout = home.folder / "robot.json"
    wrote = await home.run("foxglove", "--layout", str(layout))
    assert (await wrote.ended(), wrote.err) == (0, "")
    topic = json.loads(layout.read_text())["configById"]["Teleop!drive"]["topic"]
    port = free_port()
    hosts = {"robot": [*ROBOT, "foxglove"]}
    file = home.deployment(body="mock", resume="auto", hosts=hosts, foxglove={"port": port})
    home.start("up", str(file))
    async with looking_on(endpoint_of(file)) as seen:
        await until(lambda: "foxglove" in seen.health, "the bridge is there")
        await seen.hand_to_brain()
        async with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"]) as made:  # type: ignore[list-item]
            viewer = Viewer(made)
            await viewer.publish_on(topic)

            await hold(viewer, LEFT, lambda: seen.state.velocity.angular_z > 0.3)
        await seen.still()
        second = await home.run(
            "foxglove", "--port", str(port), "--namespace", "other",
            "--connect", endpoint_of(file).connect[0],
        )  # fmt: skip
    assert await second.ended() == 2
    assert f"cannot listen on 127.0.0.1 port {port}" in second.err
    assert "choose another with --port" in second.err
