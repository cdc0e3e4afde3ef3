"""Two robots in namespaces of one ROS graph, both driven by rclpy at once."""

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.judge import Judge, Program
from tests.system.ros2.test_gateway_ros import READ, Robot, released, running

SPEEDS = {"red": (0.15, -0.5), "blue": (0.0, 0.6)}  # in a circle, and on the spot
ROS_TOPICS = {"/rosout", "/parameter_events"}


class Pair(NamedTuple):
    """Both robots."""

    red: Robot
    blue: Robot


@pytest.fixture
async def pair(judge: Judge, tmp_path: Path) -> AsyncIterator[Pair]:
    async with contextlib.AsyncExitStack() as stack:
        made = []
        for name in SPEEDS:
            home = stack.enter_context(contextlib.closing(Home(tmp_path / name)))
            ros2 = {"namespace": f"/{name}"}
            made.append(await stack.enter_async_context(running(home, judge, ros2=ros2)))
        yield Pair(*made)


def moves(name: str, robot: Robot) -> bool:
    """Return whether a robot moves as commanded, and not as the other one."""
    forward, turning = SPEEDS[name]
    now = robot.now.velocity
    return (
        robot.now.gate.commander == "ros2"
        and abs(now.linear_x - forward) < 0.03
        and abs(now.angular_z - turning) < 0.1
    )


def drives(report: dict[str, Any], speeds: tuple[float, float]) -> bool:
    """Return whether the newest odometry in a report has these speeds [m/s, rad/s]."""
    if not report["values"]:
        return False
    linear, angular = speeds
    twist = report["values"][-1]["twist"]["twist"]
    moves = abs(twist["linear"]["x"] - linear) < 0.05
    return moves and abs(twist["angular"]["z"] - angular) < 0.2


async def driven(driver: Program, listener: Program | None = None, **robots: Robot) -> None:
    """Let one program drive robots until they move, and their odometry at `listener` as well.

    The gate of a busy machine may stop a robot at any time, and then the program has to pause.
    """
    while True:
        for name in robots:
            linear, angular = SPEEDS[name]
            await driver.query("drive", topic=f"/{name}/cmd_vel", linear=linear, angular=angular)
        with contextlib.suppress(TimeoutError):
            await until(lambda: all(moves(*each) for each in robots.items()), "they move", 15.0)
            for name in robots if listener else ():
                fits = functools.partial(drives, speeds=SPEEDS[name])
                await asyncio.to_thread(
                    listener.poll, "report", fits, within_s=5.0, topic=f"/{name}/odom"
                )
            return
        for name in robots:
            await driver.query("rest", topic=f"/{name}/cmd_vel")
        await asyncio.sleep(1.0)


def namespaces(graph: dict[str, Any]) -> set[str]:
    """Return the first parts of the names of all topics, except those of ROS itself."""
    return {topic.split("/")[1] for topic in graph["topics"].keys() - ROS_TOPICS}


@pytest.mark.slow
async def test_two_robots_are_driven_independently_at_the_same_time(
    pair: Pair, judge: Judge
) -> None:
    await asyncio.gather(released(pair.red), released(pair.blue))
    driver, listener = judge.start("drive", node="hands"), judge.start("listen")
    for name in SPEEDS:
        for topic in ("/scan", "/odom", "/tf", "/tf_static"):
            kind, qos = READ[topic]
            await listener.query("subscribe", topic=f"/{name}{topic}", type=kind, qos=qos)
    await driven(driver, listener, **pair._asdict())

    async def value(topic: str) -> Any:
        report = await asyncio.to_thread(
            listener.poll,
            "report",
            lambda each: each["count"] > 3 or "static" in topic,
            topic=topic,
        )
        return report["values"][-1]

    for name in SPEEDS:
        assert (await value(f"/{name}/scan"))["header"]["frame_id"] == "base_scan"
        frames = {
            (each["header"]["frame_id"], each["child_frame_id"])
            for topic in ("tf", "tf_static")
            for each in (await value(f"/{name}/{topic}"))["transforms"]
        }
        assert {("odom", "base_footprint"), ("base_footprint", "base_link")} <= frames
        ends = await listener.endpoints(f"/{name}/tf")
        assert {each["namespace"] for each in ends["publishers"]} == {f"/{name}"}
    nodes = {"/red/gigabrain", "/blue/gigabrain"}

    graph = await asyncio.to_thread(
        judge.start("graph").poll,
        "graph",
        lambda found: nodes <= set(found["nodes"]) and namespaces(found) >= set(SPEEDS),
    )
    assert namespaces(graph) == set(SPEEDS)

    await driver.query("rest", topic="/red/cmd_vel")
    await pair.red.becomes("idle")
    since = len(pair.red.states)
    await driven(driver, blue=pair.blue)
    caller = judge.start("call")
    stop = {"service": "/red/estop", "type": "std_srvs/srv/SetBool"}
    await caller.available(**stop)
    await caller.query("call", **stop, data=True)
    assert (await caller.wait_async("response"))["value"]["success"]
    await pair.red.becomes("latched")
    await driven(driver, blue=pair.blue)
    assert {each.sent.linear_x for each in pair.red.states[since:]} == {0.0}
    assert pair.blue.now.gate.estop_generation == 0
