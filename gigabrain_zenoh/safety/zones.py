"""The protective field: free distance in each direction, and the speeds it allows.

It is computed at each scan, and where cameras measure depth at each picture.
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
CONE_DEG = 30.0  # ahead, in which some beam must be valid
TURN_MARGIN_M = 0.02  # around a turning body
MIN_ARC_LINEAR, MIN_ARC_ANGULAR = 0.03, 0.05  # [m/s], [rad/s]; slower motion is no arc
ZONES = {  # code of the cause, and the text behind a distance [m]; turns have none
    "forward": ("zone_ahead", "ahead of the body"),
    "backward": ("zone_behind", "behind the body"),
    "left": ("zone_left", "to the left of the body"),
    "right": ("zone_right", "to the right of the body"),
    "turn_left": ("zone_turn_left", ""),
    "turn_right": ("zone_turn_right", ""),
}

Free = dict[str, float | None]  # [m] or [rad] by direction; None where nothing is in the way


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
    basis: int = 0  # tick of the newest
    problem: str = ""  # why that one is not plausible
    by_scan: Free = {}  # what it leaves free
    free: Free = {}  # what is left by what cameras saw, too
    by_camera: frozenset[str] = frozenset()  # directions in which that is the nearest
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
        """Return the field after a new scan or picture, once the state of its tick has come.

        Zones depend on the speed at that tick. Until the next one the speed caps keep the body
        from gaining more speed than its zone allows.
        """
        now = self
        if scan and body.lidar and scan.basis != self.basis and scan.basis <= state.tick:
            now = self._scanned(body, body.lidar, scan, state, history, motion)
        if depth_cameras(body):
            cameras = self.cameras.then(body, pictures, state, history)
            now = replace(now, cameras=cameras)
            if now.basis == self.basis and cameras.seen == self.cameras.seen:
                return now
        return self if now is self else now._closed(body, state, motion)

    def _scanned(
        self,
        body: BodyDescription,
        lidar: Lidar,
        scan: LaserScan,
        state: RobotState,
        history: PoseHistory,
        motion: Motion,
    ) -> "ProtectiveField":
        """Return the field with what one scan leaves free."""
        problem = scan_problem(lidar, scan.ranges_m, HOUSING_M)
        problem = problem or blind_ahead(lidar, scan, HOUSING_M, CONE_DEG)
        now = replace(self, scans=self.scans + 1, basis=scan.basis, problem=problem)
        if problem:
            return replace(now, by_scan={})
        pose = history.at(state.boot, scan.basis) or state.pose
        moved = self._moved(body, scan.basis, pose, motion.measured)
        sectors, unknown = blind_spots.update(lidar, scan, HOUSING_M, pose.yaw, self.sectors, moved)
        # a body that does not drive may be carried, which the odometry would not show
        driving = state.gate.mode == "enabled"
        past = blind_spots.remember(self.past, body, pose, scan) if driving else ()
        seen = np.stack(hits(lidar, scan, HOUSING_M), axis=1)
        dark = blind_spots.obstacles(body, pose.yaw, sectors, unknown, HOUSING_M, past)
        free = _free(body, np.concatenate([seen, dark]), motion)
        at = scan.basis, pose
        return replace(now, by_scan=free, sectors=sectors, sectors_at=at, past=past)

    def _moved(self, body: BodyDescription, tick: int, pose: Pose, measured: Velocity) -> float:
        """Return how far the body may have moved since the scan of the sectors [m].

        The speed now says nothing about a gap in which the body braked; the odometry may jump, but
        no farther than the body can drive counts.
        """
        if self.sectors_at is None:
            return 0.0
        since, there = self.sectors_at
        elapsed_s = max(0, tick - since) * TICK_NS / 1e9
        farthest = elapsed_s * math.hypot(body.max_linear_speed, body.max_lateral_speed)
        driven = math.hypot(pose.x - there.x, pose.y - there.y)
        by_speed = elapsed_s * math.hypot(measured.linear_x, measured.linear_y)
        return max(by_speed, min(driven, farthest))

    def _closed(
        self, body: BodyDescription, state: RobotState, motion: Motion
    ) -> "ProtectiveField":
        """Return the field with the nearest of scan and cameras, and the directions it closes."""
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
        """Return the largest speed in each direction."""
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
    """Return whether `one` leaves less free than `other`; None is all free."""
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
                part = way * along / speed + _margin_on_curve(body, twist)
                free[direction] = part if known is None else min(part, known)
    return free


def _margin_on_curve(body: BodyDescription, twist: Axes) -> float:
    """Return by how much less than straight on may be free along a curve [m].

    The stop margin is room for the part of the body that moves farthest: on a curve, a corner. The
    tighter the curve, the less of that way the body's middle goes, and none in a turn on the spot.
    If the turn takes longer to brake than the speed, the way in that time counts as well.
    """
    vx, vy, w = twist
    speed = math.hypot(vx, vy)
    fastest = max(speed, *(math.hypot(vx - w * y, vy + w * x) for x, y in body.footprint))
    brakes_s = speed / body.max_linear_deceleration
    longer_s = max(0.0, abs(w) / body.max_angular_acceleration - brakes_s)
    room = body.thresholds.stop_margin * (1.0 - speed / fastest)
    return max(0.0, room - speed * longer_s / 2.0)


def _arc(body: BodyDescription, points: Floats, twist: Axes) -> float | None:
    """Return the free distance along a curve or a slant [m]; None without one or an obstacle."""
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
