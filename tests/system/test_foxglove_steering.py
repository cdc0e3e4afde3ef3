"""Steering from Foxglove: the secret topic, two viewers, invalid velocities, and noise."""

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN
from gigabrain_zenoh.testing.waiting import until
from gigabrain_zenoh.ui.foxglove import node
from gigabrain_zenoh.ui.foxglove.access import topic_to_steer
from gigabrain_zenoh.ui.foxglove.node import velocity_of
from tests.system.foxglove_bridge import Bridge, bridged, hold

TURN_LEFT = {"linear": {"x": 0, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0.5}}


@pytest.fixture
async def bridge(tmp_path: Path) -> AsyncIterator[Bridge]:
    async with bridged(tmp_path) as made:
        yield made


async def test_the_teleop_panel_steers_and_a_lost_viewer_stops_the_robot(bridge: Bridge) -> None:
    topic = topic_to_steer(bridge.config)
    async with bridge.viewer() as viewer:
        await viewer.publish_on(topic)
        await hold(viewer, TURN_LEFT, lambda: bridge.turns)
        assert bridge.turns[-1] == 0.5
        await hold(viewer, {"linear_x": 9.0}, lambda: bridge.steered[-1].linear_x)
        assert bridge.steered[-1].linear_x == 0.26  # limited to the speed of the body
    await until(lambda: bridge.steered[-1].linear_x == 0.0, "a last word")


async def test_only_one_of_two_viewers_steers(bridge: Bridge) -> None:
    topic = topic_to_steer(bridge.config)
    async with bridge.viewer() as one, bridge.viewer() as two:
        for viewer in (one, two):
            await viewer.publish_on(topic)
        await hold(one, TURN_LEFT, lambda: bridge.turns)
        for _ in range(5):
            await two.publish({"angular_z": -0.5})
            await hold(one, TURN_LEFT, lambda: True)
        await hold(one, {"angular_z": 0.25}, lambda: bridge.turns[-1] == 0.25)
    assert -0.5 not in bridge.turns


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"\xff" * 9, b"[]", b"null", {"linear_x": "fast"}, {"linear_x": 1, "more": 1},
     b'{"linear_x": NaN}', b'{"linear_x": 1e999}', {"linear": {"x": 1, "w": 1}, "angular": {}},
     {"linear": {"z": 1}, "angular": {}}, b'{"linear_x": 0.1' + b" " * 2000 + b"}"],
    ids=str,
)  # fmt: skip
async def test_an_invalid_velocity_does_not_steer(bridge: Bridge, content: object) -> None:
    async with bridge.viewer() as viewer:
        await viewer.publish_on(topic_to_steer(bridge.config))
        await viewer.publish(content)
        await hold(viewer, TURN_LEFT, lambda: bridge.turns)
    assert {twist.linear_x for twist in bridge.steered} == {0.0}


@pytest.mark.parametrize("topic", ["/teleop", "/teleop/", "/cmd_vel", "robot/cmd_vel", ""])
async def test_a_viewer_without_the_secret_topic_cannot_steer(bridge: Bridge, topic: str) -> None:
    async with bridge.viewer() as stranger, bridge.viewer() as owner:
        await stranger.publish_on(topic)
        await owner.publish_on(topic_to_steer(bridge.config))
        for _ in range(10):
            await stranger.publish({"angular_z": -0.5})
            await asyncio.sleep(0.02)
        await hold(owner, TURN_LEFT, lambda: bridge.turns)
    assert -0.5 not in bridge.turns


async def test_every_refused_viewer_is_logged_once_however_many_there_are(
    bridge: Bridge, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refusals() -> int:
        return sum("may not steer" in record.message for record in caplog.records)

    monkeypatch.setattr(node, "MAX_REFUSED", 2)
    for number in range(1, 5):
        async with bridge.viewer() as stranger:
            for topic in ("/teleop", "/cmd_vel"):
                await stranger.publish_on(topic)
            await until(lambda n=number: refusals() == n, "a refusal in the log")
            await asyncio.sleep(0.05)
        assert refusals() == number


async def test_noise_floods_and_lost_viewers_do_not_disturb_others(bridge: Bridge) -> None:
    scan = EXAMPLES["LaserScan"]
    assert isinstance(scan, LaserScan)
    bridge.robot.publish(SCAN, scan)
    async with bridge.viewer() as viewer:
        await viewer.subscribe("/viz/scan")
        with socket.create_connection(("127.0.0.1", bridge.config.port)) as raw:
            raw.sendall(b"\x00\xff" * 500)
        # a viewer that does not read the errors is cut off
        with contextlib.suppress(ConnectionClosed):
            async with bridge.viewer() as noisy:
                await noisy.publish_on(topic_to_steer(bridge.config))
                for _ in range(300):
                    await noisy.publish(b"\xff")
                    await noisy.send(op="nonsense")
        for _ in range(5):
            bridge.robot.publish(SCAN, scan)
            await viewer.message("/viz/scan")
    assert bridge.turns == []


def test_velocities_in_the_format_of_the_panel_and_in_ours_are_read() -> None:
    assert velocity_of(json.dumps(TURN_LEFT).encode()).angular_z == 0.5
    assert velocity_of(b'{"linear_x": 0.2, "linear_y": 0.1}').linear_y == 0.1
    with pytest.raises(ValueError, match="moves in x and y"):
        velocity_of(b'{"linear": {"z": 1}, "angular": {}}')
