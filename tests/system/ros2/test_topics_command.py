"""The commands `ros2 topics`, `ros2 pass` and `doctor`, with real ROS 2 over DDS."""

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any

import msgspec
import pytest

from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.examples import example
from gigabrain_schemas.topics import WORLD
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import Endpoint, Ros2Link
from gigabrain_zenoh.ros2.qos import DEFAULT
from gigabrain_zenoh.ros2.rmw_zenoh import RmwZenohTransport
from gigabrain_zenoh.ros2.transport import Received
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import Home, free_endpoint, router_process
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.judge import Judge
from tests.system.ros2.test_gateway_ros import running

STRING, LASER = "std_msgs/msg/String", "sensor_msgs/msg/LaserScan"
NAVIGATE = "nav2_msgs/action/NavigateToPose"
BEST_EFFORT = {"reliable": False, "depth": 5}


def join(judge: Judge) -> tuple[str, ...]:
    return "--transport", "dds", "--domain", str(judge.domain), "--localhost"


async def listed(home: Home, judge: Judge, *options: str) -> dict[str, Any]:
    command = await home.run("ros2", "topics", *join(judge), "--json", *options)
    assert await command.ended() == 0, command.err
    return {row["name"]: row for row in map(json.loads, command.out.splitlines())}


@pytest.mark.slow
async def test_topics_of_rclpy_are_listed_with_types_qos_and_nodes(
    home: Home, judge: Judge
) -> None:
    talker, listener = judge.start("drive", node="talker"), judge.start("listen", node="ears")
    await talker.query("advertise", topic="/laser", type=LASER, **BEST_EFFORT)
    await listener.query("subscribe", topic="/laser", type=LASER, qos={})
    rows = await listed(home, judge)
    laser = rows["/laser"]
    assert (laser["kind"], laser["type"]) == ("topic", LASER)
    assert (laser["senders"], laser["receivers"]) == (["/talker"], ["/ears"])
    assert laser["offered"][0].startswith("best effort, volatile")
    assert laser["requested"][0].startswith("reliable, volatile")
    assert laser["robot_keys"] == []
    assert "nothing passes from /talker to /ears" in laser["troubles"][0]
    assert "/rosout" not in rows
    every = await listed(home, judge, "--all-topics")
    assert every["/rosout"]["type"] == "rcl_interfaces/msg/Log"
    assert every["/talker/get_parameters"]["senders"] == ["/talker"]
    shown = await home.run("ros2", "topics", *join(judge))
    assert "/laser: nothing passes from /talker to /ears" in shown.out
    assert "node /gigabrain is not among them" in shown.err


@pytest.mark.slow
async def test_without_other_nodes_the_command_names_the_usual_reasons(
    home: Home, judge: Judge
) -> None:
    command = await home.run("ros2", "topics", *join(judge))
    assert await command.ended() == 1
    assert command.err.startswith(f"gigabrain: no node of ROS in domain {judge.domain}: check on")
    assert command.err.count("\n") == 1


@pytest.mark.slow
async def test_keys_of_a_robot_are_listed_and_doctor_finds_mismatches(
    home: Home, judge: Judge, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(home, judge) as robot:
        listener = judge.start("listen", node="rviz")
        await listener.query("subscribe", topic="/scan", type=LASER, qos={})
        caller, client = judge.start("call", node="caller"), judge.start("navigate", node="client")
        await caller.query("call", service="/release", type="std_srvs/srv/Trigger")
        await client.query("available", action="/navigate_to_pose", type=NAVIGATE)
        rows = await listed(home, judge)
        assert [row["name"] for row in rows.values() if row["troubles"]] == ["/scan"]
        assert rows["/release"]["receivers"] == ["/caller"]
        assert rows["/navigate_to_pose"]["receivers"] == ["/client"]
        assert rows["/scan"]["robot_keys"] == ["robot/scan"]
        assert (rows["/scan"]["senders"], rows["/scan"]["receivers"]) == (["/gigabrain"], ["/rviz"])
        assert rows["/estop"]["robot_keys"] == ["robot/estop"]
        assert rows["/navigate_to_pose"]["kind"] == "action"
        gateway = [row for row in rows.values() if "/gigabrain" in row["senders"]]
        assert [row["name"] for row in gateway if not row["robot_keys"]] == []

        monkeypatch.setenv("ROS_DOMAIN_ID", str(judge.domain + 1))
        mismatch = "/scan: nothing passes from /gigabrain to /rviz"
        while True:  # the gateway checks the graph every few seconds
            command = await robot.home.run("doctor", "--json")
            found = [json.loads(line) for line in command.out.splitlines()]
            if any(each["text"].startswith(mismatch) for each in found):
                break
        of_ros = {each["text"]: each for each in found if each["about"] == "ros2"}
        wrong = f"ROS_DOMAIN_ID is {judge.domain + 1} in this shell, and {judge.domain} in the"
        assert {each["grade"] for text, each in of_ros.items() if text.startswith(wrong)} == {"bad"}
        joined = f"node /gigabrain on dds, domain {judge.domain}, other nodes: 3"
        assert of_ros[joined]["grade"] == "ok"


@pytest.fixture
async def bus() -> AsyncIterator[tuple[Bus, str]]:
    router = free_endpoint()
    with router_process(router):
        async with connect(Endpoint(connect=(router,)), "test", timeout_s=None) as made:
            yield made, router


async def test_our_messages_reach_rclpy_from_json_and_are_not_encoded_without_readers(
    home: Home, judge: Judge, bus: tuple[Bus, str]
) -> None:
    ours, router = bus
    words = ("robot/world", "/world", "std_msgs/String", "--as", "json", "--connect", router)
    command = home.start("ros2", "pass", *words, *join(judge))
    await until(lambda: "passing robot/world -> /world" in command.err, "it passes")
    listener = judge.start("listen")
    await listener.query("subscribe", topic="/world", type=STRING, qos={})
    report: dict[str, Any] = {"count": 0}
    while not report["count"]:
        ours.publish(WORLD, example(WorldModel))
        await asyncio.sleep(0.05)
        report = await listener.query("report", topic="/world")
    world = msgspec.json.decode(report["values"][0]["data"], type=WorldModel)
    assert world.obstacle_ahead == example(WorldModel).obstacle_ahead
    assert world.sectors == example(WorldModel).sectors


async def test_messages_of_rclpy_reach_a_key_as_json_including_latched_ones(
    home: Home, judge: Judge, bus: tuple[Bus, str]
) -> None:
    ours, router = bus
    got: list[tuple[str, bytes]] = []
    ours.tap("robot/notes", lambda _, encoding, payload: got.append((encoding, payload)))
    talker = judge.start("drive", node="talker")
    latched = {"reliable": True, "transient_local": True, "depth": 1}
    await talker.query("publish", topic="/chatter", type=STRING, value={"data": "grüß"}, **latched)
    words = ("/chatter", "robot/notes", "std_msgs/String", "--connect", router)
    command = home.start("ros2", "pass", *words, *join(judge))
    await until(lambda: got, "the latched message")
    assert got[0] == ("application/json", '{"data":"grüß"}'.encode())
    await talker.query("publish", topic="/chatter", type=STRING, value={"data": "2"}, **latched)
    await until(lambda: got[-1][1] == b'{"data":"2"}', "the next one")
    command.close()
    assert command.err.count("\n") == 1


async def test_over_rmw_zenoh_both_commands_use_the_robots_router(
    home: Home, bus: tuple[Bus, str]
) -> None:
    ours, router = bus
    types, got = Types(), list[Received]()
    async with RmwZenohTransport(Ros2Link(node="reader", router=router), types) as reader:
        words = ("robot/world", "/world", "std_msgs/String", "--as", "json", "--connect", router)
        command = home.start("ros2", "pass", *words)
        reader.subscribe("/world", STRING, DEFAULT, got.append)
        await until(lambda: "robot/world" in command.err, "it passes")
        while not got:
            ours.publish(WORLD, example(WorldModel))
            await asyncio.sleep(0.05)
        text = types.decode(STRING, got[0].payload).data
        assert msgspec.json.decode(text, type=WorldModel).sectors == example(WorldModel).sectors
        listing = await home.run("ros2", "topics", "--json", "--connect", router)
        (row,) = map(json.loads, listing.out.splitlines())
        assert (row["name"], row["type"]) == ("/world", STRING)
        assert (row["senders"], row["receivers"]) == (["/gigabrain_pass"], ["/reader"])


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("/drive", "robot/cmd_vel", "geometry_msgs/Twist"), "robot/cmd_vel belongs to the robot"),
        (("robot/wrold", "/world", "std_msgs/String"), "did you mean 'world'"),
        (("robot/world", "/world", "std_msgs/String"), "no field in common"),
        (("robot/world", "/world", "std_msgs/Strng"), "did you mean 'std_msgs/msg/String'"),
    ],
)
async def test_an_impossible_pass_is_refused_in_one_line(
    home: Home, bus: tuple[Bus, str], words: tuple[str, ...], error: str
) -> None:
    command = await home.run("ros2", "pass", *words, "--transport", "dds", "--connect", bus[1])
    assert await command.ended() in (1, 2)
    assert error in command.err
    assert (command.err.startswith("gigabrain: "), command.err.count("\n")) == (True, 1)
