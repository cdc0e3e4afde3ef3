"""Tracks obstacles from scan to scan in the odometry frame: a constant-velocity Kalman filter each.

Both axes have the same noise, so that one 2 x 2 covariance serves both.
"""

import math
import statistics
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S, Pose
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.brain import Obstacle, WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.pose import compose, to_parent
from gigabrain_zenoh.perception.obstacle_detection import (
    Cluster,
    FreeSpace,
    PastScan,
    discs_of,
    find_clusters,
    fit_disc,
    off_rims,
    on_rim,
)

ACCELERATION_SIGMA = 0.8  # [m/s2], standard deviation for a walking person
INITIAL_SPEED_SIGMA = 1.0  # [m/s], standard deviation of an unknown speed
MAX_REVERSED_S = 0.06  # longest time that a thing may have moved backwards while unseen
TURN_GATE, PARTIAL_TURN_GATE = 10.0, 16.0  # squared deviations; more is a turn, not noise
MAX_OFF_SIGMAS = 4.0  # standard deviations between a track and its partly hidden disc
SHIFT_M = 0.05  # added to that distance
MAX_OFF_M = 0.5  # limit of the sum
RADIUS_GAIN = 0.25  # weight of a new radius in the filtered one
MOVING_M, MOVING_SPEED = 0.15, 0.15  # [m], [m/s], minimum of a motion
QUICK_SPEED = 0.5  # [m/s]
MOVING_SIGMAS = 2.5  # standard deviations of a moving thing's speed above zero
STANDING_SPEED, STANDING_S = 0.12, 0.6  # [m/s], [s]: a thing this slow for this long stands
REFUTED_S = 0.2  # evidence of rest for this long refutes a motion

GATE_SIGMAS = 4.0  # standard deviations from the prediction; a farther cluster is another thing
MAX_JUMP_M = 0.6
PARTIAL_NOISE_FACTOR = 4.0  # for clusters that are partly hidden
CONFIRMED_SCANS = 2  # scans with a thing before it is published
FORGET_S, FORGET_NEW_S = 1.0, 0.25  # a track is forgotten when unseen for this long
FORGET_QUICK_S = 1.5  # the same for quick things, which may be behind the body
FORGET_GONE_S = 0.45  # the same if beams pass through its place
MAX_GAP_S = 1.0  # between scans; a longer gap clears all tracks
MAX_OBSTACLES = 64  # the nearest ones are published


@dataclass
class ObstacleTrack:
    """Position and velocity of a thing in the odometry frame."""

    id: int
    x: float  # [m]
    y: float  # [m]
    radius: float  # [m]
    position_variance: float  # [m2]
    velocity_x: float = 0.0  # [m/s]
    velocity_y: float = 0.0  # [m/s]
    covariance: float = 0.0  # [m2/s], of position and velocity
    velocity_variance: float = INITIAL_SPEED_SIGMA**2  # [m2/s2]
    seen: int = 1  # scans
    unseen_s: float = 0.0
    moving: bool = False
    partial: bool = False  # only a part was visible when it was first seen
    standing_s: float = 0.0
    refuted_s: float = 0.0
    anchor_x: float = 0.0  # [m], last place where it stood
    anchor_y: float = 0.0

    def predict(self, dt: float) -> None:
        """Predict the state after `dt` [s]."""
        self.x += dt * self.velocity_x
        self.y += dt * self.velocity_y
        q = ACCELERATION_SIGMA**2
        self.position_variance += dt * (
            2 * self.covariance + dt * self.velocity_variance + dt**3 * q / 4
        )
        self.covariance += dt * (self.velocity_variance + dt * dt * q / 2)
        self.velocity_variance += dt * dt * q
        self.unseen_s += dt

    def correct(
        self, x: float, y: float, radius: float, noise: float, *, turn_gate: float = math.inf
    ) -> None:
        """Correct by a measurement at (x, y) [m] with standard deviation `noise` [m].

        Farther than `turn_gate` (squared deviations) from the prediction, it has turned.
        """
        dx, dy = x - self.x, y - self.y
        off = (dx * dx + dy * dy) / (self.position_variance + noise * noise)
        if self.moving and off > turn_gate:
            self._turn()
        innovation = self.position_variance + noise * noise
        k, kv = self.position_variance / innovation, self.covariance / innovation
        self.x += k * dx
        self.y += k * dy
        self.velocity_x += kv * dx
        self.velocity_y += kv * dy
        self.velocity_variance -= kv * self.covariance
        self.covariance *= 1.0 - k
        self.position_variance *= 1.0 - k
        self.radius += RADIUS_GAIN * (radius - self.radius)
        self.seen += 1
        self._update_standing(self.unseen_s)
        self.unseen_s = 0.0

    def _turn(self) -> None:
        """Increase the uncertainty: it has turned or stopped since it was last seen."""
        square = max(self.velocity_x**2 + self.velocity_y**2, INITIAL_SPEED_SIGMA**2)
        self.velocity_variance += square
        self.covariance += self.unseen_s * square / 2
        self.position_variance += self.unseen_s**2 * square / 3

    def may_be_at(self, x: float, y: float, noise: float) -> bool:
        """Return whether it can be at (x, y) [m], measured with a deviation of `noise` [m]."""
        limit = SHIFT_M + MAX_OFF_SIGMAS * math.sqrt(self.position_variance + noise * noise)
        return math.hypot(x - self.x, y - self.y) < min(MAX_OFF_M, limit)

    def covers(self, place: tuple[float, float]) -> bool:
        """Return whether a place [m] is within its disc."""
        return math.hypot(place[0] - self.x, place[1] - self.y) < self.radius

    @property
    def may_be_off(self) -> float:
        """Return how far it may be from the predicted position if it has turned round [m]."""
        speed = math.hypot(self.velocity_x, self.velocity_y)
        return 2 * speed * min(self.unseen_s, MAX_REVERSED_S) if self.moving else 0.0

    @property
    def moves_quickly(self) -> bool:
        """Return whether it moves faster than QUICK_SPEED."""
        return self.moving and math.hypot(self.velocity_x, self.velocity_y) > QUICK_SPEED

    def seems_to_move(self) -> bool:
        """Return whether it has moved far and fast enough to check that against free space."""
        if self.moving or self.unseen_s > 0:
            return False
        speed = math.hypot(self.velocity_x, self.velocity_y)
        distance = math.hypot(self.x - self.anchor_x, self.y - self.anchor_y)
        significant = speed > MOVING_SIGMAS * math.sqrt(self.velocity_variance)
        return distance > MOVING_M and speed > MOVING_SPEED and significant

    def _update_standing(self, dt: float) -> None:
        """Count `dt` [s] of slow motion. After STANDING_S, it stands."""
        speed = math.hypot(self.velocity_x, self.velocity_y)
        self.standing_s = self.standing_s + dt if speed < STANDING_SPEED else 0.0
        if self.moving and self.standing_s >= STANDING_S:
            self._rest()

    def refute(self, dt: float) -> None:
        """Count `dt` [s] in which its hits showed no motion. After REFUTED_S, it stands."""
        self.refuted_s += dt
        if self.refuted_s >= REFUTED_S:
            self.velocity_x = self.velocity_y = 0.0
            self._rest()

    def _rest(self) -> None:
        self.moving, self.anchor_x, self.anchor_y = False, self.x, self.y

    def obstacle(self) -> Obstacle:
        """Return it as a message, with zero velocity while it stands."""
        p, c, v = self.position_variance, self.covariance, self.velocity_variance
        return Obstacle(
            id=self.id,
            x=self.x,
            y=self.y,
            velocity_x=self.velocity_x if self.moving else 0.0,
            velocity_y=self.velocity_y if self.moving else 0.0,
            radius=self.radius,
            covariance=(p, 0.0, c, 0.0, 0.0, p, 0.0, c, c, 0.0, v, 0.0, 0.0, c, 0.0, v),
        )


class ObstacleTracker:
    """Tracks obstacles; each has an id for as long as it is tracked."""

    def __init__(self) -> None:
        self._tracks: list[ObstacleTrack] = []
        self._space = FreeSpace()
        self._boot = self._tick = self._ids = 0

    def add_obstacles(
        self, world: WorldModel, lidar: Lidar | None, scan: LaserScan, pose: Pose | None
    ) -> WorldModel:
        """Return `world` with its obstacles in the parent frame of `pose`, if that is known."""
        if lidar is None or pose is None or not world.scan_ok:
            return world
        hits = world.points().astype(np.float64)
        found = self.update(hits, lidar, scan.angle_increment, pose, scan.boot, scan.basis)
        return replace(world, obstacles=found)

    def update(
        self, hits: Floats, lidar: Lidar, spacing: float, pose: Pose, boot: int, tick: int
    ) -> tuple[Obstacle, ...]:
        """Process a scan of `tick`: `hits` (n, 2) [m] in the body's frame, from `pose`.

        `spacing` [rad] is between beams. An old scan changes nothing; a restart of the driver or a
        long gap clears all tracks.
        """
        dt = (tick - self._tick) * TICK_S
        if boot != self._boot or dt > MAX_GAP_S:
            self._tracks.clear()
            self._space.clear()
        elif dt <= 0:
            return self._obstacles(pose)
        self._boot, self._tick = boot, tick
        for track in self._tracks:
            track.predict(dt)
        clusters = find_clusters(hits, lidar, abs(spacing)) if len(hits) else []
        places = [_centre(cluster, lidar, pose, cluster.radius) for cluster in clusters]
        matches = self._match(clusters, places)
        points = _placed(hits, pose)
        parts = self._correct_all(clusters, matches, points, lidar, pose)
        self._space.add(PastScan(tick, points, lidar, abs(spacing), pose))
        self._check_motion(dt)
        self._tracks = [track for track in self._tracks if self._is_kept(track)]
        self._start_partial(points, lidar, pose)
        for j in set(range(len(clusters))) - set(matches.values()):
            if clusters[j].whole and not any(track.covers(places[j]) for track in parts):
                self._start(clusters[j], places[j])
        return self._obstacles(pose)

    def _match(self, clusters: list[Cluster], places: list[tuple[float, float]]) -> dict[int, int]:
        """Return matching clusters by track index. The best pairs are matched first."""
        if not clusters or not self._tracks:
            return {}
        mine = np.array(
            [(t.x, t.y, t.position_variance, t.radius, t.may_be_off) for t in self._tracks]
        )
        seen = np.array([(*p, c.noise, c.radius) for p, c in zip(places, clusters, strict=True)])
        dx, dy = (mine[:, None, k] - seen[:, k] for k in (0, 1))
        squares = dx * dx + dy * dy
        variance = mine[:, None, 2] + (2 * seen[:, 2]) ** 2
        other_size = np.abs(mine[:, None, 3] - seen[:, 3])
        gates = np.maximum(GATE_SIGMAS * np.sqrt(variance), mine[:, None, 4] + 2 * seen[:, 2])
        fits = (squares < gates**2) & (squares < (MAX_JUMP_M + other_size) ** 2)
        cost = squares / variance + (other_size / 0.2) ** 2
        pairs = np.argwhere(fits)
        matches: dict[int, int] = {}
        used: set[int] = set()
        for i, j in pairs[np.argsort(cost[fits], kind="stable")].tolist():
            if i not in matches and j not in used:
                matches[i] = j
                used.add(j)
        return matches

    def _correct_all(
        self, clusters: list[Cluster], matches: dict[int, int], points: Floats, lidar: Lidar,
        pose: Pose,
    ) -> list[ObstacleTrack]:  # fmt: skip
        """Correct all tracks that were seen. Return those of which only a part was seen."""
        whole, parts = [], []
        for i, track in enumerate(self._tracks):
            cluster = clusters[matches[i]] if i in matches else None
            if (track.moving or track.partial) and not (cluster and cluster.whole):
                parts.append(track)
            elif cluster:
                self._correct(track, cluster, lidar, pose)
                whole.append(track)
        parts.sort(key=lambda track: track.position_variance)
        if parts:
            points = _unexplained(points, whole)
        found = []
        for track in parts:
            place = fit_disc(points, track.x, track.y, track.radius)
            if place and track.may_be_at(*place):
                track.correct(
                    place[0], place[1], track.radius, place[2], turn_gate=PARTIAL_TURN_GATE
                )
                points = points[~on_rim(points, track.x, track.y, track.radius)]
                found.append(track)
        return found

    def _correct(self, track: ObstacleTrack, cluster: Cluster, lidar: Lidar, pose: Pose) -> None:
        x, y = _centre(cluster, lidar, pose, track.radius)
        if cluster.whole:
            track.correct(x, y, cluster.radius, cluster.noise, turn_gate=TURN_GATE)
        else:  # a partly hidden thing keeps its radius
            track.correct(x, y, track.radius, PARTIAL_NOISE_FACTOR * cluster.noise)

    def _check_motion(self, dt: float) -> None:
        """Check by free space which tracks move, and which only show another side."""
        for t in self._tracks:
            motion = t.x, t.y, t.velocity_x, t.velocity_y, t.radius
            if t.seems_to_move():
                t.moving, t.refuted_s = self._space.shows_motion(*motion), 0.0
            elif t.moving and t.unseen_s == 0.0:
                if self._space.shows_rest(*motion):
                    t.refute(dt)
                else:
                    t.refuted_s = 0.0

    def _is_kept(self, track: ObstacleTrack) -> bool:
        limit = FORGET_S if track.seen > CONFIRMED_SCANS else FORGET_NEW_S
        if track.moves_quickly:
            limit = FORGET_QUICK_S
        if FORGET_GONE_S <= track.unseen_s < limit and self._space.is_free(track.x, track.y):
            return False
        return track.unseen_s < limit

    def _start(self, cluster: Cluster, place: tuple[float, float]) -> None:
        self._add(*place, cluster.radius, cluster.noise, partial=False)

    def _add(self, x: float, y: float, radius: float, noise: float, *, partial: bool) -> None:
        self._ids += 1
        self._tracks.append(
            ObstacleTrack(
                self._ids, x, y, radius, noise**2, anchor_x=x, anchor_y=y, partial=partial
            )
        )

    def _start_partial(self, points: Floats, lidar: Lidar, pose: Pose) -> None:
        """Start tracks of partly hidden discs, with the median radius of the quick things."""
        radii = [track.radius for track in self._tracks if track.moves_quickly]
        if not radii:
            return
        radius = statistics.median(radii)
        sensor = compose(pose, Pose(x=lidar.x, y=lidar.y, yaw=0.0))
        rest = _unexplained(points, self._tracks)
        for x, y, noise in discs_of(rest, (sensor.x, sensor.y), radius):
            if not any(track.covers((x, y)) for track in self._tracks):
                self._add(x, y, radius, noise, partial=True)

    def _obstacles(self, pose: Pose) -> tuple[Obstacle, ...]:
        known = [track for track in self._tracks if track.seen >= CONFIRMED_SCANS]
        known.sort(key=lambda track: math.hypot(track.x - pose.x, track.y - pose.y))
        return tuple(track.obstacle() for track in known[:MAX_OBSTACLES])


def _unexplained(points: Floats, tracks: list[ObstacleTrack]) -> Floats:
    """Return the `points` (n, 2) that are on the rim of no track."""
    return off_rims(points, np.array([(t.x, t.y, t.radius) for t in tracks]).reshape(-1, 3))


def _placed(hits: Floats, pose: Pose) -> Floats:
    """Transform `hits` (n, 2) from the body's frame to the parent frame of `pose`."""
    cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
    x = pose.x + cosine * hits[:, 0] - sine * hits[:, 1]
    y = pose.y + sine * hits[:, 0] + cosine * hits[:, 1]
    return np.column_stack((x, y))


def _centre(cluster: Cluster, lidar: Lidar, pose: Pose, radius: float) -> tuple[float, float]:
    """Return the centre of a cluster of this radius [m], in the parent frame of `pose`."""
    distance = cluster.near + radius
    ahead = lidar.x + distance * math.cos(cluster.bearing)
    left = lidar.y + distance * math.sin(cluster.bearing)
    return to_parent(pose, ahead, left)
