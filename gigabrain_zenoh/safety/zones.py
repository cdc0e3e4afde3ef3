"""The protective field: free distance in each direction, and the speeds it allows.

It is computed for each scan, and for each picture of a depth camera.
"""

import math

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS, Cause, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, Lidar, RobotState
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.pose import PoseHistory, axes
from gigabrain_zenoh.geometry.scan import blind_ahead, hits, scan_problem
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.geometry.sweep import arc, straight, turning
from gigabrain_zenoh.safety import blind_spots
from gigabrain_zenoh.safety.cameras import NO_PICTURES, Cameras, Pictures, depth_cameras
from gigabrain_zenoh.safety.catalogue import cause
from gigabrain_zenoh.safety.tracking_error import Axes

HOUSING_M = 0.1  # nearer hits are the lidar's own housing
CONE_DEG = 30.0  # sector ahead that needs a valid beam
TURN_MARGIN_M = 0.02  # around a turning body
MIN_ARC_LINEAR, MIN_ARC_ANGULAR = 0.03, 0.05  # [m/s], [rad/s]; slower motion is no arc
ZONES = {  # code of the cause, and the text after the distance; turns have none
    "forward": ("zone_ahead", "ahead of the body"),
    "backward": ("zone_behind", "behind the body"),
    "left": ("zone_left", "to the left of the body"),
    "right": ("zone_right", "to the right of the body"),
    "turn_left": ("zone_turn_left", ""),
    "turn_right": ("zone_turn_right", ""),
}

Free = dict[str, float | None]  # [m] or [rad] by direction; None without an obstacle


class Motion(Struct, frozen=True, kw_only=True):
    """Motion of the body: measured, commanded by the gate, and requested by the commander."""

    measured: Velocity
    commanded: Velocity
    requested: Velocity

    def towards(self, direction: str) -> float:
        """Return the larger of measured and commanded speed in a direction, at least 0."""
        return max(0.0, _speed(self.measured, direction), _speed(self.commanded, direction))


class ProtectiveField(Struct, frozen=True, kw_only=True):
    """The newest free distances, and the directions in which the body has stopped."""

    scans: int = 0  # processed so far
    basis: int = 0  # tick of the newest scan
    problem: str = ""  # with that scan; empty if it is plausible
    by_scan: Free = {}  # by that scan alone
    free: Free = {}  # by scan and cameras
    by_camera: frozenset[str] = frozenset()  # directions with the nearest obstacle by a camera
    stopped: frozenset[str] = frozenset()
    sectors: blind_spots.Ranges = ()
    sectors_at: tuple[int, Pose] | None = None  # tick and odometry pose of their scan
    past: blind_spots.PastViews = ()
    cameras: Cameras = Cameras()

    def then(
        self,
        body: BodyDescription,
        scan: LaserScan | None,
        state: RobotState,
        history: PoseHistory,
        motion: Motion,
        pictures: Pictures = NO_PICTURES,
    ) -> "ProtectiveField":
        """Return the field after a new scan or picture, once the state has reached its tick.

        Zones depend on the speed at that tick. Until the next scan or picture, the caps keep the
        body from gaining more speed than its zone allows.
        """
        now = self
        if scan and body.lidar and scan.basis != self.basis and scan.basis <= state.tick:
            now = self._with_scan(body, body.lidar, scan, state, history, motion)
        if depth_cameras(body):
            cameras = self.cameras.then(body, pictures, state, history)
            now = replace(now, cameras=cameras)
            if now.basis == self.basis and cameras.version == self.cameras.version:
                return now
        return self if now is self else now._with_zones(body, state, motion)

    def _with_scan(
        self,
        body: BodyDescription,
        lidar: Lidar,
        scan: LaserScan,
        state: RobotState,
        history: PoseHistory,
        motion: Motion,
    ) -> "ProtectiveField":
        """Return the field with the free distances by one scan."""
        problem = scan_problem(lidar, scan.ranges_m, HOUSING_M)
        problem = problem or blind_ahead(lidar, scan, HOUSING_M, CONE_DEG)
        now = replace(self, scans=self.scans + 1, basis=scan.basis, problem=problem)
        if problem:
            return replace(now, by_scan={})
        pose = history.at(state.boot, scan.basis) or state.pose
        moved = self._distance_since(body, scan.basis, pose, motion.measured)
        sectors, unknown = blind_spots.update(lidar, scan, HOUSING_M, pose.yaw, self.sectors, moved)
        # a body that does not drive may be carried, which the odometry would not show
        driving = state.gate.mode == "enabled"
        past = blind_spots.remember(self.past, body, pose, scan) if driving else ()
        seen = np.stack(hits(lidar, scan, HOUSING_M), axis=1)
        assumed = blind_spots.obstacles(body, pose.yaw, sectors, unknown, HOUSING_M, past)
        free = _free(body, np.concatenate([seen, assumed]), motion)
        at = scan.basis, pose
        return replace(now, by_scan=free, sectors=sectors, sectors_at=at, past=past)

    def _distance_since(
        self, body: BodyDescription, tick: int, pose: Pose, measured: Velocity
    ) -> float:
        """Return how far the body may have moved since the scan of the sectors [m].

        The present speed is too low after braking, so the odometry counts as well. It may jump, so
        it counts only up to the distance that the body can drive.
        """
        if self.sectors_at is None:
            return 0.0
        tick_before, before = self.sectors_at
        elapsed_s = max(0, tick - tick_before) * TICK_NS / 1e9
        max_m = elapsed_s * math.hypot(body.max_linear_speed, body.max_lateral_speed)
        driven = math.hypot(pose.x - before.x, pose.y - before.y)
        by_speed = elapsed_s * math.hypot(measured.linear_x, measured.linear_y)
        return max(by_speed, min(driven, max_m))

    def _with_zones(
        self, body: BodyDescription, state: RobotState, motion: Motion
    ) -> "ProtectiveField":
        """Return the field with the obstacles of scan and cameras, and the stopped directions."""
        free, nearer = self.by_scan, set[str]()
        points = self.cameras.obstacles(state.pose)
        if len(points):
            seen = _free(body, points, motion)
            nearer = {way for way, far in seen.items() if _shorter(far, free.get(way))}
            free = {**free, **{way: seen[way] for way in nearer}}
        stopped = frozenset(
            way
            for way, brake in brakes(body).items()
            if brake.in_zone(free.get(way), motion.towards(way), way in self.stopped)
        )
        return replace(self, free=free, by_camera=frozenset(nearer), stopped=stopped)

    def caps(self, body: BodyDescription) -> SpeedCaps:
        """Return the speed cap of each direction."""
        allowed = {
            direction: brake.cap(self.free.get(direction), direction in self.stopped)
            for direction, brake in brakes(body).items()
        }
        allowed.update((way, 0.0) for way in self.cameras.blind & allowed.keys())
        return SpeedCaps(**allowed)

    @property
    def causes(self) -> tuple[Cause, ...]:
        """Causes that only limit motion towards an obstacle; the gate does not stop for them."""
        found = []
        for direction, (code, side) in ZONES.items():
            if direction in self.stopped:
                free = self.free.get(direction) or 0.0
                text = f"obstacle {free:.2f} m {side}" if side else cause(code).text
                by = ", seen by a camera" if direction in self.by_camera else ""
                found.append(cause(code, f"{text}{by}"))
        return (*found, *self.cameras.causes)


def _shorter(one: float | None, other: float | None) -> bool:
    """Return whether the free distance `one` is shorter; None means no obstacle."""
    return one is not None and (other is None or one < other)


def _free(body: BodyDescription, points: Floats, motion: Motion) -> Free:
    shape, side = body.footprint, body.thresholds.side_margin
    forward, backward, left, right = straight(shape, points, side)
    reach = brakes(body)["turn_left"].reach
    turn_left, turn_right = turning(shape, points, TURN_MARGIN_M, reach)
    free: Free = {
        "forward": forward,
        "backward": backward,
        "left": left,
        "right": right,
        "turn_left": turn_left,
        "turn_right": turn_right,
    }
    for twist in {axes(motion.measured), axes(motion.requested)}:
        way = _arc(body, points, twist)
        if way is None:
            continue
        speed = math.hypot(twist[0], twist[1])
        ways = (
            ("forward" if twist[0] > 0 else "backward", abs(twist[0])),
            ("left" if twist[1] > 0 else "right", abs(twist[1])),
        )
        for direction, along in ways:
            known = free[direction]
            if along >= MIN_ARC_LINEAR:
                part = way * along / speed + _unneeded_margin(body, twist)
                free[direction] = part if known is None else min(part, known)
    return free


def _unneeded_margin(body: BodyDescription, twist: Axes) -> float:
    """Return the part of the stop margin that a curve does not need [m].

    The stop margin is room for the point of the body that moves farthest: on a curve, a corner. The
    tighter the curve, the less the body's middle moves; in a turn on the spot, not at all. If the
    turn takes longer to brake than the speed, the motion in the extra time is subtracted.
    """
    vx, vy, w = twist
    speed = math.hypot(vx, vy)
    fastest = max(speed, *(math.hypot(vx - w * y, vy + w * x) for x, y in body.footprint))
    brakes_s = speed / body.max_linear_deceleration
    longer_s = max(0.0, abs(w) / body.max_angular_acceleration - brakes_s)
    room = body.thresholds.stop_margin * (1.0 - speed / fastest)
    return max(0.0, room - speed * longer_s / 2.0)


def _arc(body: BodyDescription, points: Floats, twist: Axes) -> float | None:
    """Return the free distance on a curve or diagonal [m]; None if straight or unobstructed."""
    ahead, aside = (abs(speed) >= MIN_ARC_LINEAR for speed in twist[:2])
    bends = abs(twist[2]) >= MIN_ARC_ANGULAR
    if not (ahead and aside) and not (bends and (ahead or aside)):
        return None
    limits, reach = body.thresholds, brakes(body)["forward"].reach
    return arc(body.footprint, points, limits.side_margin, reach, twist)


def _speed(of: Velocity, direction: str) -> float:
    axis = {"forward": of.linear_x, "left": of.linear_y, "turn_left": of.angular_z}
    opposite = {"backward": "forward", "right": "left", "turn_right": "turn_left"}
    return axis[direction] if direction in axis else -axis[opposite[direction]]
