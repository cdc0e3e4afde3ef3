"""The driver of a simulated body dies and restarts, while the brain keeps its map."""

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.topics import POSE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import DecisionConfig, DriverConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.geometry.se2 import between
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.safety import node as safety

WAFFLE, WORLD = "turtlebot3_waffle", "arena"  # its scans look alike at 16 places
Node = Callable[[Bus, Callable[[], None]], Awaitable[None]]
BRAIN: tuple[Node, ...] = (
    lambda bus, ready: perception.run(PerceptionConfig(mapping="slam"), bus, ready),
    lambda bus, ready: decision.run(DecisionConfig(behaviour="avoid"), bus, ready),
    control.run,
    safety.run,
)


def start(node: Node, network: LocalNetwork) -> "asyncio.Future[None]":
    return asyncio.ensure_future(node(Bus(network.transport(), Clock()), lambda: None))


@asynccontextmanager
async def brain(network: LocalNetwork) -> AsyncIterator[list["asyncio.Future[None]"]]:
    tasks = [start(node, network) for node in BRAIN]
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def drive(network: LocalNetwork, folder: Path, seconds: float) -> dict[str, object]:
    """Let the brain drive until `seconds` of the run, then end the driver; return its report."""
    run = Run(
        folder=Path(), world=WORLD, speed=100.0, seconds=seconds, checkpoint=str(folder / "cp")
    )
    robot, driver = catalog.make_driver(WAFFLE, run)
    config = DriverConfig(
        body=WAFFLE, speed=100.0, resume="auto", state_dir=str(folder), lockstep_timeout_s=10.0
    )
    bus = Bus(network.transport(), Clock())
    process = DriverProcess(config, robot, driver, bus)
    task = asyncio.ensure_future(process.run(lambda: None))
    while not driver.finished:
        await asyncio.sleep(0.01)
        assert process.report()["lockstep_timeouts"] == 0
        if task.done():
            task.result()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    return dict(driver.report())


async def test_after_the_death_of_the_driver_the_robot_is_localized_and_drives_on(
    tmp_path: Path,
) -> None:
    network, poses = LocalNetwork(), list[PoseInMap]()
    watcher = Bus(network.transport(), Clock())
    watcher.subscribe(POSE, lambda _, pose: poses.append(pose))
    async with brain(network):
        before = await drive(network, tmp_path, 8.0)
        assert poses[-1].localized
        boot = poses[-1].boot
        after = await drive(network, tmp_path, 14.0)
    localized = [pose for pose in poses if pose.boot != boot and pose.localized]
    assert len(localized) > 30  # of 60 poses in 6 s
    start_pose = load_world(WORLD, 0).start
    x, y, yaw = (float(str(after[name])) for name in ("true_x", "true_y", "true_yaw"))
    truth = between(np.array((start_pose.x, start_pose.y, start_pose.yaw)), np.array((x, y, yaw)))
    assert math.dist((localized[-1].x, localized[-1].y), truth[:2].tolist()) < 0.15
    assert float(str(after["distance_m"])) > float(str(before["distance_m"])) + 0.5
