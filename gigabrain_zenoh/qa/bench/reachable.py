"""Finds the poses that a body's motions can reach in a world, independently of the planner.

It uses the true shapes of the world, not the map. A flood fill from the start makes short motions
of the body's kind, forward and back. It keeps one pose for each bin of position and heading.
"""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.world import Pose, World, clearance
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription

CELL_M = 0.05  # of the grid of distances
BIN_M, HEADINGS = 0.1, 36  # bins of positions and headings
STEP_M, TURN_RAD = 0.15, math.radians(12.0)  # of a motion; longer than a bin
OUTLINE_M = 0.05  # between points of the outline
SPARE_M = 0.05  # added to safety's margins, as maps have errors


def reachable_poses(body: BodyDescription, world: World) -> Floats:
    """Return poses (n, 3) that `body` reaches from the start of `world` [m, m, rad]."""
    distances, outline, motions = _distances(world), _outline(body), _motions(body)
    margin = max(body.thresholds.stop_margin, body.thresholds.side_margin) + SPARE_M
    start: Pose = world.start
    frontier = np.array([start])
    seen = _bins(frontier, world)
    found = [frontier]
    while len(frontier):
        moved = np.concatenate([
            _free_ends(distances, outline, margin, world, frontier, motion) for motion in motions
        ])  # fmt: skip
        bins, first = np.unique(_bins(moved, world), return_index=True)
        new = ~np.isin(bins, seen, assume_unique=True)
        seen = np.union1d(seen, bins[new])
        frontier = moved[first[new]]
        found.append(frontier)
    return np.concatenate(found)


def _motions(body: BodyDescription) -> list[tuple[float, float, float]]:
    """Return the body's motions, each one arc: (ahead [m], aside [m], turn [rad])."""
    if body.drive_type == "ackermann":
        bend = STEP_M / body.turning_radius
        turns = (-bend, 0.0, bend)
        return [(step, 0.0, turn * step / STEP_M) for step in (STEP_M, -STEP_M) for turn in turns]
    motions = [(STEP_M, 0.0, 0.0), (-STEP_M, 0.0, 0.0), (0.0, 0.0, TURN_RAD), (0.0, 0.0, -TURN_RAD)]
    if body.max_lateral_speed > 0:
        motions += [(0.0, STEP_M, 0.0), (0.0, -STEP_M, 0.0)]
    return motions


def _free_ends(
    distances: Floats, outline: Floats, margin: float, world: World, poses: Floats,
    motion: tuple[float, float, float],
) -> Floats:  # fmt: skip
    """Return the ends of `motion` from `poses` (n, 3), without motions that touch something."""
    free = np.ones(len(poses), np.bool_)
    moved = poses
    for share in (1 / 3, 2 / 3, 1.0):
        ahead, aside, turn = (share * part for part in motion)
        middle = poses[:, 2] + turn / 2
        cosine, sine = np.cos(middle), np.sin(middle)
        x, y = poses[:, 0] + ahead * cosine - aside * sine, poses[:, 1] + ahead * sine
        moved = np.column_stack((x, y + aside * cosine, poses[:, 2] + turn))
        free &= _clearances(distances, outline, world, moved) > margin
    return moved[free]


def _clearances(distances: Floats, outline: Floats, world: World, poses: Floats) -> Floats:
    """Return the outline's clearance [m] at each of `poses` (n, 3)."""
    cosine, sine = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x = poses[:, :1] + cosine * outline[:, 0] - sine * outline[:, 1]
    y = poses[:, 1:2] + sine * outline[:, 0] + cosine * outline[:, 1]
    rows, columns = (y + world.half_y) / CELL_M, (x + world.half_x) / CELL_M
    height, width = distances.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    row, column = np.where(inside, rows, 0).astype(np.intp), np.where(inside, columns, 0)
    rooms = np.where(inside, distances[row, column.astype(np.intp)], 0.0)
    least: Floats = rooms.min(axis=1)
    return least


def _distances(world: World) -> Floats:
    """Return the distance from the middle of each cell to the nearest shape (h, w) [m]."""
    shapes = world.everything()
    ys = np.arange(-world.half_y + CELL_M / 2, world.half_y, CELL_M)
    xs = np.arange(-world.half_x + CELL_M / 2, world.half_x, CELL_M)
    return np.array([[clearance(shapes, x, y) for x in xs.tolist()] for y in ys.tolist()])


def _outline(body: BodyDescription) -> Floats:
    """Return points of the footprint's outline (k, 2) [m]."""
    corners = np.array(body.footprint)
    pieces = []
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        count = max(1, math.ceil(float(np.hypot(*(end - begin))) / OUTLINE_M))
        pieces.append(begin + (end - begin) * (np.arange(count) / count)[:, None])
    return np.concatenate(pieces)


def _bins(poses: Floats, world: World) -> NDArray[np.int64]:
    column = np.floor((poses[:, 0] + world.half_x) / BIN_M).astype(np.int64)
    row = np.floor((poses[:, 1] + world.half_y) / BIN_M).astype(np.int64)
    heading = np.floor(np.mod(poses[:, 2], math.tau) / math.tau * HEADINGS).astype(np.int64)
    return (row * 100_000 + column) * HEADINGS + heading % HEADINGS
