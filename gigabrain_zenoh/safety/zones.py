"""The protective field: what each new scan leaves free in every direction, and what that allows."""

import math

import msgspec
import numpy as np

from gigabrain_schemas.arrays import ranges
from gigabrain_schemas.base import TICK_NS, Cause, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.geometry.scan import Floats, blind_ahead, hits, scan_problem
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.geometry.sweep import arc, straight, turning
from gigabrain_zenoh.safety import looks, unknown
from gigabrain_zenoh.safety.words import say

NEAREST = 0.1  # [m], nearer hits are the lidar's own housing
CONE_DEG = 30.0  # [deg], the cone ahead of which something must be known
TURN_MARGIN = 0.02  # [m], kept free round a body that turns
CURVING_LINEAR, CURVING_ANGULAR = 0.03, 0.05  # [m/s], [rad/s]; less than either is no arc
WHERE = {
    "forward": "ahead",
    "backward": "behind",
    "left": "left",
    "right": "right",
    "turn_left": "turn_left",
    "turn_right": "turn_right",
}

Free = dict[str, float | None]  # [m], [rad] by direction; None where nothing is in the way


class Field(msgspec.Struct, frozen=True, kw_only=True):
    """What the newest scan says of the room, and where the body has stopped for it."""

    scans: int = 0  # how many have been looked at
    basis: int = 0  # the newest of them
    problem: str = ""  # why that one cannot be believed
    free: Free = {}
    stopped: frozenset[str] = frozenset()
    sectors: unknown.Ranges = ()
    past: looks.Looks = ()


class Motion(msgspec.Struct, frozen=True, kw_only=True):
    """How the body moves: as measured, as told, and as its commander wants it to."""

    measured: Velocity
    told: Velocity
    wanted: Velocity

    def towards(self, direction: str) -> float:
        """The larger of the measured and the told speed in a direction; 0 when it moves away."""
        return max(0.0, _speed(self.measured, direction), _speed(self.told, direction))


def look(
    body: BodyDescription,
    field: Field,
    scan: LaserScan | None,
    state: RobotState,
    history: PoseHistory,
    motion: Motion,
) -> Field:
    """Read a new scan, once the state of its tick is here as well.

    Zones go by the speed of that tick. Until the next scan the speed caps keep the body from
    gaining more speed than the zone allows.
    """
    lidar = body.lidar
    if lidar is None or scan is None or scan.basis == field.basis or scan.basis > state.tick:
        return field
    problem = scan_problem(lidar, ranges(scan), NEAREST)
    problem = problem or blind_ahead(lidar, scan, NEAREST, CONE_DEG)
    now = msgspec.structs.replace(field, scans=field.scans + 1, basis=scan.basis, problem=problem)
    if problem:
        return msgspec.structs.replace(now, free={}, stopped=frozenset())
    elapsed_s = max(0, scan.basis - field.basis) * TICK_NS / 1e9 if field.basis else 0.0
    gone = elapsed_s * math.hypot(motion.measured.linear_x, motion.measured.linear_y)
    pose = history.at(state.boot, scan.basis) or state.pose
    sectors, blank = unknown.remember(lidar, scan, NEAREST, pose.yaw, field.sectors, gone)
    # who does not drive may be carried, and the odometry would not know
    past = looks.then(field.past, body, pose, scan) if state.gate.mode == "enabled" else ()
    seen = np.stack(hits(lidar, scan, NEAREST), axis=1)
    dark = unknown.obstacles(body, pose.yaw, sectors, blank, NEAREST, past)
    points = np.concatenate([seen, dark])
    free = _free(body, points, motion)
    stopped = frozenset(
        direction
        for direction, brake in brakes(body).items()
        if brake.in_zone(free[direction], motion.towards(direction), direction in field.stopped)
    )
    return msgspec.structs.replace(now, free=free, stopped=stopped, sectors=sectors, past=past)


def caps(body: BodyDescription, field: Field) -> SpeedCaps:
    """How fast the body may go each way."""
    allowed = {
        direction: brake.cap(field.free.get(direction), direction in field.stopped)
        for direction, brake in brakes(body).items()
    }
    return SpeedCaps(**allowed)


def causes(field: Field) -> tuple[Cause, ...]:
    """They hold back only what goes towards the obstacle; the gate does not stop for them."""
    found = []
    for direction, where in WHERE.items():
        if direction not in field.stopped:
            continue
        code, free = f"zone_{where}", field.free[direction] or 0.0
        if direction.startswith("turn"):
            found.append(say(code))
        else:
            text = say(code).text.removeprefix("obstacle ")
            found.append(say(code, f"obstacle {free:.2f} m {text}"))
    return tuple(found)


def _free(body: BodyDescription, points: Floats, motion: Motion) -> Free:
    shape, side = body.footprint, body.thresholds.side_margin
    brake = brakes(body)
    forward, backward, left, right = straight(shape, points, side)
    turn_left, turn_right = turning(shape, points, TURN_MARGIN, brake["turn_left"].reach)
    free: Free = {
        "forward": forward,
        "backward": backward,
        "left": left,
        "right": right,
        "turn_left": turn_left,
        "turn_right": turn_right,
    }
    for twist in {_axes(motion.measured), _axes(motion.wanted)}:
        way = _arc(body, points, twist)
        direction = "forward" if twist[0] > 0 else "backward"
        known = free[direction]
        if way is not None:
            free[direction] = way if known is None else min(way, known)
    return free


def _arc(body: BodyDescription, points: Floats, twist: tuple[float, float, float]) -> float | None:
    """The free way along a curve [m]; None where it is none, or nothing is in the way."""
    if abs(twist[0]) < CURVING_LINEAR or abs(twist[2]) < CURVING_ANGULAR:
        return None
    limits, reach = body.thresholds, brakes(body)["forward"].reach
    return arc(body.footprint, points, limits.side_margin, reach, twist)


def _axes(of: Velocity) -> tuple[float, float, float]:
    return of.linear_x, of.linear_y, of.angular_z


def _speed(of: Velocity, direction: str) -> float:
    match direction:
        case "forward":
            return of.linear_x
        case "backward":
            return -of.linear_x
        case "left":
            return of.linear_y
        case "right":
            return -of.linear_y
        case "turn_left":
            return of.angular_z
        case _:
            return -of.angular_z
