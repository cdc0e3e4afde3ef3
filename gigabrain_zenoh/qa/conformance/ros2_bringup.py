"""The bringup check of a ROS 2 robot: a node listens for a while, and compares with the file."""

import asyncio
import contextlib
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gigabrain_drivers.bodies.ros2 import options as ros2
from gigabrain_drivers.bodies.ros2.bringup import (
    Finding,
    Row,
    TopicStatistics,
    Watched,
    findings,
    rows,
)
from gigabrain_drivers.bodies.ros2.conversion import Unusable, battery_of, imu_of, joints_of
from gigabrain_drivers.bodies.ros2.link import all_types
from gigabrain_drivers.bodies.ros2.options import Ros2Options
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import Emulator
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import BadPayload, ConfigError
from gigabrain_zenoh.ros2.opening import open_transport
from gigabrain_zenoh.ros2.qos import Qos
from gigabrain_zenoh.ros2.transport import Received, RosTransport
from gigabrain_zenoh.ros2.types import Types

START_S = 10.0  # for an emulator's nodes to start
DISCOVERY_S = 1.0  # until messages count
POLL_S = 0.05
DEPTH = 50


async def check(name: str, link: LinkName, folder: Path, seconds: float) -> list[Finding]:
    """Listen to a robot for a while; return the findings. Raises ConfigError."""
    run = Run(folder=folder, link=link, emulator=str(folder))
    robot, _, options, _ = catalog.load_link(name, run)
    if not isinstance(options, Ros2Options):
        raise ConfigError(
            f"{name}: its link {link} has driver: {options.driver}; expected driver: ros2"
        )
    types = await asyncio.to_thread(all_types)
    async with contextlib.AsyncExitStack() as stack:
        if link == "emulated":
            await stack.enter_async_context(Emulator(name, run))
        joined = await _address(options)
        transport = await stack.enter_async_context(open_transport(joined, types))
        watched = await watch(transport, types, options, seconds)
    return findings(options, robot.lidar, watched)


async def _address(options: Ros2Options) -> Any:
    """Return how to join, as soon as an emulator's address exists. Raises ConfigError."""
    end_s = time.monotonic() + START_S
    while True:
        try:
            return options.link(f"{options.node}_bringup"[:64])
        except ConfigError:
            if time.monotonic() > end_s:
                raise
            await asyncio.sleep(POLL_S)


async def watch(
    transport: RosTransport, types: Types, options: Ros2Options, seconds: float
) -> Watched:
    """Listen on all topics of the robot's file, and return the results."""
    watched, begun = Watched(), False
    best_effort = Qos(reliable=False, depth=DEPTH)  # which matches every publisher
    for row in rows(options):
        if row.part != "mounting":
            statistics = watched.statistics[row.part] = TopicStatistics()
            taker = _taker(row, types, statistics, _converter(row.part, options), lambda: begun)
            transport.subscribe(row.topic, row.type, best_effort, taker)
    latched = Qos(transient_local=True, depth=DEPTH)

    def take_frames(received: Received) -> None:
        with contextlib.suppress(BadPayload):
            watched.frames.add(types.decode(ros2.TF, received.payload).transforms)

    transport.subscribe(ros2.TF_STATIC_TOPIC, ros2.TF, latched, take_frames)
    await asyncio.sleep(min(DISCOVERY_S, seconds / 2))
    begun = True
    await asyncio.sleep(seconds)
    watched.endpoints = transport.endpoints()
    return watched


def _converter(part: str, options: Ros2Options) -> Callable[[Any], object]:
    """Return the driver's conversion of a topic's messages, without their mounting."""
    topics = options.topics
    if part == "battery" and topics.battery:
        return functools.partial(battery_of, options=topics.battery)
    if part == "joints" and topics.joints:
        return functools.partial(joints_of, options=topics.joints)
    return imu_of if part == "imu" else lambda message: message


def _taker(
    row: Row,
    types: Types,
    statistics: TopicStatistics,
    convert: Callable[[Any], object],
    begun: Callable[[], bool],
) -> Callable[[Received], None]:
    """Return the handler of a topic's messages."""
    first_s: list[float] = []

    def take(received: Received) -> None:
        if not begun():
            return
        now_s = time.monotonic()
        if not first_s:
            first_s.append(now_s)
        try:
            message = types.decode(row.type, received.payload)
        except BadPayload as error:
            statistics.unreadable = str(error)
            return
        statistics.take(message, time.time_ns(), now_s - first_s[0])
        try:
            convert(message)
            statistics.unusable = ""  # the first messages of a sensor may be empty
        except Unusable as error:
            statistics.unusable = str(error)

    return take
