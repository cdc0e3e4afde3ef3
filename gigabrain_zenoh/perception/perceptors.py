"""Perceptors: perception steps offered by packages, each in its own process.

A perceptor detects objects in each scan, which are published on `robot/perceived/<name>`.
Behaviours receive these objects, and the planner keeps clear of those that are to be avoided. A
perceptor that raises or hangs stops no other process. Packages offer perceptors as entry points of
the group `gigabrain.perceptors`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, cast

from msgspec import Struct

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import DetectedObject, Objects, WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY, PERCEIVED, SCAN, STATE, WORLD
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import unknown
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.plugins import load_plugin, plugin_names

GROUP = "gigabrain.perceptors"
SHIPPED: Mapping[str, Any] = {}


@dataclass(frozen=True, kw_only=True, eq=False)
class PerceptorInputs:
    """Inputs of a perceptor at one scan."""

    scan: LaserScan
    world: WorldModel  # perception's model of that scan, in the body's frame
    pose: Pose  # of the body at the scan, in the odometry frame
    body: BodyDescription


class Perceptor(Protocol):
    """Detects objects, one step per scan. It may keep state, but has no clock and no bus."""

    Config: ClassVar[type[Struct]]

    def __init__(self, config: Any) -> None: ...

    def step(self, inputs: PerceptorInputs) -> Sequence[DetectedObject]:
        """Return the objects at this scan, in the odometry frame."""
        ...


def check_known(name: str) -> None:
    """Raise UnknownName if no installed package offers the perceptor. Nothing is imported."""
    if name not in (known := plugin_names(SHIPPED, GROUP)):
        raise unknown("perceptor", name, known)


def load(name: str) -> type[Perceptor]:
    """Return the perceptor called `name`. Raises UnknownName, and ConfigError if it is broken."""
    found = load_plugin("perceptor", name, SHIPPED, GROUP, ("Config", "step"))
    return cast("type[Perceptor]", found)


class PerceptorLoop:
    """Steps a perceptor once per world, as soon as the state of its tick has arrived."""

    def __init__(self, perceptor: Perceptor) -> None:
        self._perceptor = perceptor
        self._history = PoseHistory()
        self._waiting: tuple[LaserScan, WorldModel] | None = None
        self._scan: LaserScan | None = None

    def add_scan(self, scan: LaserScan) -> None:
        """Keep a scan until the world based on it arrives."""
        self._scan = scan

    def add_world(self, world: WorldModel) -> None:
        """Keep a world until the state of its tick arrives."""
        scan = self._scan
        found = scan and (scan.boot, scan.basis) == (world.boot, world.basis)
        self._waiting = (scan, world) if scan and found else None
        self._scan = None  # cameras cause more worlds from the same scan

    def add_state(self, state: RobotState) -> None:
        """Add a robot state, for its odometry pose."""
        self._history = self._history.then(state)

    def step(self, body: BodyDescription) -> tuple[Objects, int] | None:
        """Return the detected objects and their basis; None while an input is missing."""
        if self._waiting is None:
            return None
        scan, world = self._waiting
        pose = self._history.at(scan.boot, scan.basis)
        if pose is None:
            return None
        self._waiting = None
        found = self._perceptor.step(PerceptorInputs(scan=scan, world=world, pose=pose, body=body))
        return Objects(objects=tuple(found)), world.basis


async def run(perceptor: Perceptor, bus: Bus, ready: Callable[[], None]) -> None:
    """Publish a perceptor's objects for each scan, until the process ends."""
    loop, body = PerceptorLoop(perceptor), bus.latest(BODY)

    def publish() -> None:
        found = loop.step(body.current.description) if body.current else None
        if found:
            objects, basis = found
            bus.publish(PERCEIVED, objects, basis=basis, name=bus.process)

    def on_world(world: WorldModel) -> None:
        loop.add_world(world)
        publish()

    def on_state(state: RobotState) -> None:
        loop.add_state(state)
        publish()

    bus.latest(SCAN, loop.add_scan)
    bus.latest(WORLD, on_world)
    bus.latest(STATE, on_state)
    ready()
    await bus.failed
