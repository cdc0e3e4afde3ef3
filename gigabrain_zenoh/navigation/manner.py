"""What a plan amounts to, in words."""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.navigation.models import Model
from gigabrain_zenoh.navigation.moment import Goal, Kind

Floats = NDArray[np.float64]

SOON_S = 1.0  # what the body does within this time is what it is said to do
STILL = 0.08  # share of the largest speed that counts as standing
NEAR_M = 1.5  # [m], what moves within this is named
THERE_M = 0.2  # [m], so little is left where only standing and turning are
ASIDE_M = 0.15  # [m], so far off the straight way is round something


def kind_of(model: Model, track: Floats, dt: float, goal: Goal) -> Kind:
    """What `track` (T + 1, 6) amounts to within the next second."""
    soon = min(len(track) - 1, max(1, round(SOON_S / dt)))
    begin, end = track[0].tolist(), track[soon].tolist()  # plain numbers are quicker
    made = math.hypot(end[0] - begin[0], end[1] - begin[1])
    turned = abs(end[2] - begin[2])
    if made < STILL * model.forward * soon * dt:
        return "waiting" if turned < STILL * model.turning * soon * dt else "turning in place"
    back = (end[0] - begin[0]) * math.cos(begin[2]) + (end[1] - begin[1]) * math.sin(begin[2])
    if model.lateral == 0.0 and back < 0.0:
        return "backing out"
    return "going round" if _aside(track, goal) > ASIDE_M else "going"


def reason_of(kind: Kind, track: Floats, discs: Floats, room: float, left: float) -> str:
    """Why, with what is in the way: `room` [m] round the body, `left` [m] to go."""
    moving = _nearest_moving(track, discs)
    if left < THERE_M and not moving and kind in ("waiting", "turning in place"):
        return f"{kind}: at the goal"
    if kind == "waiting":
        return f"waiting: {moving}" if moving else f"waiting: no way on, {room:.2f} m of room"
    if kind == "going round":
        return f"going round: {moving or f'something {room:.2f} m away'}"
    if kind == "backing out":
        return f"backing out: {moving or f'no way on ahead, {room:.2f} m of room'}"
    if kind == "turning in place":
        return "turning in place: the way on is to the side"
    return f"going: {left:.1f} m to go"


def _nearest_moving(track: Floats, discs: Floats) -> str:
    """What moves near the way, if anything does."""
    if not len(discs):
        return ""
    away = np.hypot(discs[:, 0] - track[0, 0], discs[:, 1] - track[0, 1]) - discs[:, 4]
    nearest = int(np.argmin(away))
    if away[nearest] > NEAR_M:
        return ""
    dx, dy = discs[nearest, :2] - track[0, :2]
    side = math.remainder(math.atan2(dy, dx) - track[0, 2], math.tau)
    where = _side(side)
    speed = float(np.hypot(*discs[nearest, 2:4]))
    return f"somebody at {speed:.1f} m/s {max(0.0, float(away[nearest])):.1f} m {where}"


def _side(bearing: float) -> str:
    if abs(bearing) < math.radians(45):
        return "ahead"
    if abs(bearing) > math.radians(135):
        return "behind"
    return "to the left" if bearing > 0 else "to the right"


def _aside(track: Floats, goal: Goal) -> float:
    """How far the track leaves the straight way to the goal [m]."""
    then: list[tuple[float, float]] = track[:, :2].tolist()
    x, y = then[0]
    dx, dy = goal.x - x, goal.y - y
    length = math.hypot(dx, dy)
    if length < ASIDE_M:
        return 0.0
    return max(abs((to_y - y) * dx - (to_x - x) * dy) for to_x, to_y in then) / length
