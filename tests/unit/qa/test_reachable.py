"""Goals of `bench goals --headings`: poses that a body's motions can reach."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.sim.world import Box, Pose, World
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.qa.bench.reachable import reachable_poses
from gigabrain_zenoh.testing.samples import WAFFLE

LONG = replace(WAFFLE, footprint=((0.3, 0.1), (-0.3, 0.1), (-0.3, -0.1), (0.3, -0.1)), lidar=None)
SIDEWAYS = replace(LONG, drive_type="mecanum", max_lateral_speed=0.2)
CAR = replace(LONG, drive_type="ackermann", min_turning_radius=0.5)


def lane(*boxes: Box, half_y: float = 1.0) -> World:
    start = Pose(-1.0, 0.0, 0.0)
    return World(name="lane", description="", half_x=2.0, half_y=half_y, shapes=boxes, start=start)


def turned_round(poses: Floats) -> bool:
    return bool((np.abs(np.mod(poses[:, 2], math.tau) - math.pi) < 0.3).any())


@pytest.mark.long
@pytest.mark.parametrize("body", [LONG, SIDEWAYS, CAR])
def test_in_a_wide_room_every_heading_is_reached(body: BodyDescription) -> None:
    poses = reachable_poses(body, lane(half_y=1.5))
    assert turned_round(poses)
    assert len(poses) > 1000


@pytest.mark.long
def test_poses_keep_away_from_obstacles() -> None:
    poses = reachable_poses(LONG, lane(Box(0.5, 0.0, 0.2, 0.2, 0.5)))
    for x, y, yaw in poses.tolist():
        for ahead in (-0.3, 0.0, 0.3):
            at_x, at_y = x + ahead * math.cos(yaw), y + ahead * math.sin(yaw)
            assert max(abs(at_x - 0.5), abs(at_y)) > 0.25


def test_in_a_narrow_lane_no_body_turns_round() -> None:
    for body in (LONG, SIDEWAYS, CAR):
        poses = reachable_poses(body, lane(half_y=0.3))
        assert not turned_round(poses)
        assert poses[:, 0].max() > 1.3


@pytest.mark.long
def test_only_a_body_with_lateral_motion_reaches_a_niche_beside_a_lane() -> None:
    """The niche is 1 m long and as deep as the body is wide; the lane is too narrow to turn in."""
    beside = (Box(-1.25, 0.6, 0.75, 0.3, 0.5), Box(1.25, 0.6, 0.75, 0.3, 0.5))
    world = lane(*beside, Box(0.0, -0.6, 2.0, 0.3, 0.5), half_y=0.9)
    deepest = {
        body.drive_type: float(reachable_poses(body, world)[:, 1].max())
        for body in (LONG, SIDEWAYS, CAR)
    }
    assert deepest["mecanum"] > 0.6
    assert deepest["differential"] < 0.3
    assert deepest["ackermann"] < 0.3
