"""Reeds-Shepp paths: the shortest paths of a car between poses in free space, with reversing.

Reeds and Shepp, Optimal paths for a car that goes both forwards and backwards, Pacific Journal of
Mathematics 145 (1990). A word is up to five arcs and straight lines. Its lengths are in units of
the turning radius, and negative where the car reverses.
"""

import math

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import kernel, lean_kernel

TINY = 1e-9
QUARTER = 0.5 * math.pi
SEGMENTS = 5
# for each family of words, the turns of its segments (1: left), and their lengths by t, u and v
TURNS = np.array([
    (1, 0, 1, 0, 0), (1, 0, -1, 0, 0), (1, -1, 1, 0, 0), (1, -1, 1, 0, 0),
    (1, -1, 1, -1, 0), (1, -1, 1, -1, 0), (1, -1, 0, 1, 0), (1, -1, 0, -1, 0),
    (1, 0, -1, 1, 0), (-1, 0, -1, 1, 0), (1, -1, 0, 1, -1),
], np.int8)  # fmt: skip
T, U, V, MINUS_U, MINUS_QUARTER = 1, 2, 3, 4, 5
PARTS = np.array([
    (T, U, V, 0, 0), (T, U, V, 0, 0), (T, U, V, 0, 0), (V, U, T, 0, 0),
    (T, U, MINUS_U, V, 0), (T, U, U, V, 0),
    (T, MINUS_QUARTER, U, V, 0), (T, MINUS_QUARTER, U, V, 0),
    (V, U, MINUS_QUARTER, T, 0), (V, U, MINUS_QUARTER, T, 0),
    (T, MINUS_QUARTER, U, MINUS_QUARTER, V),
], np.int8)  # fmt: skip
BACK = np.array((0, 0, 0, 1, 0, 0, 0, 0, 1, 1, 0), np.bool_)  # driven from the goal to the start
Solution = tuple[bool, float, float, float]
NO_WORD = (False, 0.0, 0.0, 0.0)


@kernel
def best_word(
    x: float, y: float, yaw: float, prices: tuple[float, float], lengths: Floats, turns: Floats
) -> float:
    """Fill in the cheapest word to a pose, seen from the start, and return its cost.

    `x` and `y` are in units of the turning radius. The `prices` are those of a unit in reverse,
    relative to one forwards, and of a change of direction. `lengths` and `turns` are (SEGMENTS,).
    """
    best, cosine, sine = math.inf, math.cos(yaw), math.sin(yaw)
    word = np.empty(SEGMENTS)
    for family in range(len(PARTS)):
        to_x = x * cosine + y * sine if BACK[family] else x
        to_y = x * sine - y * cosine if BACK[family] else y
        for symmetry in range(4):
            time, mirror = 1 - 2 * (symmetry % 2), 1 - 2 * (symmetry // 2)
            found, t, u, v = _solve(family, time * to_x, mirror * to_y, time * mirror * yaw)
            if not found:
                continue
            cost, before = 0.0, 0.0
            for n in range(SEGMENTS):
                part = PARTS[family, n]
                length = 0.0
                if part == T:
                    length = t
                elif part == U:
                    length = u
                elif part == V:
                    length = v
                elif part == MINUS_U:
                    length = -u
                elif part == MINUS_QUARTER:
                    length = -QUARTER
                length *= time
                word[n] = length
                if abs(length) > TINY:
                    cost += length if length > 0.0 else -length * prices[0]
                    cost += prices[1] if before * length < 0.0 else 0.0
                    before = length
            if cost < best:
                best = cost
                for n in range(SEGMENTS):
                    lengths[n], turns[n] = word[n], TURNS[family, n] * mirror
    return best


@lean_kernel
def _solve(family: int, x: float, y: float, yaw: float) -> Solution:
    """Return whether a family has a word to a pose, and its t, u and v."""
    sine, cosine = math.sin(yaw), math.cos(yaw)
    same_x, same_y = x - sine, y - 1.0 + cosine  # for words that end with a left turn,
    other_x, other_y = x + sine, y - 1.0 - cosine  # or a right turn
    if family == 0:
        return _left_straight_left(same_x, same_y, yaw)
    if family == 1:
        return _left_straight_right(other_x, other_y, yaw)
    if family == 2 or family == 3:
        return _left_right_left(same_x, same_y, yaw)
    if family == 4:
        return _four_turns_u(other_x, other_y, yaw)
    if family == 5:
        return _four_turns(other_x, other_y, yaw)
    if family == 6 or family == 8:
        return _quarter_straight_left(same_x, same_y, yaw)
    if family == 7 or family == 9:
        return _quarter_straight_right(other_x, other_y, yaw)
    return _two_quarters(other_x, other_y, yaw)


@lean_kernel
def _wrapped(angle: float) -> float:
    return angle - math.tau * math.floor(angle / math.tau + 0.5)


@lean_kernel
def _left_straight_left(x: float, y: float, yaw: float) -> Solution:
    t, u = math.atan2(y, x), math.sqrt(x * x + y * y)
    v = _wrapped(yaw - t)
    return t >= -TINY and v >= -TINY, t, u, v


@lean_kernel
def _left_straight_right(x: float, y: float, yaw: float) -> Solution:
    square = x * x + y * y
    if square < 4.0:
        return NO_WORD
    u = math.sqrt(square - 4.0)
    t = _wrapped(math.atan2(y, x) + math.atan2(2.0, u))
    v = _wrapped(t - yaw)
    return t >= -TINY and v >= -TINY, t, u, v


@lean_kernel
def _left_right_left(x: float, y: float, yaw: float) -> Solution:
    rho = math.sqrt(x * x + y * y)
    if rho > 4.0:
        return NO_WORD
    u = -2.0 * math.asin(0.25 * rho)
    t = _wrapped(math.atan2(y, x) + 0.5 * u + math.pi)
    v = _wrapped(yaw - t + u)
    return t >= -TINY and u <= TINY, t, u, v


@lean_kernel
def _outer_turns(u: float, v: float, x: float, y: float, yaw: float) -> tuple[float, float]:
    """Return the first and the last turn of a word, from the two middle turns `u` and `v`."""
    delta = _wrapped(u - v)
    a, b = math.sin(u) - math.sin(delta), math.cos(u) - math.cos(delta) - 1.0
    first = math.atan2(y * a - x * b, x * a + y * b)
    turned = 2.0 * (math.cos(delta) - math.cos(v) - math.cos(u)) + 3.0 < 0.0
    t = _wrapped(first + math.pi) if turned else _wrapped(first)
    return t, _wrapped(t - u + v - yaw)


@lean_kernel
def _four_turns_u(x: float, y: float, yaw: float) -> Solution:
    rho = 0.25 * (2.0 + math.sqrt(x * x + y * y))
    if rho > 1.0:
        return NO_WORD
    u = math.acos(rho)
    t, v = _outer_turns(u, -u, x, y, yaw)
    return t >= -TINY and v <= TINY, t, u, v


@lean_kernel
def _four_turns(x: float, y: float, yaw: float) -> Solution:
    rho = (20.0 - x * x - y * y) / 16.0
    if rho < 0.0 or rho > 1.0:
        return NO_WORD
    u = -math.acos(rho)
    if u < -QUARTER:
        return NO_WORD
    t, v = _outer_turns(u, u, x, y, yaw)
    return t >= -TINY and v >= -TINY, t, u, v


@lean_kernel
def _quarter_straight_left(x: float, y: float, yaw: float) -> Solution:
    rho = math.sqrt(x * x + y * y)
    if rho < 2.0:
        return NO_WORD
    r = math.sqrt(rho * rho - 4.0)
    u, t = 2.0 - r, _wrapped(math.atan2(y, x) + math.atan2(r, -2.0))
    v = _wrapped(yaw - QUARTER - t)
    return t >= -TINY and u <= TINY and v <= TINY, t, u, v


@lean_kernel
def _quarter_straight_right(x: float, y: float, yaw: float) -> Solution:
    rho = math.sqrt(x * x + y * y)
    if rho < 2.0:
        return NO_WORD
    t, u = math.atan2(x, -y), 2.0 - rho
    v = _wrapped(t + QUARTER - yaw)
    return t >= -TINY and u <= TINY and v <= TINY, t, u, v


@lean_kernel
def _two_quarters(x: float, y: float, yaw: float) -> Solution:
    rho = math.sqrt(x * x + y * y)
    if rho < 2.0:
        return NO_WORD
    u = 4.0 - math.sqrt(rho * rho - 4.0)
    if u > TINY:
        return NO_WORD
    t = _wrapped(math.atan2((4.0 - u) * x - 2.0 * y, -2.0 * x + (u - 4.0) * y))
    v = _wrapped(t - yaw)
    return t >= -TINY and v >= -TINY, t, u, v


@lean_kernel
def along(x: float, y: float, yaw: float, bend: float, length: float) -> tuple[float, float, float]:
    """Return the pose after `length` [m] along a curve of curvature `bend` [1/m]."""
    if abs(bend) < 1e-6:
        return x + length * math.cos(yaw), y + length * math.sin(yaw), yaw
    then = yaw + bend * length
    return (
        x + (math.sin(then) - math.sin(yaw)) / bend,
        y - (math.cos(then) - math.cos(yaw)) / bend,
        then,
    )
