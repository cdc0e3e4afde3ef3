"""Hybrid A*: paths of a car from pose to pose, with its turning radius and in reverse.

Dolgov, Thrun, Montemerlo and Diebel, Practical search techniques in path planning for autonomous
driving, 2008. Nodes are poses, one for each bin of position and heading. Their successors are the
ends of arcs of constant curvature, and the goal if a Reeds-Shepp path to it is free.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import kernel, lean_kernel
from gigabrain_zenoh.navigation.costmap import Costs
from gigabrain_zenoh.navigation.reeds_shepp import SEGMENTS, TINY, along, best_word

BIN_M, HEADINGS = 0.1, 72  # size of the bins of position, number of those of heading
STEP_M = 0.2  # length of an arc, so that it leaves its bin
SAMPLE_M = 0.05  # between poses that are checked, and in the result
BENDS = (-1.0, -0.5, 0.0, 0.5, 1.0)  # curvatures of arcs, relative to the largest
REVERSE_COST = 1.5  # of a metre in reverse, relative to one forwards
SWITCH_COST = 0.4  # [m], of a change between forwards and reverse
BEND_COST = 0.05  # [m], of a change from straight to the largest curvature
SHOT_EVERY_M = 1.0  # at n times this cost to the goal, each n-th node tries a Reeds-Shepp path
PATIENCE = 3000  # nodes that are expanded after the first path is found
MAX_NODES = 1 << 17
TABLE_SIZE = 1 << 19  # slots of the hash table from bins to nodes
SHOT = len(BENDS) * 2  # move of a node that is reached by a Reeds-Shepp path
ROOT = -1
GOAL_HEADINGS = 16  # tried for a goal of any heading
LEAVE_M = 0.5  # radius round start and goal in which less room than usual is allowed
Ints = NDArray[np.int64]
Singles = NDArray[np.float32]
Pose = tuple[float, float, float]  # x, y [m], yaw [rad]


class Car(NamedTuple):
    """The shape of a car as discs along its middle line, and its turning radius."""

    radius: float  # [m], turning radius
    first: float  # [m], x of the middle of the first disc
    spacing: float  # [m], between discs
    discs: int  # number of discs
    room: float  # [m], radius of the discs
    middle: float  # [m], x of the body's middle


class Terrain(NamedTuple):
    """A map for a car: clearance, cost and distance to the goal of each cell."""

    distance: Singles  # (h, w) [m], to the nearest obstacle
    cost: Costs  # (h, w), per metre
    to_go: Floats  # (h, w) [m at cost 1], cost to the goal; inf where no path leads to it
    resolution: float  # [m]
    origin_x: float  # [m]
    origin_y: float


class Nodes(NamedTuple):
    """Buffers of a search."""

    pose: Floats  # (n, 3): x, y [m], yaw [rad]
    g: Floats  # (n,), cost from the start [m]
    link: Ints  # (n, 3): parent, move, and whether it is closed
    table: Ints  # (TABLE_SIZE, 2): bin, node
    heap: Floats  # (2 n, 2): f, node


def nodes() -> Nodes:
    """Return the buffers of a search."""
    return Nodes(
        np.empty((MAX_NODES, 3)),
        np.empty(MAX_NODES),
        np.empty((MAX_NODES, 3), np.int64),
        np.empty((TABLE_SIZE, 2), np.int64),
        np.empty((4 * MAX_NODES, 2)),
    )


@lean_kernel
def _cell(terrain: Terrain, x: float, y: float) -> tuple[int, int, bool]:
    """Return row and column at (x, y), and whether they are in the map."""
    row = math.floor((y - terrain.origin_y) / terrain.resolution)
    column = math.floor((x - terrain.origin_x) / terrain.resolution)
    rows, columns = terrain.distance.shape
    inside = row >= 0 and row < rows and column >= 0 and column < columns
    return row, column, inside


@lean_kernel
def room_at(terrain: Terrain, car: Car, x: float, y: float, yaw: float) -> float:
    """Return the least distance of the middles of the car's discs to an obstacle [m].

    It is -1 if one of them is outside the map.
    """
    cosine, sine, least = math.cos(yaw), math.sin(yaw), math.inf
    for n in range(car.discs):
        ahead = car.first + n * car.spacing
        row, column, inside = _cell(terrain, x + ahead * cosine, y + ahead * sine)
        if not inside:
            return -1.0
        least = min(least, float(terrain.distance[row, column]))
    return least


@lean_kernel
def _cost_at(terrain: Terrain, car: Car, x: float, y: float, yaw: float) -> float:
    row, column, inside = _cell(
        terrain, x + car.middle * math.cos(yaw), y + car.middle * math.sin(yaw)
    )
    return float(terrain.cost[row, column]) if inside else math.inf


@lean_kernel
def drive(
    terrain: Terrain, car: Car, start: Pose, bend: float, length: float, needs: Floats
) -> tuple[float, float, float, float]:
    """Return the pose after an arc, and its cost; inf where the car does not fit.

    `needs` (3, 3) are x, y and the required room [m] of start and goal; last, the room elsewhere.
    """
    count = max(1, math.ceil(abs(length) / SAMPLE_M))
    step, cost = length / count, 0.0
    x, y, yaw = start
    for _ in range(count):
        x, y, yaw = along(x, y, yaw, bend, step)
        needed = needs[2, 2]
        for end in range(2):
            if math.hypot(x - needs[end, 0], y - needs[end, 1]) < LEAVE_M:
                needed = min(needed, needs[end, 2])
        if room_at(terrain, car, x, y, yaw) < needed:
            return x, y, yaw, math.inf
        cost += abs(step) * _cost_at(terrain, car, x, y, yaw)
    return x, y, yaw, cost if length > 0.0 else REVERSE_COST * cost


@lean_kernel
def _bin(terrain: Terrain, x: float, y: float, yaw: float) -> int:
    column = int((x - terrain.origin_x) / BIN_M)
    row = int((y - terrain.origin_y) / BIN_M)
    turn = yaw / math.tau
    heading = int((turn - math.floor(turn)) * HEADINGS) % HEADINGS
    return (row * 100_000 + column) * HEADINGS + heading


@lean_kernel
def _slot(table: Ints, key: int) -> int:
    """Return the slot of a bin, or the free slot for it."""
    slot = (key * 2654435761) % TABLE_SIZE
    while table[slot, 0] != key and table[slot, 0] != -1:
        slot = (slot + 1) % TABLE_SIZE
    return slot


@lean_kernel
def _push(heap: Floats, size: int, f: float, node: int) -> None:
    at = size
    while at > 0:
        up = (at - 1) // 2
        if heap[up, 0] <= f:
            break
        heap[at, 0], heap[at, 1] = heap[up, 0], heap[up, 1]
        at = up
    heap[at, 0], heap[at, 1] = f, node


@lean_kernel
def _pop(heap: Floats, size: int) -> int:
    """Remove the cheapest of `size` entries, and return its node."""
    top, last = int(heap[0, 1]), size - 1
    f, node, at = heap[last, 0], heap[last, 1], 0
    while True:
        down = 2 * at + 1
        if down >= last:
            break
        if down + 1 < last and heap[down + 1, 0] < heap[down, 0]:
            down += 1
        if heap[down, 0] >= f:
            break
        heap[at, 0], heap[at, 1] = heap[down, 0], heap[down, 1]
        at = down
    heap[at, 0], heap[at, 1] = f, node
    return top


@kernel
def _try_shot(
    terrain: Terrain, car: Car, pose: Pose, goal: Pose, needs: Floats, lengths: Floats,
    turns: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Fill in the Reeds-Shepp word to the goal; return its cost, and the heading at its end.

    The cost is inf if the word is not free. For a goal of any heading, it is the cheapest word.
    """
    x, y, yaw = pose
    cosine, sine, any_yaw = math.cos(yaw), math.sin(yaw), math.isnan(goal[2])
    dx, dy = (goal[0] - x) / car.radius, (goal[1] - y) / car.radius
    there_x, there_y = cosine * dx + sine * dy, cosine * dy - sine * dx
    prices = (REVERSE_COST, SWITCH_COST / car.radius)
    least, best, tried = math.inf, goal[2], GOAL_HEADINGS if any_yaw else 1
    for n in range(tried):
        to_yaw = yaw + n * math.tau / GOAL_HEADINGS if any_yaw else goal[2]
        cost = best_word(there_x, there_y, to_yaw - yaw, prices, lengths, turns)
        if cost < least:
            least, best = cost, to_yaw
    if any_yaw:
        best_word(there_x, there_y, best - yaw, prices, lengths, turns)
    total, before = 0.0, 0.0
    for n in range(SEGMENTS):
        if abs(lengths[n]) < TINY:
            continue
        length, bend = lengths[n] * car.radius, turns[n] / car.radius
        x, y, yaw, cost = drive(terrain, car, (x, y, yaw), bend, length, needs)
        total += cost + (SWITCH_COST if before * length < 0.0 else 0.0)
        before = length
        if total == math.inf:
            break
    return total, best


@lean_kernel
def _estimate(terrain: Terrain, car: Car, pose: Pose, goal: Pose) -> float:
    """Estimate the cost to the goal: the largest of those by cells, straight line and turn."""
    row, column, inside = _cell(terrain, pose[0], pose[1])
    straight = math.hypot(goal[0] - pose[0], goal[1] - pose[1])
    if not inside or terrain.to_go[row, column] == math.inf:
        return straight
    turn = 0.0
    if not math.isnan(goal[2]):
        off = (goal[2] - pose[2]) / math.tau
        turn = car.radius * math.tau * abs(off - math.floor(off + 0.5))
    return max(float(terrain.to_go[row, column]), straight, turn)


@kernel
def _set_node(memory: Nodes, node: int, at: Pose, cost: float, parent: int, move: int) -> None:
    """Set an open node: its pose, its cost from the start, its parent and the move from that."""
    pose, g, link = memory[0], memory[1], memory[2]
    pose[node, 0], pose[node, 1], pose[node, 2] = at
    g[node], link[node, 0], link[node, 1], link[node, 2] = cost, parent, move, 0


@kernel
def _open_start(terrain: Terrain, start: Pose, estimate: float, memory: Nodes) -> None:
    """Remove all nodes, and open one at the start."""
    table, heap = memory[3], memory[4]
    table[:, 0] = -1
    _set_node(memory, 0, start, 0.0, ROOT, ROOT)
    key = _bin(terrain, start[0], start[1], start[2])
    slot = _slot(table, key)
    table[slot, 0], table[slot, 1] = key, 0
    _push(heap, 0, estimate, 0)


@kernel
def _add_change_cost(cost: float, move: int, to: int) -> float:
    """Return a step's cost plus that of changing direction and curvature, from `move` to `to`."""
    if (move >= len(BENDS)) != (to >= len(BENDS)):
        cost += SWITCH_COST
    return cost + BEND_COST * abs(BENDS[to % len(BENDS)] - BENDS[move % len(BENDS)])


@kernel
def _begins_in_reverse(lengths: Floats) -> bool:
    """Return whether the first segment that is not empty is driven in reverse."""
    for length in lengths:
        if abs(length) > TINY:
            return bool(length < 0.0)
    return False


@kernel
def search(
    terrain: Terrain, car: Car, start: Pose, goal: Pose, needs: Floats, memory: Nodes
) -> int:
    """Return the node at the goal, linked back to the start; ROOT if no path is found."""
    pose, g, link, table, heap = memory
    lengths, turns = np.empty(SEGMENTS), np.empty(SEGMENTS)
    _open_start(terrain, start, _estimate(terrain, car, start, goal), memory)
    count, size, found, patience = 1, 1, ROOT, PATIENCE
    while size > 0 and count < MAX_NODES - 2 * len(BENDS) - 1 and size < len(heap) - 32:
        node = _pop(heap, size)
        size -= 1
        if link[node, 1] == SHOT:
            return node
        if link[node, 2]:
            continue
        link[node, 2], patience = 1, patience - (found != ROOT)
        if patience == 0:
            return found
        here = (pose[node, 0], pose[node, 1], pose[node, 2])
        move = link[node, 1]
        if node % max(1, int(_estimate(terrain, car, here, goal) / SHOT_EVERY_M)) == 0:
            shot, to_yaw = _try_shot(terrain, car, here, goal, needs, lengths, turns)
            total = g[node] + shot
            if move >= 0 and _begins_in_reverse(lengths) != (move >= len(BENDS)):
                total += SWITCH_COST
            if total < math.inf and (found == ROOT or total < g[found]):
                _set_node(memory, count, (goal[0], goal[1], to_yaw), total, node, SHOT)
                _push(heap, size, total, count)
                found, count, size = count, count + 1, size + 1
        for next_move in range(2 * len(BENDS)):
            share, length = (
                BENDS[next_move % len(BENDS)],
                STEP_M if next_move < len(BENDS) else -STEP_M,
            )
            x, y, yaw, cost = drive(terrain, car, here, share / car.radius, length, needs)
            if cost == math.inf:
                continue
            if move >= 0:
                cost = _add_change_cost(cost, move, next_move)
            key = _bin(terrain, x, y, yaw)
            slot = _slot(table, key)
            other, total, seen = table[slot, 1], g[node] + cost, table[slot, 0] == key
            if seen and (link[other, 2] or g[other] <= total):
                continue
            _set_node(memory, count, (x, y, yaw), total, node, next_move)
            if seen:
                link[other, 2] = 1  # this one is cheaper
            table[slot, 0], table[slot, 1] = key, count
            _push(heap, size, total + _estimate(terrain, car, (x, y, yaw), goal), count)
            count, size = count + 1, size + 1
    return found
