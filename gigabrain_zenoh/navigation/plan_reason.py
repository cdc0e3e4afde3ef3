"""The kind of a plan's motion, and its reason as text."""

import math
from typing import Literal

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.navigation.motion_model import MotionModel

PlanKind = Literal["going", "going round", "waiting", "backing out", "turning in place", "arrived"]

REPORTED_S = 1.0  # motion within this time is reported
STILL_SHARE = 0.08  # of the maximum speed, below which the body stands still
MAX_NAMED_M = 1.5  # distance of a moving obstacle that the reason names
AT_GOAL_M = 0.2  # cost to go, below which a body that stands or turns is at the goal
DETOUR_M = 0.15  # distance from the straight line, beyond which the body goes round something


def classify_plan(model: MotionModel, track: Floats, dt: float, goal: Goal) -> PlanKind:
    """Return the kind of motion of `track` (T + 1, 6) within the next second."""
    soon = min(len(track) - 1, max(1, round(REPORTED_S / dt)))
    begin, end = track[0].tolist(), track[soon].tolist()  # lists are faster
    distance = math.hypot(end[0] - begin[0], end[1] - begin[1])
    turned = abs(end[2] - begin[2])
    if distance < STILL_SHARE * model.forward * soon * dt:
        return "waiting" if turned < STILL_SHARE * model.turning * soon * dt else "turning in place"
    back = (end[0] - begin[0]) * math.cos(begin[2]) + (end[1] - begin[1]) * math.sin(begin[2])
    if model.lateral == 0.0 and back < 0.0:
        return "backing out"
    return "going round" if _detour(track, goal) > DETOUR_M else "going"


def explain_plan(
    kind: PlanKind, track: Floats, discs: Floats, room: float, left: float, *, follows: bool = False
) -> str:
    """Return the reason of a plan as text, `room` [m] from obstacles and `left` [m] to go.

    A car that `follows` a path may have to reverse on it.
    """
    moving = _nearest_moving(track, discs)
    if left < AT_GOAL_M and not moving and kind in ("waiting", "turning in place"):
        return f"{kind}: at the goal"
    if kind == "waiting":
        return f"waiting: {moving}" if moving else f"waiting: blocked ahead, {room:.2f} m of room"
    if kind == "going round":
        return f"going round: {moving or f'an obstacle {room:.2f} m away'}"
    if kind == "backing out" and follows and not moving:
        return f"backing: the path leads back, {left:.1f} m to go"
    if kind == "backing out":
        return f"backing out: {moving or f'blocked ahead, {room:.2f} m of room'}"
    if kind == "turning in place":
        return "turning in place: the path leads to the side"
    return f"going: {left:.1f} m to go"


def _nearest_moving(track: Floats, discs: Floats) -> str:
    """Describe the nearest moving disc; an empty text if none is near."""
    if not len(discs):
        return ""
    away = np.hypot(discs[:, 0] - track[0, 0], discs[:, 1] - track[0, 1]) - discs[:, 4]
    nearest = int(np.argmin(away))
    if away[nearest] > MAX_NAMED_M:
        return ""
    dx, dy = discs[nearest, :2] - track[0, :2]
    side = math.remainder(math.atan2(dy, dx) - track[0, 2], math.tau)
    where = _side(side)
    speed = float(np.hypot(*discs[nearest, 2:4]))
    return f"a moving obstacle at {speed:.1f} m/s {max(0.0, float(away[nearest])):.1f} m {where}"


def _side(bearing: float) -> str:
    if abs(bearing) < math.radians(45):
        return "ahead"
    if abs(bearing) > math.radians(135):
        return "behind"
    return "to the left" if bearing > 0 else "to the right"


def _detour(track: Floats, goal: Goal) -> float:
    """Return the largest distance of the track from the straight line to the goal [m]."""
    points: list[tuple[float, float]] = track[:, :2].tolist()
    x, y = points[0]
    dx, dy = goal.x - x, goal.y - y
    length = math.hypot(dx, dy)
    if length < DETOUR_M:
        return 0.0
    return max(abs((to_y - y) * dx - (to_x - x) * dy) for to_x, to_y in points) / length
