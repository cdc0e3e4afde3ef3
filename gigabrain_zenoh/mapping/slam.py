"""SLAM: front end, pose graph and loop closure together.

`add` processes a scan. Meanwhile `close_loops` may run in another thread; its result moves nothing
until `apply`. On ground that earlier passes mapped, scans are matched to existing keyframes: a map
grows with the ground, not with the time driven.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import IDENTITY, between, compose, inverse, turned, wrap
from gigabrain_zenoh.mapping.front_end import FrontEnd, Kind, ScanMatch
from gigabrain_zenoh.mapping.keyframes import (
    Arrays,
    Edge,
    Keyframe,
    KeyframePolicy,
    Scan,
    edges_from_arrays,
    edges_to_arrays,
    keyframes_from_arrays,
    keyframes_to_arrays,
    shaped,
)
from gigabrain_zenoh.mapping.loop_closure import LoopSearch, around
from gigabrain_zenoh.mapping.pose_graph import DriftRates, Graph

LINK_COVARIANCE = np.diag((0.05, 0.05, 0.01)) ** 2  # of a link, added to that of its match
GUIDED_COVARIANCE = np.diag((0.02, 0.02, 0.005)) ** 2  # the same where odometry guided the match
MAX_TIED_TRAVEL_M = 4.0  # since a loop; so long the path lies exactly on earlier ones
TIED_COVARIANCE = np.diag((0.05, 0.05, 0.02)) ** 2  # of the drift since the loop
MIN_TIE_TRAVEL_M = 12.0  # between the ends of a loop that ties the path to earlier ones

PASS_TRAVEL_M = 12.0  # after this travel a keyframe belongs to an earlier pass
NEAR_M = 0.75  # keyframes this near show the robot's place
MIN_PASSES = 2  # after which ground is known
SIGHT_M = 3.0  # keyframes farther away show other places
SQUARE_M, SECTOR_RAD = 0.4, np.pi / 2  # one keyframe is enough for each place and direction
TURN_COST_M = 0.5  # per rad of turn, when keyframes are ranked by distance
MAX_CANDIDATES = 16


@dataclass(frozen=True, slots=True)
class Estimate:
    """Pose of the robot at a scan."""

    pose: Floats  # (3,), in the present map
    covariance: Floats  # (3, 3), of x, y and yaw in the map, relative to its surroundings
    keyframe: int  # a correction of this keyframe moves the pose as well
    relative: Floats  # (3,), the pose in that keyframe's frame
    kind: Kind  # see ScanMatch
    score: float  # 0 to 1, how well the scan fits
    kept: bool  # the scan became a keyframe
    lost: bool  # the sequence broke, and no loop joins the parts yet


@dataclass(frozen=True, slots=True)
class Correction:
    """Corrected poses of the first n keyframes, after loops were closed."""

    poses: Floats  # (n, 3)
    loops: tuple[Edge, ...]


class Slam:
    """A map that grows. All but `close_loops` belongs to one thread."""

    def __init__(
        self,
        pose: Floats = IDENTITY,
        spacing: KeyframePolicy | None = None,
        rates: DriftRates | None = None,
    ) -> None:
        self._front = FrontEnd(spacing or KeyframePolicy(), pose)
        self._anchor = (0, pose)  # a keyframe, and its pose in the front end's frame
        self._poses: list[Floats] = []
        self._segment = 0
        self._joined = {0}  # segments that loops have joined to the first
        self._travel = 0.0
        self._tied_travel = -np.inf  # [m] of travel, where the path last lay on earlier ones
        self._on_known_ground = False  # scans are matched to earlier keyframes only
        self._smooth: Floats = IDENTITY  # the front end's frame in the frame that never jumps
        self._ground = KnownGround()
        self._known_scans: dict[int, Scan] = {}  # by keyframe; kept, as their normals take long
        self._graph = Graph()
        self._rates = rates or DriftRates()
        self._search = LoopSearch(self._rates)
        self._closing: tuple[Edge, ...] = ()  # loops with which the graph has not settled
        self.keyframes: list[Keyframe] = []  # only appended to
        self.revision = 0  # changes whenever poses of keyframes are corrected

    @property
    def poses(self) -> Floats:
        """The poses of the keyframes in the map, (n, 3)."""
        return np.array(self._poses).reshape(-1, 3)

    def poses_from(self, first: int) -> list[Floats]:
        """Return the poses of the keyframes from `first` on in the map, (3,) each."""
        return self._poses[first:]

    @property
    def pose(self) -> Floats:
        """The robot's pose (3,) at the last scan in the present map. Needs a keyframe."""
        keyframe, front_pose = self._anchor
        return compose(self._poses[keyframe], between(front_pose, self._front.pose))

    @property
    def smooth(self) -> Floats:
        """The robot's pose (3,) in a frame that drifts and never jumps."""
        return compose(self._smooth, self._front.pose)

    def add(self, scan: Scan, delta: Floats, noise: Floats | None = None) -> Estimate:
        """Add a scan after a step `delta` (x, y, yaw) of odometry.

        `noise` (3, 3) is the covariance of `delta` in its own frame. Without it odometry counts
        little where scans can be matched.
        """
        if not np.isfinite(delta).all():
            raise ValueError(f"odometry: expected finite numbers, got {delta}")
        self._travel += float(np.hypot(delta[0], delta[1]))
        match, far = self._front.add(scan, delta, noise)
        known = self._match_known_ground(scan, match) if far else None
        match, kept = known or match, far and known is None
        keyframe, front_pose = self._anchor
        relative = between(front_pose, match.pose)
        if kept:
            self._add_keyframe(scan, match, relative)
            keyframe, relative = len(self.keyframes) - 1, IDENTITY
        pose = compose(self._poses[keyframe], relative)
        return Estimate(
            pose=pose,
            covariance=turned(match.covariance, float(pose[2] - match.pose[2])),
            keyframe=keyframe,
            relative=relative,
            kind=match.kind,
            score=match.score,
            kept=kept,
            lost=self._segment not in self._joined,
        )

    def relocate(self, pose: Floats) -> None:
        """Put the robot at `pose` in the map, and match to the keyframes there."""
        travel = np.array([keyframe.travel for keyframe in self.keyframes])
        poses = self.poses
        away = np.hypot(*(poses[:, :2] - pose[:2]).T)
        away[[keyframe.segment not in self._joined for keyframe in self.keyframes]] = np.inf
        nearest = int(np.argmin(away))
        place = around(travel, nearest, len(poses))
        ids = sorted(range(place.start, place.stop), key=lambda k: -abs(k - nearest))
        smooth = self.smooth
        self._front.place(pose)
        self._front.restart([self.keyframes[k].scan for k in ids], [poses[k] for k in ids])
        self._continue_from(nearest, poses, smooth)

    def _continue_from(self, keyframe: int, poses: Floats, smooth: Floats) -> None:
        """Continue in the map's frame from an earlier keyframe; the robot is at `smooth`."""
        self._anchor = (keyframe, poses[keyframe])
        self._segment = self.keyframes[keyframe].segment
        self._tied_travel = self._travel
        self._smooth = compose(smooth, inverse(self._front.pose))

    def _match_known_ground(self, scan: Scan, match: ScanMatch) -> ScanMatch | None:
        """Match the scan to the keyframes of known ground, and the next scans as well.

        Return None if the ground is not known, or the scan does not fit it.
        """
        known, self._on_known_ground = self._on_known_ground, False
        if match.kind != "matched" or self._travel - self._tied_travel > MAX_TIED_TRAVEL_M:
            return None
        keyframe, front_pose = self._anchor
        poses, smooth = self.poses, self.smooth
        pose = compose(poses[keyframe], between(front_pose, match.pose))
        ids = self._ground.keyframes_near(pose, self._travel, poses, self._joined)
        if not ids:
            return None
        covariance = turned(match.covariance, float(pose[2] - match.pose[2]))
        expected = replace(
            match, pose=pose, covariance=covariance + (0.0 if known else TIED_COVARIANCE)
        )
        self._known_scans = {k: self._known_scans.get(k) or self.keyframes[k].scan for k in ids}
        found = self._front.settle(
            scan, list(self._known_scans.values()), list(poses[ids]), expected
        )
        if found:
            self._on_known_ground = True
            self._continue_from(ids[-1], poses, smooth)
        return found

    def close_loops(self) -> Correction | None:
        """Search for loops from the next keyframe, or continue to close those that were found.

        Return None if nothing is corrected yet. Call it until `behind` is 0, from one thread at a
        time.
        """
        if self._closing:
            return self._correction(self._graph.settle())
        here = len(self._graph.poses)
        if here == len(self.keyframes):
            return None
        keyframes = self.keyframes[: here + 1]
        link = keyframes[here].link
        self._graph.extend([link])
        self._search.drift.add_link(link)
        if self._graph.failure:
            return None
        loops = self._search.find(keyframes, self._graph.poses)
        if not loops:
            return None
        self._closing = tuple(loops)
        return self._correction(self._graph.close(loops))

    def _correction(self, settled: bool) -> Correction | None:
        if not settled:
            return None
        kept = {id(loop) for loop in self._graph.loops}
        loops, self._closing = tuple(one for one in self._closing if id(one) in kept), ()
        return Correction(self._graph.poses, loops)

    @property
    def rebuilt(self) -> int:
        """The number of times the optimiser has failed and was rebuilt."""
        return self._graph.rebuilt

    @property
    def failure(self) -> str:
        """The reason why no more loops are closed, or an empty text."""
        return self._graph.failure

    @property
    def behind(self) -> int:
        """The number of keyframes to search from, plus one if found loops are not closed yet."""
        return len(self.keyframes) - len(self._graph.poses) + bool(self._closing)

    def apply(self, correction: Correction) -> None:
        """Move the keyframes to the poses that `close_loops` returned."""
        done = len(correction.poses)
        self._poses = list(correction.poses)
        for keyframe in self.keyframes[done:]:
            link = keyframe.link
            self._poses.append(compose(self._poses[link.first], link.relative))
        self._join_segments(correction.loops)
        self.revision += 1

    def still(self) -> "Slam":
        """Return a copy for `freeze`. Do not call it while `close_loops` runs."""
        copied = copy.copy(self)
        copied.keyframes, copied._poses = list(self.keyframes), list(self._poses)
        copied._front, copied._graph = copy.copy(self._front), copy.copy(self._graph)
        copied._search = copy.copy(self._search)
        copied._search.waiting = list(self._search.waiting)
        return copied

    def freeze(self) -> dict[str, NDArray[np.generic]]:
        """Return the state as arrays, to be saved. Do not call it while `close_loops` runs."""
        indices = {id(keyframe.points): k for k, keyframe in enumerate(self.keyframes)}
        scans, local_poses = self._front.held
        return {
            **keyframes_to_arrays(self.keyframes),
            **edges_to_arrays("loop", self._graph.loops),
            **edges_to_arrays("waiting", self._search.waiting),
            "poses": self.poses,
            "behind": np.array(len(self.keyframes) - len(self._graph.poses)),
            "searched": np.array(self._search.searched),
            "driven": np.array(self._travel),
            "local": np.array([indices[id(scan.points)] for scan in scans], np.int32),
            "local_poses": np.array(local_poses).reshape(-1, 3),
            "front": self._front.pose,
            "anchor": np.array(self._anchor[0]),
            "anchor_pose": self._anchor[1],
        }

    @classmethod
    def thaw(
        cls, arrays: Arrays, spacing: KeyframePolicy | None = None, rates: DriftRates | None = None
    ) -> "Slam":
        """Restore a frozen state; KeyError or ValueError if the arrays do not belong together."""
        slam = cls(shaped(arrays, "front", 3), spacing, rates)
        slam.keyframes = keyframes_from_arrays(arrays)
        for keyframe in slam.keyframes:
            slam._ground.add(keyframe)
        poses = arrays["poses"].astype(np.float64)
        behind, anchor = int(arrays["behind"]), int(arrays["anchor"])
        if poses.shape != (len(slam.keyframes), 3) or not 0 <= behind < len(poses) > anchor >= 0:
            raise ValueError(f"{len(slam.keyframes)} keyframes, but {len(poses)} poses")
        slam._poses = list(poses)
        slam._travel = float(arrays["driven"])
        slam._anchor = (anchor, shaped(arrays, "anchor_pose", 3))
        slam._segment = slam.keyframes[anchor].segment
        scans = [slam.keyframes[k].scan for k in arrays["local"].astype(int)]
        slam._front.restart(scans, list(shaped(arrays, "local_poses", len(scans), 3)))
        slam._thaw_graph(poses[: len(poses) - behind], arrays)
        return slam

    def _thaw_graph(self, poses: Floats, arrays: Arrays) -> None:
        loops = edges_from_arrays("loop", arrays)
        self._graph = _graph_of(self.keyframes[: len(poses)], poses, loops)
        for keyframe in self.keyframes[: len(poses)]:
            self._search.drift.add_link(keyframe.link)
        for loop in loops:
            self._search.drift.add_loop(loop)
        self._search.waiting = edges_from_arrays("waiting", arrays)
        self._search.searched = float(arrays["searched"])
        self._join_segments(loops)

    def _join_segments(self, loops: Sequence[Edge]) -> None:
        for loop in loops:
            here, there = self.keyframes[loop.second].travel, self.keyframes[loop.first].travel
            if here - there > MIN_TIE_TRAVEL_M:
                self._tied_travel = max(self._tied_travel, here)
            segments = {self.keyframes[loop.first].segment, self.keyframes[loop.second].segment}
            if segments & self._joined:
                self._joined |= segments

    def _add_keyframe(self, scan: Scan, match: ScanMatch, relative: Floats) -> None:
        here = len(self.keyframes)
        broken = match.kind == "broken"
        self._segment += broken
        extra = GUIDED_COVARIANCE if match.guided else LINK_COVARIANCE
        covariance = extra + turned(match.covariance, -float(match.pose[2]))
        doubtful = match.kind in ("odometry", "broken")
        link = Edge(self._anchor[0], here, relative if here else match.pose, covariance, doubtful)
        self.keyframes.append(Keyframe(scan.points, scan.free, link, self._travel, self._segment))
        self._ground.add(self.keyframes[-1])
        self._poses.append(compose(self._poses[link.first], relative) if here else match.pose)
        self._anchor = (here, match.pose)
        self._front.keep(scan, alone=broken)


def _graph_of(keyframes: Sequence[Keyframe], poses: Floats, loops: Sequence[Edge]) -> Graph:
    """Return the settled graph of keyframes whose `poses` are about right."""
    graph = Graph()
    graph.extend([keyframe.link for keyframe in keyframes], poses)
    settled = not loops or graph.close(loops, known=True)
    while not settled:
        settled = graph.settle()
    return graph


class KnownGround:
    """Finds keyframes by place. Corrections move them, so their poses are given to each call."""

    def __init__(self) -> None:
        self._travel: Floats = np.empty(0)
        self._segments: NDArray[np.int64] = np.empty(0, np.int64)

    def add(self, keyframe: Keyframe) -> None:
        """Add the next keyframe of the map."""
        self._travel = np.append(self._travel, keyframe.travel)
        self._segments = np.append(self._segments, keyframe.segment)

    def keyframes_near(
        self, pose: Floats, travel: float, poses: Floats, joined: set[int]
    ) -> list[int]:
        """Return the keyframes that show the ground round `pose` (3,), the nearest last.

        Only passes before `travel` [m] count, in segments that are `joined` to the map. The list is
        empty after fewer than MIN_PASSES of them.
        """
        earlier = np.flatnonzero(travel - self._travel > PASS_TRAVEL_M)
        away = np.hypot(*(poses[earlier, :2] - pose[:2]).T)
        around = away < SIGHT_M
        around &= np.isin(self._segments[earlier], list(joined))
        ids, away = earlier[around], away[around]
        if self._count_passes(ids[away < NEAR_M]) < MIN_PASSES:
            return []
        return _newest_by_place(ids, poses[ids], pose)

    def _count_passes(self, ids: NDArray[np.intp]) -> int:
        """Return the number of passes by these keyframes, which are in order of travel."""
        passes, last = 0, -np.inf
        for travel in self._travel[ids].tolist():
            if travel - last > PASS_TRAVEL_M:
                passes, last = passes + 1, travel
        return passes


def _newest_by_place(ids: NDArray[np.intp], poses: Floats, pose: Floats) -> list[int]:
    """Return the newest keyframe of each place and direction, only the nearest, farthest first."""
    places = np.floor(poses / (SQUARE_M, SQUARE_M, SECTOR_RAD))
    _, newest = np.unique(places[::-1], axis=0, return_index=True)
    ids, poses = ids[::-1][newest], poses[::-1][newest]
    offsets = poses - pose
    far = np.hypot(offsets[:, 0], offsets[:, 1]) + TURN_COST_M * np.abs(wrap(offsets[:, 2]))
    order = np.lexsort((ids, far))[:MAX_CANDIDATES]
    return [int(k) for k in ids[order[::-1]]]
