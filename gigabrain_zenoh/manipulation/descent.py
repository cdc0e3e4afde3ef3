"""The inner loop of inverse kinematics: a chain of joints, and the descent to a goal, compiled.

A chain has: `fixed` (n, 3, 4), the rotation and position [m] of each joint in the frame of the
joint before; `axes` (n, 3) of the joints in their own frames; `slides` (n,), true for joints that
slide; and `tool` (3, 4), the pose of the tool in the frame of the last joint.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import kernel

Flags = NDArray[np.bool_]
PLACE, APPROACH, AXES = 0, 1, 2  # part of a goal that must be met
MAX_STEP = 0.6  # [rad] or [m], of a joint
MIN_STEP = 1e-6  # smaller steps end the descent
NO_STEP = 1e-5  # a step smaller than this is not shortened further
SLOW_STEP, SLOW_GAIN = 1e-3, 1e-4  # steps below both end the descent; gain: share of the cost
FINE_M, FINE_RAD = 1e-6, 1e-5  # errors below which the descent ends
DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-4, 1e-9, 1e3
EASE, STIFFEN = 0.2, 6.0  # factors of the damping after a successful and after a failed step


class Chain(NamedTuple):
    """The joints from the base to the tool; see the module's docstring."""

    fixed: Floats
    axes: Floats
    slides: Flags
    tool: Floats


@kernel
def _turn(frame: Floats, by: Floats) -> None:
    """Multiply the rotation of `frame` (3, 4) by that of `by` (3, 3 or 4), in place."""
    for row in range(3):
        a, b, c = frame[row, 0], frame[row, 1], frame[row, 2]
        for column in range(3):
            frame[row, column] = a * by[0, column] + b * by[1, column] + c * by[2, column]


@kernel
def _shift(frame: Floats, x: float, y: float, z: float) -> None:
    """Move `frame` (3, 4) along its own axes, in place."""
    for row in range(3):
        frame[row, 3] += frame[row, 0] * x + frame[row, 1] * y + frame[row, 2] * z


@kernel
def _rotation(axis: Floats, angle: float, into: Floats) -> None:
    """Fill in the rotation (3, 3) by `angle` about `axis` (Rodrigues)."""
    x, y, z = axis[0], axis[1], axis[2]
    c, s = math.cos(angle), math.sin(angle)
    d = 1.0 - c
    into[0, 0], into[0, 1], into[0, 2] = c + x * x * d, x * y * d - z * s, x * z * d + y * s
    into[1, 0], into[1, 1], into[1, 2] = y * x * d + z * s, c + y * y * d, y * z * d - x * s
    into[2, 0], into[2, 1], into[2, 2] = z * x * d - y * s, z * y * d + x * s, c + z * z * d


@kernel
def tool_pose(chain: Chain, posture: Floats, frame: Floats, joints: Floats) -> None:
    """Fill in the pose of the tool (3, 4), and each joint's position and axis (n, 2, 3)."""
    turn = np.empty((3, 3))
    frame[:] = 0.0
    for row in range(3):
        frame[row, row] = 1.0
    for k in range(len(posture)):
        before, axis = chain.fixed[k], chain.axes[k]
        _shift(frame, before[0, 3], before[1, 3], before[2, 3])
        _turn(frame, before)
        for row in range(3):
            joints[k, 0, row] = frame[row, 3]
            joints[k, 1, row] = (
                frame[row, 0] * axis[0] + frame[row, 1] * axis[1] + frame[row, 2] * axis[2]
            )
        if chain.slides[k]:
            _shift(frame, axis[0] * posture[k], axis[1] * posture[k], axis[2] * posture[k])
        else:
            _rotation(axis, posture[k], turn)
            _turn(frame, turn)
    _shift(frame, chain.tool[0, 3], chain.tool[1, 3], chain.tool[2, 3])
    _turn(frame, chain.tool)


@kernel
def _direction_error(frame: Floats, goal: Floats, error: Floats) -> None:
    """Fill in the smallest rotation [rad] from the x axis of `frame` to that of `goal`."""
    x, y, z = frame[0, 0], frame[1, 0], frame[2, 0]
    a, b, c = goal[0, 0], goal[1, 0], goal[2, 0]
    error[3], error[4], error[5] = y * c - z * b, z * a - x * c, x * b - y * a
    sine = math.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2)
    cosine = x * a + y * b + z * c
    if sine < 1e-9 and cosine < 0.0:  # opposite: any perpendicular axis will do
        error[3:6] = math.pi * frame[:, 2]
    elif sine >= 1e-9:
        error[3:6] *= math.atan2(sine, cosine) / sine


@kernel
def _axes_error(frame: Floats, goal: Floats, error: Floats) -> None:
    """Fill in the rotation [rad] from all axes of `frame` to those of `goal`."""
    error[3:6] = 0.0
    cosine = -1.0  # of the angle, times two, as is `sine`
    for k in range(3):
        x, y, z = frame[0, k], frame[1, k], frame[2, k]
        a, b, c = goal[0, k], goal[1, k], goal[2, k]
        error[3] += y * c - z * b
        error[4] += z * a - x * c
        error[5] += x * b - y * a
        cosine += x * a + y * b + z * c
    sine = math.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2)
    if sine >= 1e-9:
        error[3:6] *= math.atan2(sine, cosine) / sine
    elif cosine < 0.0:  # half a turn, about the mean of an axis and its goal
        longest = 0.0
        for k in range(3):
            x, y, z = frame[0, k] + goal[0, k], frame[1, k] + goal[1, k], frame[2, k] + goal[2, k]
            length = math.sqrt(x * x + y * y + z * z)
            if length > longest:
                longest = length
                error[3], error[4], error[5] = x, y, z
        error[3:6] *= math.pi / longest


@kernel
def _goal_error(frame: Floats, goal: Floats, part: int, error: Floats) -> None:
    """Fill in the error of `frame` from its `goal` (3, 4): (6,) [m], [rad]."""
    error[:] = 0.0
    for row in range(3):
        error[row] = goal[row, 3] - frame[row, 3]
    if part == APPROACH:
        _direction_error(frame, goal, error)
    elif part == AXES:
        _axes_error(frame, goal, error)


@kernel
def _solve(
    square: Floats, right: Floats, damping: float, held: Flags, lower: Floats, step: Floats
) -> None:
    """Solve (square + damping) step = right for `step` (Cholesky); joints that are held stay.

    `lower` (n, n) is scratch space.
    """
    count = len(right)
    for i in range(count):
        for j in range(i + 1):
            total = 0.0 if held[i] or held[j] else square[i, j]
            if i == j:
                total = 1.0 if held[i] else total + damping
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(max(total, 1e-15)) if i == j else total / lower[j, j]
    for i in range(count):
        total = 0.0 if held[i] else right[i]
        for k in range(i):
            total -= lower[i, k] * step[k]
        step[i] = total / lower[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            step[i] -= lower[k, i] * step[k]
        step[i] /= lower[i, i]


@kernel
def _normal_equations(
    frame: Floats, joints: Floats, chain: Chain, error: Floats, weight: float,
    jacobian: Floats, square: Floats, slope: Floats,
) -> None:  # fmt: skip
    """Fill in J (6, n), J'J (n, n) and J'e (n,) of the weighted errors."""
    count = len(slope)
    for k in range(count):
        a, b, c = joints[k, 1, 0], joints[k, 1, 1], joints[k, 1, 2]
        if chain.slides[k]:
            jacobian[0, k], jacobian[1, k], jacobian[2, k] = a, b, c
            jacobian[3, k], jacobian[4, k], jacobian[5, k] = 0.0, 0.0, 0.0
            continue
        x, y = frame[0, 3] - joints[k, 0, 0], frame[1, 3] - joints[k, 0, 1]
        z = frame[2, 3] - joints[k, 0, 2]
        jacobian[0, k], jacobian[1, k], jacobian[2, k] = b * z - c * y, c * x - a * z, a * y - b * x
        jacobian[3, k], jacobian[4, k], jacobian[5, k] = weight * a, weight * b, weight * c
    for i in range(count):
        slope[i] = 0.0
        for row in range(6):
            slope[i] += jacobian[row, i] * error[row] * (1.0 if row < 3 else weight)
        for j in range(i + 1):
            total = 0.0
            for row in range(6):
                total += jacobian[row, i] * jacobian[row, j]
            square[i, j] = square[j, i] = total


@kernel
def _cost(error: Floats, weight: float) -> float:
    place = error[0] ** 2 + error[1] ** 2 + error[2] ** 2
    turn = error[3] ** 2 + error[4] ** 2 + error[5] ** 2
    return float(place + weight**2 * turn)


@kernel
def _is_fine(error: Floats) -> bool:
    place, turn = math.sqrt(_cost(error, 0.0)), np.abs(error[3:]).max()
    return place < FINE_M and turn < FINE_RAD


@kernel
def _descend(
    chain: Chain, limits: Floats, goal: Floats, part: int, weight: float, steps: int,
    posture: Floats, held: Flags, error: Floats,
) -> None:  # fmt: skip
    """Improve one posture (n,) by Levenberg-Marquardt steps."""
    count = len(posture)
    frame, joints = np.empty((3, 4)), np.empty((count, 2, 3))
    square, slope, step = np.empty((count, count)), np.empty(count), np.empty(count)
    lower, jacobian = np.empty((count, count)), np.empty((6, count))
    tried, new_error, damping = np.empty(count), np.empty(6), DAMPING
    tool_pose(chain, posture, frame, joints)
    _goal_error(frame, goal, part, error)
    cost = _cost(error, weight)
    _normal_equations(frame, joints, chain, error, weight, jacobian, square, slope)
    for _ in range(steps):
        for k in range(count):
            low, high = posture[k] <= limits[0, k], posture[k] >= limits[1, k]
            held[k] = (low and slope[k] < 0.0) or (high and slope[k] > 0.0)
        new_cost, moved = math.inf, 0.0
        while damping < MAX_DAMPING:
            _solve(square, slope, damping, held, lower, step)
            moved, longest = 0.0, 1e-12
            for k in range(count):
                longest = max(longest, abs(step[k]))
            scale = min(1.0, MAX_STEP / longest)
            for k in range(count):
                aim = posture[k] + scale * step[k]
                tried[k] = min(max(aim, limits[0, k]), limits[1, k])
                moved = max(moved, abs(tried[k] - posture[k]))
            tool_pose(chain, tried, frame, joints)
            _goal_error(frame, goal, part, new_error)
            new_cost = _cost(new_error, weight)
            if new_cost < cost or moved < NO_STEP:
                break
            damping *= STIFFEN
        if new_cost >= cost:
            return
        slow = moved < MIN_STEP or (cost - new_cost < SLOW_GAIN * cost and moved < SLOW_STEP)
        posture[:], error[:], cost = tried, new_error, new_cost
        damping = max(MIN_DAMPING, damping * EASE)
        _normal_equations(frame, joints, chain, error, weight, jacobian, square, slope)
        if slow or _is_fine(error):
            return


@kernel
def descend(
    chain: Chain, limits: Floats, goal: Floats, part: int, weight: float, steps: int,
    postures: Floats, held: Flags, errors: Floats,
) -> None:  # fmt: skip
    """Minimise the squared errors of each of `postures` (k, n), in at most so many `steps`.

    A radian counts as `weight` [m]; `limits` are (2, n). Fills in `held` (k, n), the joints that
    their limits keep from moving on, and the remaining `errors` (k, 2) [m], [rad].
    """
    error = np.empty(6)
    for k in range(len(postures)):
        _descend(chain, limits, goal, part, weight, steps, postures[k], held[k], error)
        errors[k, 0] = math.sqrt(_cost(error, 0.0))
        errors[k, 1] = math.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2)


def warm_up() -> None:
    """Compile the kernels, with an arm of one joint."""
    frame = np.eye(3, 4)
    chain = Chain(
        fixed=frame[None].copy(), axes=np.eye(3)[2:], slides=np.zeros(1, np.bool_), tool=frame
    )
    limits, held, errors = np.array([[-1.0], [1.0]]), np.zeros((1, 1), np.bool_), np.zeros((1, 2))
    descend(chain, limits, frame, PLACE, 1.0, 1, np.zeros((1, 1)), held, errors)
