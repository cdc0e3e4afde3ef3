"""A body that can drive sideways, with all nodes of the robot, in memory and fake time."""

import functools
import math
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.tasks import GoalRequest, TaskStatus
from gigabrain_schemas.topics import GOAL, STATE, TASK
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.geometry.sweep import depth, edges
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.in_memory_robot import InMemoryRobot, node_of
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.safety.health import Host
from tests.unit.mapping.rooms import box, ranges
from tests.unit.navigation.drives import OMNI, wall

TICK_S, SCAN_TICKS, DELAY_TICKS, LAG_S = 0.02, 5, 3, 0.1
WALL_THICKNESS_M = 0.1  # at y 1.2 to 1.3; its gap is 0.56 m wide, the body 0.24 x 0.6 m
WALLS = np.array(
    [
        *box(-1.5, -1.2, 4.0, 4.4),
        *box(-1.5, 1.2, 2.22, WALL_THICKNESS_M),
        *box(1.28, 1.2, 1.22, WALL_THICKNESS_M),
    ]
)
POINTS = np.vstack([wall((x0, y0), (x1, y1)) for x0, y0, x1, y1 in WALLS.tolist()])
ANGLES = np.arange(360) * math.tau / 360


class OmniBody:
    """Drives as commanded in all directions of the plane, with a delay and a lag."""

    def __init__(self) -> None:
        self.pose, self.velocity = (0.0, 0.0, 0.0), ZERO
        self.tick, self.min_clearance = 0, math.inf
        self.poses: list[tuple[float, float, float]] = []
        self._queue = deque([ZERO] * DELAY_TICKS)
        self._noise = np.random.default_rng(3)

    def advance(self, velocity: Velocity) -> None:
        self.tick += 1
        self._queue.append(velocity)
        to, now, share = self._queue.popleft(), self.velocity, 1 - math.exp(-TICK_S / LAG_S)
        vx = now.linear_x + share * (to.linear_x - now.linear_x)
        vy = now.linear_y + share * (to.linear_y - now.linear_y)
        w = now.angular_z + share * (to.angular_z - now.angular_z)
        x, y, yaw = self.pose
        cosine, sine = math.cos(yaw + w * TICK_S / 2), math.sin(yaw + w * TICK_S / 2)
        self.velocity = Velocity(linear_x=vx, linear_y=vy, angular_z=w)
        self.pose = (
            x + (cosine * vx - sine * vy) * TICK_S,
            y + (sine * vx + cosine * vy) * TICK_S,
            math.remainder(yaw + w * TICK_S, math.tau),
        )
        self.poses.append(self.pose)
        self.min_clearance = min(self.min_clearance, self._clearance())

    def state(self) -> RobotState:
        x, y, yaw = self.pose
        return RobotState(robot_type="omni", pose=Pose(x=x, y=y, yaw=yaw), velocity=self.velocity)

    def scan(self) -> LaserScan | None:
        if self.tick % SCAN_TICKS or OMNI.lidar is None:
            return None
        seen = ranges(WALLS, np.array(self.pose), ANGLES) + self._noise.normal(0, 0.01, 360)
        return LaserScan(
            angle_min=0.0,
            angle_increment=math.tau / 360,
            range_min=OMNI.lidar.range_min,
            range_max=OMNI.lidar.range_max,
            ranges=ranges_bytes(seen),
        )

    def _clearance(self) -> float:
        x, y, yaw = self.pose
        cosine, sine = math.cos(yaw), math.sin(yaw)
        here = (POINTS - (x, y)) @ np.array(((cosine, -sine), (sine, cosine)))
        return float(depth(edges(OMNI.footprint), here).min())


async def _safety(bus: Bus, ready: Callable[[], None]) -> None:
    await safety.run(bus, ready, lambda _now_ns: Host())


def nodes(body: OmniBody, folder: Path) -> dict[str, Node]:
    settings = DecisionConfig(
        behaviour="navigate", settings={"unknown_space": "allow"}, compile_first=True
    )
    return {
        "perception": functools.partial(
            perception.run, PerceptionConfig(mapping="slam", compile_first=True)
        ),
        "decision": functools.partial(decision.run, settings),
        "control": control.run,
        "safety": _safety,
        "driver": node_of(OMNI, body, str(folder)),
    }


async def test_it_drives_sideways_through_a_gap_narrower_than_its_length(
    tmp_path: Path,
) -> None:
    body = OmniBody()
    async with InMemoryRobot(nodes(body, tmp_path)) as robot:
        states = robot.operator.latest(STATE)
        statuses: list[TaskStatus] = []
        robot.operator.subscribe(TASK, lambda _, status: statuses.append(status))
        while not (states.current and states.current.gate.mode == "enabled") or body.tick < 100:
            await robot.tick()
        (reply,) = await robot.ask(GOAL, GoalRequest(x=1.0, y=2.3, yaw=0.0, source="test"))
        assert reply.ok, reply.text
        while not statuses[-1].done and body.tick < 3000:
            await robot.tick()
    assert statuses[-1].done[0].state == "succeeded", statuses[-1]
    x, y, yaw = body.pose
    assert math.hypot(x - 1.0, y - 2.3) < 0.15
    assert abs(yaw) < 0.2
    assert body.min_clearance > 0.0
    within = [pose for pose in body.poses if 1.1 < pose[1] < 1.4]
    assert within
    assert max(abs(math.sin(yaw)) for _, _, yaw in within) < 0.5
