"""A page of a fake robot that publishes on all topics."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Body, Camera, GateMode, RobotState
from gigabrain_schemas.brain import (
    Contour,
    DetectedObject,
    Intent,
    Objects,
    Obstacle,
    OccupancyGrid,
    PoseInMap,
    TrajectoryPoint,
    Twist,
    WorldModel,
)
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.objects import MapObject, MapTag, ObjectMap
from gigabrain_schemas.requests import EstopRequest, GateReply
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.tasks import GoalReply, GoalRequest, TaskReply, TaskRequest, TaskStatus
from gigabrain_schemas.topics import (
    BODY,
    CAMERA,
    ESTOP,
    GOAL,
    INTENT,
    MAP,
    OBJECT_MAP,
    PERCEIVED,
    POSE,
    SCAN,
    STATE,
    TASK,
    TASK_CHANGE,
    TELEOP,
    WORLD,
)
from gigabrain_schemas.vision import CameraInfo
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.testing.processes import free_port
from gigabrain_zenoh.ui.page.server import run
from tests.system.page import OPERATOR, VIEWER

SIDE_CELLS = 80  # of the map, 0.05 m each; its corner is at (-2, -2)


def wall_ahead() -> LaserScan:
    """Return a Waffle's scan of a wall 1.2 m ahead; its lidar is 0.064 m behind its middle."""
    angles = np.radians(np.arange(-20, 21))
    return LaserScan(
        angle_min=float(angles[0]), angle_increment=math.radians(1.0), range_min=0.1, range_max=3.5,
        ranges=ranges_bytes((1.2 + 0.064) / np.cos(angles)),
    )  # fmt: skip


# ahead of the robot, at (0.5, 0) in its map: a low box, a table top, and a step down
CONTOURS = (
    Contour(polygon=((0.7, 0.5), (0.9, 0.5), (0.9, 0.7), (0.7, 0.7)), bottom=0.0, top=0.05),
    Contour(polygon=((0.7, 0.9), (0.9, 0.9), (0.9, 1.1), (0.7, 1.1)), bottom=0.5, top=0.75),
    Contour(polygon=((0.7, 1.3), (0.9, 1.3), (0.9, 1.5), (0.7, 1.5)), bottom=-0.2, top=0.0),
)
THINGS = ObjectMap(
    objects=(
        MapObject(id=3, label="can", x=0.0, y=-1.0, z=0.06, size=(0.07, 0.12), confidence=0.9),
        MapObject(id=4, label="can", x=-1.0, y=1.0, z=0.06, size=(0.07, 0.12), confidence=0.6),
        MapObject(id=5, label="ball", x=-1.0, y=-1.0, z=0.1, size=(0.2, 0.2), confidence=0.8),
    ),
    tags=(MapTag(id=7, x=-1.4, y=0.5, z=0.2, yaw=0.0, size=0.1),),
)
REAR = CameraInfo(camera=Camera(name="rear"), problem="covered")


class Fake:
    """A robot with all topics, which stands at (0.5, 0) in its map and at (1, 1) by odometry."""

    def __init__(self, folder: Path, **config: object) -> None:
        network = LocalNetwork()
        self.robot = Bus(network.transport(), Clock(), "driver")
        self.bus = Bus(network.transport(), Clock(), "page")
        tokens = folder / "tokens.json"
        tokens.touch(0o600)
        tokens.write_text(f'{{"operator": "{OPERATOR}", "viewer": "{VIEWER}"}}')
        values = {"port": free_port(), "tokens": str(tokens), "login": True} | config
        self.config = msgspec.convert(values, PageConfig)
        self._published = 0
        self.mode: GateMode = "enabled"
        self.goals: list[GoalRequest] = []
        self.changes: list[TaskRequest] = []
        self.steered: list[Twist] = []
        self.robot.subscribe(TELEOP, lambda _key, twist: self.steered.append(twist))
        self.robot.serve(GOAL, self._go)
        self.robot.serve(TASK_CHANGE, self._change)
        self.presses: list[str] = []
        self.robot.serve(ESTOP, self._stop)

    @property
    def origin(self) -> str:
        scheme = "https" if self.config.certificate else "http"
        return f"{scheme}://127.0.0.1:{self.config.port}"

    async def _go(self, goal: GoalRequest) -> GoalReply:
        self.goals.append(goal)
        return GoalReply(ok=True, text="on the way, 4.2 m", goal="goal-7")

    async def _stop(self, request: EstopRequest) -> GateReply:
        self.presses.append(request.source)
        reply = EXAMPLES["GateReply"]
        assert isinstance(reply, GateReply)
        return replace(reply, gate=replace(reply.gate, mode="latched"))

    async def _change(self, request: TaskRequest) -> TaskReply:
        self.changes.append(request)
        return TaskReply(ok=True, text="goal-7 is cancelled")

    def publish_repeatedly(self) -> None:
        """Publish the topics that are published repeatedly."""
        state = EXAMPLES["RobotState"]
        assert isinstance(state, RobotState)
        gate = replace(state.gate, mode=self.mode, commander="control", causes=())
        state = replace(state, pose=Pose(x=1.0, y=1.0, yaw=0.0), gate=gate)
        self.robot.publish(STATE, state)
        self.robot.publish(POSE, PoseInMap(x=0.5, y=0.0, yaw=0.0, covariance=(0.0,) * 9))
        thing = Obstacle(id=1, x=1.0, y=1.8, radius=0.3)  # at (0.5, 0.8) in the map
        wall = Obstacle(id=2, x=2.2, y=1.0, radius=0.45)
        world = WorldModel(
            scan_ok=True, obstacle_ahead=False, obstacles=(thing, wall), contours=CONTOURS
        )
        self._published += 1
        self.robot.publish(WORLD, world, basis=self._published)
        self.robot.publish(CAMERA, REAR, name="rear")
        # (1.8, 1.5) in the map
        person = DetectedObject(id=9, x=2.3, y=2.5, radius=0.2, label="person")
        self.robot.publish(PERCEIVED, Objects(objects=(person,)), name="people")
        self.robot.publish(SCAN, wall_ahead())
        trajectory = tuple(TrajectoryPoint(t=i / 10, x=i / 10, y=0.0, yaw=0.0) for i in range(11))
        intent = Intent(
            trajectory=trajectory, behaviour="navigate", reason="on its way to the kitchen"
        )
        self.robot.publish(INTENT, intent)

    def publish_once(self) -> None:
        """Publish the kept topics once: body, map, objects and task."""
        body = load_robot("turtlebot3_waffle").description()
        self.robot.publish(BODY, Body(description=body, link="sim"))
        cells = np.zeros((SIDE_CELLS, SIDE_CELLS), np.int8)
        cells[:, 10] = 100  # a wall at x = -1.5
        cells[60:, 40:] = -1
        self.robot.publish(
            MAP,
            OccupancyGrid(
                resolution=0.05, width=SIDE_CELLS, height=SIDE_CELLS, origin_x=-2.0, origin_y=-2.0,
                cells=cells.tobytes(),
            ),
        )  # fmt: skip
        task = EXAMPLES["TaskStatus"]
        assert isinstance(task, TaskStatus)
        self.robot.publish(OBJECT_MAP, THINGS)
        self.robot.publish(TASK, replace(task, path=((0.5, 0.0), (0.5, -1.5), (1.5, -1.5))))


@contextlib.asynccontextmanager
async def serving(fake: Fake) -> AsyncIterator[None]:
    ready = asyncio.Event()
    server = asyncio.ensure_future(run(fake.config, fake.bus, ready.set))

    async def publish() -> None:
        while True:
            fake.publish_repeatedly()
            await asyncio.sleep(0.05)

    fake.publish_once()
    publishing = asyncio.ensure_future(publish())
    await ready.wait()
    try:
        yield
    finally:
        for task in (publishing, server):
            task.cancel()
        await asyncio.gather(publishing, server, return_exceptions=True)
