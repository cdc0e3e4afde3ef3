"""Contours from cameras: the decision node drives among obstacles that no beam hits."""

import math

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import Camera
from gigabrain_schemas.brain import Contour, WorldModel
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import GOAL
from gigabrain_zenoh.geometry.sweep import depth, edges
from gigabrain_zenoh.testing.samples import WAFFLE
from tests.node.plane import Plane, drawn

OPEN = drawn(
    """
####################
#..................#
#..................#
#..................#
#..................#
#..................#
#..................#
####################
"""
)
SIGHT_M, HALF_VIEW, MEMORY_M = 2.5, 0.52, 3.0  # range, half the view [rad], memory
TABLE = np.array(((2.3, 0.3), (2.8, 0.3), (2.8, 1.15), (2.3, 1.15)))
BARRIER = np.array(((2.4, 0.1), (2.5, 0.1), (2.5, 1.9), (2.4, 1.9)))


def outline(corners: Floats) -> Floats:
    """Return points along the edges, a few centimetres apart."""
    shares = np.linspace(0.0, 1.0, 50)[:, None, None]
    found: Floats = corners + shares * (np.roll(corners, -1, axis=0) - corners)
    return found.reshape(-1, 2)


class CameraPlane(Plane):
    """A body with a camera, among obstacles that its lidar does not see."""

    def __init__(self, *obstacles: Floats) -> None:
        super().__init__(OPEN)
        self.obstacles, self.seen = list(obstacles), set[int]()
        self.description = replace(WAFFLE, cameras=(Camera(name="front", depth=True),))
        self.min_distance = math.inf  # [m], from the footprint to an obstacle

    def _world(self) -> WorldModel:
        contours = []
        for number, corners_in_map in enumerate(self.obstacles):
            here, rim = self._in_body(corners_in_map), self._in_body(outline(corners_in_map))
            self.min_distance = min(
                self.min_distance, float(depth(edges(WAFFLE.footprint), rim).min())
            )
            away, bearing = np.hypot(*rim.T), np.abs(np.arctan2(*rim.T[::-1]))
            if ((away < SIGHT_M) & (bearing < HALF_VIEW)).any():
                self.seen.add(number)
            elif away.min() > MEMORY_M:
                self.seen.discard(number)
            if number in self.seen:
                corners = tuple((x, y) for x, y in here.tolist())
                contours.append(Contour(polygon=corners, bottom=0.0, top=0.4, track=number))
        return replace(super()._world(), contours=tuple(contours))

    def _in_body(self, points: Floats) -> Floats:
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        off: Floats = (points - (self.x, self.y)) @ np.array(((cosine, -sine), (sine, cosine)))
        return off


async def test_it_drives_round_a_table_that_its_lidar_does_not_see() -> None:
    async with CameraPlane(TABLE) as plane:
        await plane.go(0.2)
        assert (await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))).ok
        await plane.go(1.0)
        assert max(y for _, y in plane.status.path) > 1.3  # the path leads round it from the start
        await plane.until("succeeded", seconds=60)
        assert plane.min_distance > 0.0


async def test_it_waits_before_a_barrier_and_drives_on_when_that_is_gone() -> None:
    async with CameraPlane(BARRIER) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=1.0))
        await plane.go(8.0)
        assert plane.x < 2.4
        plane.obstacles.clear()
        await plane.until("succeeded", seconds=60)
        assert plane.min_distance > 0.0


async def test_a_camera_that_sees_nothing_does_not_change_the_drive() -> None:
    drives = []
    plane: Plane
    for plane in (Plane(OPEN), CameraPlane()):
        async with plane:
            await plane.go(0.2)
            await plane.ask_at_once(GOAL, GoalRequest(x=3.0, y=1.2))
            await plane.go(5.0)
            assert plane.travelled > 0.5
            drives.append((plane.x, plane.y, plane.yaw, [one.twist for one in plane.intents]))
    assert drives[0] == drives[1]
