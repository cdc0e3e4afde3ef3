"""Follows the things round the robot from scan to scan, in the frame of the odometry."""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.brain import Obstacle
from gigabrain_zenoh.geometry.planar import compose
from gigabrain_zenoh.perception.obstacles.arc import off_rims, on_rim, place_of
from gigabrain_zenoh.perception.obstacles.clusters import Cluster, find_clusters
from gigabrain_zenoh.perception.obstacles.free_space import FreeSpace, Seen
from gigabrain_zenoh.perception.obstacles.partly import discs_of
from gigabrain_zenoh.perception.obstacles.track import TURNED, TURNED_PARTLY, Track

Floats = NDArray[np.float64]

TICK_S = TICK_NS / 1e9
GATE = 4.0  # standard deviations; what is farther from where a thing should be is another
FARTHEST_JUMP_M = 0.6
PARTLY = 4.0  # times as far off may be what is partly hidden
SEEN = 2  # scans, before others hear of it
FORGET_S, FORGET_NEW_S = 1.0, 0.25  # without having been seen, for what may be hidden
FORGET_QUICK_S = 1.5  # what is quick may be behind a body that does not look there
FORGET_GONE_S = 0.45  # where beams go through the place
LONGEST_GAP_S = 1.0  # between scans; after a longer one it begins anew
MOST = 64  # obstacles, the nearest of which are told


class ObstacleTracker:
    """Hands out an id per thing, which it keeps for as long as it is followed."""

    def __init__(self) -> None:
        self._tracks: list[Track] = []
        self._space = FreeSpace()
        self._boot = self._tick = self._ids = 0

    def update(
        self, hits: Floats, lidar: Lidar, spacing: float, pose: Pose, boot: int, tick: int
    ) -> tuple[Obstacle, ...]:
        """One scan more: `hits` (n, 2) [m] in the body's frame, taken at `tick` from `pose`.

        `spacing` [rad] is from beam to beam. A scan that is not newer than the last changes
        nothing; a new start of the driver begins anew.
        """
        dt = (tick - self._tick) * TICK_S
        if boot != self._boot or dt > LONGEST_GAP_S:
            self._tracks.clear()
            self._space.clear()
        elif dt <= 0:
            return self._told(pose)
        self._boot, self._tick = boot, tick
        for track in self._tracks:
            track.predict(dt)
        clusters = find_clusters(hits, lidar, abs(spacing)) if len(hits) else []
        places = [_place(cluster, lidar, pose, cluster.radius) for cluster in clusters]
        taken = self._match(clusters, places)
        points = _placed(hits, pose)
        parts = self._correct_all(clusters, taken, points, lidar, pose)
        self._space.see(Seen(tick, points, lidar, abs(spacing), pose))
        self._judge()
        self._tracks = [track for track in self._tracks if self._lives(track)]
        self._begin_parts(points, lidar, pose)
        for j in set(range(len(clusters))) - set(taken.values()):
            if clusters[j].whole and not any(track.covers(places[j]) for track in parts):
                self._begin(clusters[j], places[j])
        return self._told(pose)

    def _match(self, clusters: list[Cluster], places: list[tuple[float, float]]) -> dict[int, int]:
        """Which track is which cluster: the best pairs first, within the gates."""
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
        gates = np.maximum(GATE * np.sqrt(variance), mine[:, None, 4] + 2 * seen[:, 2])
        fits = (squares < gates**2) & (squares < (FARTHEST_JUMP_M + other_size) ** 2)
        cost = squares / variance + (other_size / 0.2) ** 2
        pairs = np.argwhere(fits)
        taken: dict[int, int] = {}
        used: set[int] = set()
        for i, j in pairs[np.argsort(cost[fits], kind="stable")].tolist():
            if i not in taken and j not in used:
                taken[i] = j
                used.add(j)
        return taken

    def _correct_all(
        self, clusters: list[Cluster], taken: dict[int, int], points: Floats, lidar: Lidar,
        pose: Pose,
    ) -> list[Track]:  # fmt: skip
        """Correct what was seen. Told are the moving things of which only a part was."""
        whole, parts = [], []
        for i, track in enumerate(self._tracks):
            cluster = clusters[taken[i]] if i in taken else None
            if (track.moving or track.partly) and not (cluster and cluster.whole):
                parts.append(track)
            elif cluster:
                self._correct(track, cluster, lidar, pose)
                whole.append(track)
        parts.sort(key=lambda track: track.position_variance)
        if parts:
            points = _beside(points, whole)
        found = []
        for track in parts:
            place = place_of(points, track.x, track.y, track.radius)
            if place and track.may_be_at(*place):
                track.correct(place[0], place[1], track.radius, place[2], most_off=TURNED_PARTLY)
                points = points[~on_rim(points, track.x, track.y, track.radius)]
                found.append(track)
        return found

    def _correct(self, track: Track, cluster: Cluster, lidar: Lidar, pose: Pose) -> None:
        x, y = _place(cluster, lidar, pose, track.radius)
        if cluster.whole:
            track.correct(x, y, cluster.radius, cluster.noise, most_off=TURNED)
        else:  # what is hidden of it is not missing from its size
            track.correct(x, y, track.radius, PARTLY * cluster.noise)

    def _judge(self) -> None:
        """Which things move: what only turns another side to the robot does not."""
        for t in self._tracks:
            if t.seems_to_move():
                t.moving = self._space.shows_motion(t.x, t.y, t.velocity_x, t.velocity_y, t.radius)

    def _lives(self, track: Track) -> bool:
        limit = FORGET_S if track.seen > SEEN else FORGET_NEW_S
        if track.moves_quickly:
            limit = FORGET_QUICK_S
        if FORGET_GONE_S <= track.unseen_s < limit and self._space.is_free(track.x, track.y):
            return False
        return track.unseen_s < limit

    def _begin(self, cluster: Cluster, place: tuple[float, float]) -> None:
        self._add(*place, cluster.radius, cluster.noise, partly=False)

    def _add(self, x: float, y: float, radius: float, noise: float, *, partly: bool) -> None:
        self._ids += 1
        self._tracks.append(
            Track(self._ids, x, y, radius, noise**2, anchor_x=x, anchor_y=y, partly=partly)
        )

    def _begin_parts(self, points: Floats, lidar: Lidar, pose: Pose) -> None:
        """Follow also what others hide in part, where things move: it is taken to be as large."""
        sizes = [track.radius for track in self._tracks if track.moves_quickly]
        if not sizes:
            return
        radius = float(np.median(sizes))
        eye = compose(pose, Pose(x=lidar.x, y=lidar.y, yaw=0.0))
        for x, y, noise in discs_of(_beside(points, self._tracks), (eye.x, eye.y), radius):
            if not any(track.covers((x, y)) for track in self._tracks):
                self._add(x, y, radius, noise, partly=True)

    def _told(self, pose: Pose) -> tuple[Obstacle, ...]:
        known = [track for track in self._tracks if track.seen >= SEEN]
        known.sort(key=lambda track: math.hypot(track.x - pose.x, track.y - pose.y))
        return tuple(track.obstacle() for track in known[:MOST])


def _beside(points: Floats, tracks: list[Track]) -> Floats:
    """Those of the `points` (n, 2) that are hits on none of the `tracks`."""
    return off_rims(points, np.array([(t.x, t.y, t.radius) for t in tracks]).reshape(-1, 3))


def _placed(hits: Floats, pose: Pose) -> Floats:
    """`hits` (n, 2) of the body's frame in that of `pose`."""
    cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
    x = pose.x + cosine * hits[:, 0] - sine * hits[:, 1]
    y = pose.y + sine * hits[:, 0] + cosine * hits[:, 1]
    return np.column_stack((x, y))


def _place(cluster: Cluster, lidar: Lidar, pose: Pose, radius: float) -> tuple[float, float]:
    """The centre of a cluster [m] in the frame of `pose`, were it so large."""
    distance = cluster.near + radius
    ahead = lidar.x + distance * math.cos(cluster.bearing)
    left = lidar.y + distance * math.sin(cluster.bearing)
    cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
    return pose.x + cosine * ahead - sine * left, pose.y + sine * ahead + cosine * left
