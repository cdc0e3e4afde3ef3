"""Compile whatever a driving robot calls, before it drives."""

import numpy as np

from gigabrain_zenoh.mapping import grid
from gigabrain_zenoh.mapping.field import field_of
from gigabrain_zenoh.mapping.points import Scan
from gigabrain_zenoh.mapping.relocalize import search
from gigabrain_zenoh.mapping.se2 import IDENTITY
from gigabrain_zenoh.mapping.slam import Slam

BEAMS, ROOM_M = 60, 1.0
STRIDE_M, STEPS = 0.5, 30  # far enough for a loop to be looked for


def warm_up() -> None:
    """Call every kernel once, in a room of 2 x 2 m."""
    angles = np.linspace(0.0, 2 * np.pi, BEAMS, endpoint=False)
    ways = np.column_stack((np.cos(angles), np.sin(angles)))
    scan = Scan.of(ROOM_M * ways / np.abs(ways).max(axis=1, keepdims=True), ways[:1])
    grid.warm_up()
    drawn = grid.Grid()
    drawn.draw(IDENTITY, scan.points, scan.free)
    field = field_of(drawn.percent(), grid.CELL, (drawn.origin_x, drawn.origin_y))
    search(field, scan.points, scan.free, IDENTITY[:2])
    slam = Slam()
    for _ in range(STEPS):  # round and round, as far as odometry knows
        slam.add(scan, np.array((STRIDE_M, 0.0, 0.0)))
        slam.relocate(IDENTITY)
    while slam.behind:
        slam.close_loops()
