"""Manoeuvres that only some drive types can do, by a whole robot with its body in MuJoCo."""

import itertools
import math
from pathlib import Path

from gigabrain_drivers.sim.world import Box, Pose, World
from tests.node.mujoco_plant import MujocoPlant, heading_difference, send_to

WALL_HEIGHT_M = 0.6


def world(half_x: float, half_y: float, start: Pose, *boxes: Box) -> World:
    return World(
        name="lane", description="", half_x=half_x, half_y=half_y, shapes=boxes, start=start
    )


async def test_a_car_turns_round_in_a_narrow_dead_end(tmp_path: Path) -> None:
    """The lane is 1.1 m wide; a half circle of the car's middle alone takes 0.9 m."""
    plant = MujocoPlant("ackermann_car", world(2.5, 0.55, Pose(1.2, 0.0, 0.0)))
    status = await send_to(plant, (-2.4, 0.0, math.pi), tmp_path, 90.0)
    assert status.done, status
    assert status.done[0].state == "succeeded", status
    pose = plant.simulation.truth.pose()
    assert math.hypot(pose.x + 1.2, pose.y) < 0.2
    assert heading_difference(pose.yaw, math.pi) < 0.2
    assert plant.simulation.truth.contacts == 0
    gears = [math.copysign(1, one.linear_x) for one in plant.speeds if abs(one.linear_x) > 0.05]
    assert 1 <= sum(a != b for a, b in itertools.pairwise(gears)) <= 6


async def test_a_mecanum_base_passes_two_offset_gaps_without_turning(
    tmp_path: Path,
) -> None:
    """Two gaps of 0.66 m, 1 m apart and half a metre offset: the way runs at 27 degrees."""
    start = Pose(-1.4, -0.25, 0.0)
    plant = MujocoPlant("mecanum_cart", world(2.0, 1.0, start, *offset_gaps()))
    status = await send_to(plant, (2.8, 0.5, 0.0), tmp_path, 90.0)
    assert status.done, status
    assert status.done[0].state == "succeeded", status
    pose = plant.simulation.truth.pose()
    assert math.hypot(pose.x - 1.4, pose.y - 0.25) < 0.2
    assert plant.simulation.truth.contacts == 0
    assert max(heading_difference(one.yaw, 0.0) for one in plant.poses) < 0.3
    assert max(one.linear_y for one in plant.speeds) > 0.1


async def test_a_mecanum_base_moves_half_a_metre_sideways_without_turning(tmp_path: Path) -> None:
    plant = MujocoPlant("mecanum_cart", world(2.0, 2.0, Pose(0.0, 0.0, 0.0)))
    status = await send_to(plant, (0.0, 0.5, 0.0), tmp_path, 30.0)
    pose = plant.simulation.truth.pose()
    assert status.done, status
    assert status.done[0].state == "succeeded", status
    assert math.hypot(pose.x, pose.y - 0.5) < 0.15
    assert max(heading_difference(one.yaw, 0.0) for one in plant.poses) < 0.15


def offset_gaps() -> tuple[Box, ...]:
    """Return two walls 1 m apart, with gaps of 0.66 m at y = -0.25 and y = 0.25."""
    return (
        Box(-0.55, 0.54, 0.05, 0.46, WALL_HEIGHT_M),
        Box(-0.55, -0.79, 0.05, 0.21, WALL_HEIGHT_M),
        Box(0.55, 0.79, 0.05, 0.21, WALL_HEIGHT_M),
        Box(0.55, -0.54, 0.05, 0.46, WALL_HEIGHT_M),
    )
