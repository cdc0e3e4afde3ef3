"""Our protocols against independent implementations."""

import asyncio
import json
import random
import subprocess
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.ros2.qos import DEFAULT
from gigabrain_zenoh.ros2.rmw_names import topic_key
from gigabrain_zenoh.ros2.rmw_zenoh import RmwZenohTransport
from gigabrain_zenoh.ros2.transport import absolute, dds_type
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing.processes import repeat, robot
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.foreign import PROGRAMS, built, javascript, python
from tests.unit.ros2.random_messages import random_fields

STRING, SET_BOOL = "std_msgs/msg/String", "std_srvs/srv/SetBool"
READ_IN_JAVASCRIPT = (
    "geometry_msgs/msg/TwistStamped",
    "nav_msgs/msg/OccupancyGrid",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/LaserScan",
    "tf2_msgs/msg/TFMessage",
    "trajectory_msgs/msg/JointTrajectory",
)


@pytest.fixture(scope="module")
def types() -> Types:
    return Types()


class Sdk:
    """A node of zenoh-ros2-sdk in a separate process."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.said: dict[str, list[Any]] = {}

    async def read(self) -> None:
        assert self.process.stdout
        async for line in self.process.stdout:
            for name, value in json.loads(line).items():
                self.said.setdefault(name, []).append(value)


@pytest.fixture
async def node(types: Types) -> AsyncIterator[tuple[RmwZenohTransport, Sdk]]:
    interpreter = built(python)
    async with robot() as net:
        await net.router()
        port = net.endpoint.rpartition(":")[2]
        process = await asyncio.create_subprocess_exec(
            str(interpreter),
            str(PROGRAMS / "sdk.py"),
            port,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        sdk = Sdk(process)
        reading = asyncio.create_task(sdk.read())
        try:
            async with RmwZenohTransport(Ros2Link(router=net.endpoint), types) as made:
                yield made, sdk
        finally:
            assert process.stdin
            process.stdin.close()
            try:
                await asyncio.wait_for(process.wait(), 10)
            except TimeoutError:
                process.kill()
            await reading


async def test_zenoh_ros2_sdk_reads_answers_and_calls(
    node: tuple[RmwZenohTransport, Sdk], types: Types
) -> None:
    ours, sdk = node
    got: list[str] = []
    ours.subscribe(
        "/back", STRING, DEFAULT, lambda r: got.append(types.decode(STRING, r.payload).data)
    )
    publisher = ours.publisher("/chatter", STRING)

    async def stop(request: bytes) -> bytes:
        data = types.decode(f"{SET_BOOL}_Request", request).data
        response = types.make(f"{SET_BOOL}_Response", success=data, message="ours")
        return types.encode(f"{SET_BOOL}_Response", response)

    ours.serve("/estop", SET_BOOL, stop)
    await until(lambda: publisher.readers == 1, "the reader of the sdk")
    await repeat(
        lambda: publisher.publish(types.encode(STRING, types.make(STRING, data="hi"))),
        lambda: "re hi" in got,
    )
    await until(lambda: {"got", "response"} <= sdk.said.keys(), "what it got")
    assert set(sdk.said["got"]) == {"hi"}
    assert sdk.said["response"] == [[True, "ours"]]
    request = types.encode(f"{SET_BOOL}_Request", types.make(f"{SET_BOOL}_Request", data=True))
    response = types.decode(
        f"{SET_BOOL}_Response", await ours.call("/theirs", SET_BOOL, request, 60)
    )
    assert (response.success, response.message) == (True, "theirs")
    theirs = {(each.kind, each.topic, each.hash) for each in ours.endpoints() if not each.ours}
    assert ("subscriber", "/chatter", types.hash(STRING)) in theirs
    assert ("server", "/theirs", types.hash(SET_BOOL)) in theirs
    assert "/sdk" in ours.nodes()
    assert ours.counts.total() == 0


def test_pamoja_makes_the_same_keys_and_rejects_the_same_names(types: Types) -> None:
    topics = ["/scan", "/robot1/scan", "/a/b/c", "/a//b", "/1a", "/a/", "/a b", "/_hidden"]
    names = [STRING, "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry"]
    asked = [
        (domain, t, name, types.hash(name)) for domain in (0, 42) for t in topics for name in names
    ]
    ended = subprocess.run(
        [str(built(python)), str(PROGRAMS / "keys.py")],
        input="".join(json.dumps(each) + "\n" for each in asked),
        capture_output=True,
        text=True,
        check=True,
    )
    answers = [json.loads(line) for line in ended.stdout.splitlines()]
    assert len(answers) == len(asked)
    for (domain, topic, name, hash), theirs in zip(asked, answers, strict=True):
        if theirs["valid"]:
            assert theirs["key"] == topic_key(domain, absolute(topic, "/"), name, hash)
            assert theirs["type"] == dds_type(name)
        else:
            with pytest.raises(ConfigError):
                absolute(topic, "/")


def test_foxgloves_codec_reads_and_writes_the_same_values(types: Types) -> None:
    source = random.Random(5)
    cases = []
    for name in READ_IN_JAVASCRIPT:
        fields = random_fields(types, name, source, texts=("", "map"))  # it truncates other texts
        message = types.from_dict(name, fields)
        cases.append((name, fields, message, types.encode(name, message)))
    asked = [
        {"definition": types.definition(name), "payload": payload.hex()}
        for name, _, _, payload in cases
    ]
    ended = subprocess.run(
        ["node", str(PROGRAMS / "codec.mjs"), str(built(javascript))],
        input="".join(json.dumps(each) + "\n" for each in asked),
        capture_output=True,
        text=True,
        check=True,
    )
    for (name, fields, message, _), line in zip(cases, ended.stdout.splitlines(), strict=True):
        theirs = json.loads(line)
        assert theirs["message"] == fields, name
        written = types.decode(name, bytes.fromhex(theirs["written"]))
        assert types.to_dict(written) == types.to_dict(message), name
