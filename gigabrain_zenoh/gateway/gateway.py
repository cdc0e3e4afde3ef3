"""All ROS interfaces of one robot, on an open transport."""

import asyncio
import logging
from collections.abc import Callable

from gigabrain_schemas.base import Cause
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.errors import UnknownName, unknown
from gigabrain_zenoh.gateway import free_fleet
from gigabrain_zenoh.gateway.background import Background
from gigabrain_zenoh.gateway.conversions.diagnostics import Level, Status
from gigabrain_zenoh.gateway.diagnosing import Diagnosing
from gigabrain_zenoh.gateway.driving import PoseRequests, RosCommander
from gigabrain_zenoh.gateway.graph_watch import GraphWatch
from gigabrain_zenoh.gateway.joint_requests import JointRequests
from gigabrain_zenoh.gateway.nav2 import Nav2Actions
from gigabrain_zenoh.gateway.parameters import Parameters
from gigabrain_zenoh.gateway.publishing import COMMANDED, Publishing, table
from gigabrain_zenoh.gateway.scene import Scene
from gigabrain_zenoh.gateway.services import Services
from gigabrain_zenoh.ros2.transport import RosTransport
from gigabrain_zenoh.ros2.types import Types

log = logging.getLogger(__name__)
PERIOD_NS = 1_000_000_000
REMEDY = "see /diagnostics in ROS, or `gigabrain log --process ros2`"


class Gateway:
    """The parts of the gateway, and what runs beside the messages."""

    def __init__(self, config: Ros2Config, bus: Bus, ros: RosTransport, types: Types) -> None:
        self._bus, self._ros = bus, ros
        self.scene, self.work = Scene(bus), Background()
        scene, work = self.scene, self.work
        fleet = self._fleet = free_fleet.FreeFleet(bus) if config.free_fleet else None
        self.publishing = [Publishing(scene, ros, types, config)]
        if fleet:
            self.publishing.append(Publishing(scene, fleet, types, config, free_fleet.TOPICS))
        self.commander = RosCommander(scene, ros, types, config, work)
        self.poses = PoseRequests(scene, ros, types, config, work)
        self.joints = JointRequests(scene, ros, types, config, work)
        self.services = Services(scene, ros, types, config, self._forget)
        self.actions = Nav2Actions(scene, ros, types, config, fleet)
        self.parameters = Parameters(ros, types, config, lambda: scene.simulated)
        self.graph = GraphWatch(ros, config, self.commander.offsets_s)
        bus.report = self.graph.report
        self.diagnosing = Diagnosing(
            scene, ros, types, lambda: (*self._statuses(), self.graph.status())
        )

    async def close(self) -> None:
        """End all work for ROS; the gate stops a body that ROS drives."""
        await self.actions.close()
        await self.joints.close()
        for publishing in self.publishing:
            publishing.close()
        self.work.close()

    async def run(self) -> None:
        """Publish diagnostics, and report to the robot's own tools, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self.diagnosing.run())
            tasks.create_task(self._report())
            tasks.create_task(self._failure())

    async def _failure(self) -> None:
        await self.work.failed

    async def _report(self) -> None:
        """Add ROS's connection problems to health, once a second. Raises ConfigError."""
        async for _ in self._bus.clock.every(PERIOD_NS):
            self.graph.refuse_own_body()
            refused = (
                Cause(code=f"ros2_{one.name}", text=f"/{one.name}: {one.text}"[:500], remedy=REMEDY)
                for one in self._statuses()
                if one.level is not Level.OK
            )
            self._bus.problems = (*refused, *self.graph.look())
            for reason, count in self._ros.counts.items():
                self._bus.counters[f"ros_{reason}"] = count
            if self._fleet:
                self._bus.counters["free_fleet_refused"] = self._fleet.counts["refused"]

    def _statuses(self) -> list[Status]:
        return [self.commander.status(), *self.poses.status(), *self.joints.status()]

    def _forget(self, why: str) -> None:
        self.commander.forget(why)
        self.joints.forget(why)


def _check_left_out(config: Ros2Config) -> None:
    """Raise UnknownName if the settings leave out a name that the gateway does not offer."""
    known = {row.topic for row in table()} | COMMANDED.keys()
    for name in config.leave_out:
        plain = name.strip("/")
        if plain not in known and not plain.startswith("camera/"):
            raise UnknownName(f"ros2: leave_out: {unknown('name', name, known)}", value=name)


async def serve(
    config: Ros2Config, bus: Bus, ros: RosTransport, types: Types, ready: Callable[[], None]
) -> None:
    """Serve ROS until the process ends. Raises ConfigError."""
    _check_left_out(config)
    gateway = Gateway(config, bus, ros, types)
    running = asyncio.ensure_future(gateway.run())
    try:
        log.info("node %s on %s, domain %d", config.node, config.transport, config.domain)
        if config.free_fleet:
            log.info("serves Open-RMF's adapter free_fleet")
        ready()
        await asyncio.wait((running, bus.failed), return_when=asyncio.FIRST_COMPLETED)
    finally:
        await gateway.close()
        running.cancel()
        await asyncio.wait((running,))
    for end in (running, bus.failed):
        if end.done() and not end.cancelled():
            end.result()
