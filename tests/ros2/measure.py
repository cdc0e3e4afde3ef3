"""Measures a simulated robot with its gateway against real ROS 2: `python -m tests.ros2.measure`.

All times are from the monotonic clock of one machine: when rclpy sent or received a message, and
when the robot's state with the effect arrived here. A busy machine makes all of them longer.
"""

import asyncio
import contextlib
import os
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
from cyclopts import App
from rich.console import Console
from rich.table import Table

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.requests import release
from gigabrain_zenoh.config.settings import (
    DecisionConfig,
    PerceptionConfig,
    Ros2Config,
    Ros2Link,
)
from gigabrain_zenoh.errors import BodyLost, Refused
from gigabrain_zenoh.gateway.conversions.sensors import laser_scan
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.qa.bench.goals import START_TIMEOUT_S, GoalSender
from gigabrain_zenoh.qa.robot_under_test import LOOPBACK, ProcessGroup, measured_robot
from gigabrain_zenoh.ros2.dds import DdsTransport
from gigabrain_zenoh.ros2.qos import SENSOR_DATA
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.environment import build, report_progress
from tests.ros2.judge import Judge, Program, judging

SPEED_MPS, COMMAND_HZ, PAUSE_S, TRY_S = 0.15, 20.0, 1.0, 10.0
SET_BOOL, NAVIGATE = "std_srvs/srv/SetBool", "nav2_msgs/action/NavigateToPose"
ACTION = {"action": "/navigate_to_pose", "type": NAVIGATE}
GOAL_S = 300.0
MAX_RESTARTS = 4  # after five deaths within a minute, the supervisor gives up
READ = {
    "/scan": ("sensor_msgs/msg/LaserScan", {"reliable": False}),
    "/odom": ("nav_msgs/msg/Odometry", {}),
    "/tf": ("tf2_msgs/msg/TFMessage", {}),
}

app = App(result_action="return_value")


class Robot:
    """A running robot, with the arrival times [ns] of its states and scans."""

    def __init__(self, group: ProcessGroup, bus: Bus) -> None:
        self.group, self.bus = group, bus
        self.states: list[tuple[int, RobotState]] = []
        self.scans: dict[int, int] = {}  # arrival times by stamp
        bus.subscribe(STATE, self._on_state)
        bus.subscribe(SCAN, self._on_scan)

    def _on_state(self, _key: str, state: RobotState) -> None:
        self.states.append((time.monotonic_ns(), state))

    def _on_scan(self, _key: str, scan: LaserScan) -> None:
        self.scans[scan.stamp_ns] = time.monotonic_ns()

    @property
    def now(self) -> RobotState:
        """The newest state."""
        return self.states[-1][1]

    def stopped_ns(self, since_ns: int) -> int | None:
        """Return the arrival time of the first state with a zero command after `since_ns`."""
        later = ((at, state) for at, state in self.states if at > since_ns)
        return next((at for at, state in later if state.sent.linear_x == 0.0), None)

    def braked_ns(self, since_ns: int) -> int | None:
        """Return the arrival time of the first state with a reduced command after `since_ns`."""
        later = [(at, state.sent.linear_x) for at, state in self.states if at > since_ns]
        return next((at for (_, was), (at, now) in pairwise(later) if now < was), None)

    async def released(self) -> None:
        """Release the robot, as soon as it has been at rest for long enough."""
        while self.now.gate.mode == "latched":
            with contextlib.suppress(Refused, BodyLost):
                await release(self.bus, self.now.gate.estop_generation)
            await asyncio.sleep(0.1)

    async def driven(self, driver: Program) -> None:
        """Let ROS drive; if the gate of a busy machine stops it, pause and try again."""
        while True:
            await self.released()
            await driver.query("drive", linear=SPEED_MPS, angular=0.5, hz=COMMAND_HZ)
            with contextlib.suppress(TimeoutError):
                await until(lambda: self.now.velocity.linear_x > 0.1, "it drives", TRY_S)
                return
            await driver.query("rest")
            await asyncio.sleep(PAUSE_S)


@contextlib.asynccontextmanager
async def running(judge: Judge, world: str, **parts: Any) -> AsyncIterator[Robot]:
    """Run a robot whose gateway is in the judge's domain."""
    ros2 = Ros2Config(transport="dds", domain=judge.domain, localhost=True)
    body = "turtlebot3_burger"
    deployment = Deployment(body=body, world=world, router=LOOPBACK, ros2=ros2, **parts)
    async with measured_robot(deployment, ready_s=START_TIMEOUT_S) as (group, bus):
        robot = Robot(group, bus)
        await until(lambda: robot.states, "states")
        yield robot


async def arrivals(judge: Judge, topic: str, count: int) -> dict[int, int]:
    """Return the arrival times [ns] of 10 * `count` scans at rclpy, by their stamps."""
    listen = judge.start("listen")
    kind, qos = READ["/scan"]
    await listen.query("subscribe", topic=topic, type=kind, qos=qos, stream=True)
    await listen.wait_async("message", GOAL_S, nth=10 * count + 5)
    found = {}
    for event in listen.seen("message", topic=topic)[5:]:
        stamp = event["value"]["header"]["stamp"]
        found[stamp["sec"] * 10**9 + stamp["nanosec"]] = event["at_ns"]
    listen.close()
    return found


def later(arrived: dict[int, int], than: dict[int, int]) -> list[float]:
    """Return the delays [ms] of scans in `arrived` against those in `than`."""
    return [(at_ns - than[stamp]) / 1e6 for stamp, at_ns in arrived.items() if stamp in than]


async def added_latency(robot: Robot, judge: Judge, count: int) -> list[float]:
    """Return the delays [ms] of scans at rclpy against their arrival on our bus."""
    return later(await arrivals(judge, "/scan", count), robot.scans)


async def bare_hops(robot: Robot, judge: Judge, count: int) -> list[float]:
    """Return the times [ms] from writing scans to DDS in this process to rclpy."""
    link = Ros2Link(node="bare", transport="dds", domain=judge.domain, localhost=True)
    written: dict[int, int] = {}
    async with DdsTransport(link, Types()) as ros:
        publisher = ros.publisher("/bare_scan", READ["/scan"][0], SENSOR_DATA)

        def write(_key: str, scan: LaserScan) -> None:
            payload = laser_scan(scan)
            written[scan.stamp_ns] = time.monotonic_ns()
            publisher.publish(payload)

        close = robot.bus.subscribe(SCAN, write)
        arrived = await arrivals(judge, "/bare_scan", count)
        close()
    return later(arrived, written)


async def late_joins(robot: Robot, judge: Judge, count: int) -> list[float]:
    """Return the times [ms] from the subscription of a new node to its first message."""
    found = []
    kind, qos = READ["/odom"]
    for _ in range(count):
        listen = judge.start("listen")
        asked = await listen.query("subscribe", topic="/odom", type=kind, qos=qos, stream=True)
        found.append(((await listen.wait_async("message"))["at_ns"] - asked["at_ns"]) / 1e6)
        listen.close()
    return found


async def restarts(robot: Robot, judge: Judge, count: int) -> list[float]:
    """Return the times [ms] from killing the gateway to the first message of its successor."""
    listen, found = judge.start("listen"), []
    kind, qos = READ["/odom"]
    await listen.query("subscribe", topic="/odom", type=kind, qos=qos, stream=True)
    for _ in range(min(count, MAX_RESTARTS)):
        await listen.wait_async("message", nth=len(listen.seen("message")))
        before = robot.group.pids["ros2"]
        os.kill(before, signal.SIGKILL)
        killed_ns = time.monotonic_ns()
        await until(lambda pid=before: robot.group.pids.get("ros2", pid) != pid, "its successor")
        first = await listen.wait_async("message", nth=len(listen.seen("message")))
        found.append((first["at_ns"] - killed_ns) / 1e6)
    listen.close()
    return found


async def brakings(robot: Robot, judge: Judge, count: int) -> list[float]:
    """Return the times [ms] from one period after a killed publisher's last command to braking."""
    found = []
    for _ in range(count):
        driver = judge.start("drive")
        await robot.driven(driver)
        driver.kill()
        last_ns = driver.seen("sent")[-1]["at_ns"]
        await until(lambda ns=last_ns: robot.braked_ns(ns), "braking")
        found.append(((robot.braked_ns(last_ns) or 0) - last_ns) / 1e6 - 1e3 / COMMAND_HZ)
        await asyncio.sleep(PAUSE_S)
    return found


async def stops(robot: Robot, judge: Judge, count: int) -> list[float]:
    """Return the times [ms] from a call of /estop while driving to a zero command."""
    caller, found = judge.start("call"), []
    where = {"service": "/estop", "type": SET_BOOL}
    await caller.available(**where)
    for number in range(count):
        driver = judge.start("drive")
        await robot.driven(driver)
        await caller.query("call", **where, name=str(number), data=True)
        sent_ns = (await caller.wait_async("response", name=str(number)))["sent_ns"]
        await until(lambda ns=sent_ns: robot.stopped_ns(ns), "stopping")
        found.append(((robot.stopped_ns(sent_ns) or 0) - sent_ns) / 1e6)
        driver.close()
        await asyncio.sleep(PAUSE_S)
    return found


async def load(robot: Robot, judge: Judge, seconds: float) -> tuple[float, dict[str, float]]:
    """Return the gateway's share of a core [%], and the rates [Hz] of topics at rclpy."""
    listen = judge.start("listen")
    for topic, (kind, qos) in READ.items():
        await listen.query("subscribe", topic=topic, type=kind, qos=qos)
    await asyncio.to_thread(listen.poll, "report", lambda each: each["count"] > 10, topic="/odom")
    process = psutil.Process(robot.group.pids["ros2"])
    times = process.cpu_times()
    began_s = time.monotonic()
    await asyncio.sleep(seconds)
    spent = process.cpu_times()
    used_s = spent.user + spent.system - times.user - times.system
    share = 100 * used_s / (time.monotonic() - began_s)
    rates = {topic: listen.ask("report", topic=topic)["hz"] for topic in READ}
    listen.close()
    return share, rates


class Goals:
    """Sends goals by rclpy to a robot that has explored its world."""

    def __init__(self, sender: GoalSender, client: Program) -> None:
        self._sender, self._client = sender, client

    async def send(self, name: str) -> None:
        """Send a goal to a random place; return at its first feedback."""
        place = await self._sender.random_goal()
        position = {"x": place.x, "y": place.y}
        pose = {"header": {"frame_id": "map"}, "pose": {"position": position}}
        await self._client.query("send", **ACTION, name=name, goal={"pose": pose})
        await self._client.wait_async("feedback", name=name)

    async def ended(self, name: str) -> tuple[str, int]:
        """Wait for the end of a goal; return its status and Nav2's error code."""
        found = await self._client.wait_async("result", GOAL_S, name=name)
        return found["status"], found["value"]["error_code"]

    async def followed(self, name: str) -> bool:
        """Send a goal; return whether it is reached."""
        await self.send(name)
        return await self.ended(name) == ("succeeded", 0)

    async def cancelled(self, name: str) -> bool:
        """Send and cancel a goal; return whether it ends as cancelled."""
        await self.send(name)
        await self._client.query("cancel", name=name)
        return await self.ended(name) == ("canceled", 0)

    async def preempted(self, name: str) -> bool:
        """Send two goals; return whether the first is aborted, and the second reached."""
        await self.send(name)
        await self.send(f"{name}, then")
        ends = await self.ended(name), await self.ended(f"{name}, then")
        return ends == (("aborted", 0), ("succeeded", 0))


async def goals(judge: Judge, count: int) -> dict[str, tuple[int, int]]:
    """Return (successes, tries) of following, cancelling and preempting goals."""
    brain = {"perception": PerceptionConfig(mapping="slam"), "resume": "auto"}
    brain["decision"] = DecisionConfig(behaviour="navigate")
    async with running(judge, "house", **brain) as robot:
        sender = GoalSender(robot.bus, robot.group, seed=0)
        await until(lambda: sender.is_localized, "a map", START_TIMEOUT_S)
        report_progress("exploring the house")
        await sender.explore()
        client = judge.start("navigate")
        await client.available(**ACTION)
        tried = Goals(sender, client)
        ways: dict[str, Callable[[str], Awaitable[bool]]] = {
            "followed": tried.followed,
            "cancelled": tried.cancelled,
            "preempted": tried.preempted,
        }
        found = {}
        for way, run in ways.items():
            successes = 0
            for number in range(count):
                successes += await run(f"{way} {number}")
                report_progress(f"{way}: {successes} of {number + 1}")
            found[way] = successes, count
    return found


async def times(judge: Judge, count: int, seconds: float) -> Table:
    """Measure times and load; return their table."""
    table = Table("what", "n", "p50", "p99", "longest", title=f"load {os.getloadavg()[0]:.1f}")
    async with running(judge, "arena") as robot:
        report_progress("measuring rates and load")
        share, rates = await load(robot, judge, seconds)
        rows: dict[str, Any] = {
            "scan at rclpy, later than on our bus (ms)": added_latency,
            "of that, by DDS and rclpy alone (ms)": bare_hops,
            "publisher killed: from its period to braking (ms)": brakings,
            "/estop called: to zero (ms)": stops,
            "a node comes: from its subscription to a message (ms)": late_joins,
            "gateway killed: until rclpy reads the next one (ms)": restarts,
        }
        for name, measure in rows.items():
            report_progress(f"measuring: {name}")
            values = sorted(await measure(robot, judge, count))
            shown = (statistics.median(values), percentile(values, 0.99), values[-1])
            table.add_row(name, str(len(values)), *(f"{each:.1f}" for each in shown if each))
    listed = ", ".join(f"{topic} {hz:.1f} Hz" for topic, hz in rates.items())
    table.add_row(f"gateway's share of a core (%); {listed}", "", f"{share:.1f}")
    return table


async def measured(count: int, seconds: float, goal_count: int) -> None:
    """Measure, and print the tables."""
    with tempfile.TemporaryDirectory() as folder, judging(build(), Path(folder)) as judge:
        if count:
            Console().print(await times(judge, count, seconds))
        if goal_count:
            table = Table("navigate_to_pose in the house", "as wanted")
            for way, (right, of) in (await goals(judge, goal_count)).items():
                table.add_row(way, f"{right} of {of}")
            Console().print(table)


@app.default
def main(*, count: int = 20, seconds: float = 10.0, goals: int = 20) -> int:
    """Measure latency, braking, e-stop and load, then navigation, and print tables.

    Args:
        count: How often each time is measured.
        seconds: How long the load is measured.
        goals: How many goals are followed, cancelled, and preempted, each.
    """
    asyncio.run(measured(count, seconds, goals))
    return 0


if __name__ == "__main__":
    sys.exit(app())
