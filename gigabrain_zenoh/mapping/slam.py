"""SLAM: front end, pose graph and loop closure together.

`add` is the work per scan. `close_loops` may run in another thread meanwhile; its result moves
nothing until `apply`. On ground that earlier passes mapped, scans are matched to existing
keyframes, so that a map grows with the ground and not with the time driven.
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

LINK = np.diag((0.05, 0.05, 0.01)) ** 2  # covariance of a link beside that of its match,
GUIDED = np.diag((0.02, 0.02, 0.005)) ** 2  # and where odometry was known to be good
TIED = 4.0  # [m] of travel since a loop, so long the way is known to lie right on earlier ones
DRIFTED = np.diag((0.05, 0.05, 0.02)) ** 2  # covariance of that
AGAIN = 12.0  # [m] of travel between the ends of a loop that ties the way to an earlier one

TRAVEL = 12.0  # [m] since, or it is the same pass
NEAR = 0.75  # [m], keyframes so near are of this place
PASSES = 2  # over a place, from then on it is known
REACH = 3.0  # [m], keyframes farther off show other places
SQUARE, SECTOR = 0.4, np.pi / 2  # [m] and [rad]: of keyframes seen from one place one is enough
TURNED = 0.5  # [m] that a keyframe may be farther off, for each rad that it is less turned away
MAX_CANDIDATES = 16  # keyframes


@dataclass(frozen=True, slots=True)
class Estimate:
    """Pose of the robot at a scan."""

    pose: Floats  # in the map as it is now
    covariance: Floats  # (3, 3), of x, y and yaw in the map, against what is mapped round the robot
    keyframe: int  # the keyframe that this hangs on: a correction moves both
    relative: Floats  # the pose in that keyframe's frame
    kind: Kind  # how it was found, see ScanMatch
    score: float  # 0 to 1, how well the scan fits
    kept: bool  # the scan has become a keyframe
    lost: bool  # the sequence broke, and nothing has joined the parts since


@dataclass(frozen=True, slots=True)
class Correction:
    """Corrected poses of the first keyframes, after loops were closed."""

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
        self._anchor = (0, pose)  # a keyframe, and where the front end has it
        self._poses: list[Floats] = []
        self._segment = 0
        self._joined = {0}  # segments that loops have joined to the first
        self._travel = 0.0
        self._tied = -np.inf  # [m] of travel, where the way lay right on earlier ones last
        self._known = False  # whether scans are laid onto earlier keyframes alone
        self._smooth: Floats = IDENTITY  # the front end's frame, in the one that never jumps
        self._ground = KnownGround()
        self._shown: dict[int, Scan] = {}  # keyframes of known ground; their normals take long
        self._graph = Graph()
        self._rates = rates or DriftRates()
        self._search = LoopSearch(self._rates)
        self._closing: tuple[Edge, ...] = ()  # loops that the graph has not settled with
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
        """The robot's pose at the last scan in the present map. Needs a keyframe."""
        keyframe, placed = self._anchor
        return compose(self._poses[keyframe], between(placed, self._front.pose))

    @property
    def smooth(self) -> Floats:
        """The robot's pose in a frame that drifts and never jumps."""
        return compose(self._smooth, self._front.pose)

    def add(self, scan: Scan, delta: Floats, noise: Floats | None = None) -> Estimate:
        """Add a scan after odometry has moved by `delta` (x, y, yaw).

        `noise` (3, 3) is the covariance of `delta` in its own frame. Without it odometry is assumed
        to be bad, and counts little where there is anything to match.
        """
        if not np.isfinite(delta).all():
            raise ValueError(f"odometry: expected finite numbers, got {delta}")
        self._travel += float(np.hypot(delta[0], delta[1]))
        match, far = self._front.add(scan, delta, noise)
        known = self._familiar(scan, match) if far else None
        match, kept = known or match, far and known is None
        keyframe, placed = self._anchor
        relative = between(placed, match.pose)
        if kept:
            self._keep(scan, match, relative)
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
        self._hang_on(nearest, poses, smooth)

    def _hang_on(self, keyframe: int, poses: Floats, smooth: Floats) -> None:
        """Go on in the map's frame from an earlier keyframe, the robot being at `smooth`."""
        self._anchor = (keyframe, poses[keyframe])
        self._segment = self.keyframes[keyframe].segment
        self._tied = self._travel
        self._smooth = compose(smooth, inverse(self._front.pose))

    def _familiar(self, scan: Scan, match: ScanMatch) -> ScanMatch | None:
        """Lay the scan onto the keyframes of known ground, and match to those from now on.

        Return None where the ground is not known, or shows something else.
        """
        known, self._known = self._known, False
        if match.kind != "matched" or self._travel - self._tied > TIED:
            return None
        keyframe, placed = self._anchor
        poses, smooth = self.poses, self.smooth
        pose = compose(poses[keyframe], between(placed, match.pose))
        ids = self._ground.round(pose, self._travel, poses, self._joined)
        if not ids:
            return None
        covariance = turned(match.covariance, float(pose[2] - match.pose[2]))
        about = replace(match, pose=pose, covariance=covariance + (0.0 if known else DRIFTED))
        self._shown = {k: self._shown.get(k) or self.keyframes[k].scan for k in ids}
        found = self._front.settle(scan, list(self._shown.values()), list(poses[ids]), about)
        if found:
            self._known = True
            self._hang_on(ids[-1], poses, smooth)
        return found

    def close_loops(self) -> Correction | None:
        """Take in the next keyframe and look for a loop from it, or go on closing what was found.

        None when that corrects nothing. Call it until `behind` is 0; one thread at a time, any.
        """
        if self._closing:
            return self._closed(self._graph.settle())
        here = len(self._graph.poses)
        if here == len(self.keyframes):
            return None
        keyframes = self.keyframes[: here + 1]
        link = keyframes[here].link
        self._graph.extend([link])
        self._search.drift.linked(link)
        if self._graph.failure:
            return None
        loops = self._search.find(keyframes, self._graph.poses)
        if not loops:
            return None
        self._closing = tuple(loops)
        return self._closed(self._graph.close(loops))

    def _closed(self, settled: bool) -> Correction | None:
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
        """Move the keyframes to where `close_loops` has found them to be."""
        done = len(correction.poses)
        self._poses = list(correction.poses)
        for keyframe in self.keyframes[done:]:
            link = keyframe.link
            self._poses.append(compose(self._poses[link.first], link.relative))
        self._join(correction.loops)
        self.revision += 1

    def still(self) -> "Slam":
        """Return a copy for `freeze`. Not while `close_loops` runs."""
        held = copy.copy(self)
        held.keyframes, held._poses = list(self.keyframes), list(self._poses)
        held._front, held._graph = copy.copy(self._front), copy.copy(self._graph)
        held._search = copy.copy(self._search)
        held._search.waiting = list(self._search.waiting)
        return held

    def freeze(self) -> dict[str, NDArray[np.generic]]:
        """Return the state as arrays, to be saved. Not while `close_loops` runs."""
        held = {id(keyframe.points): k for k, keyframe in enumerate(self.keyframes)}
        scans, placed = self._front.held
        return {
            **keyframes_to_arrays(self.keyframes),
            **edges_to_arrays("loop", self._graph.loops),
            **edges_to_arrays("waiting", self._search.waiting),
            "poses": self.poses,
            "behind": np.array(len(self.keyframes) - len(self._graph.poses)),
            "searched": np.array(self._search.searched),
            "driven": np.array(self._travel),
            "local": np.array([held[id(scan.points)] for scan in scans], np.int32),
            "local_poses": np.array(placed).reshape(-1, 3),
            "front": self._front.pose,
            "anchor": np.array(self._anchor[0]),
            "anchor_pose": self._anchor[1],
        }

    @classmethod
    def thaw(
        cls, arrays: Arrays, spacing: KeyframePolicy | None = None, rates: DriftRates | None = None
    ) -> "Slam":
        """Go on from what was frozen; KeyError or ValueError if it does not belong together."""
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
            self._search.drift.linked(keyframe.link)
        for loop in loops:
            self._search.drift.closed(loop)
        self._search.waiting = edges_from_arrays("waiting", arrays)
        self._search.searched = float(arrays["searched"])
        self._join(loops)

    def _join(self, loops: Sequence[Edge]) -> None:
        for loop in loops:
            here, there = self.keyframes[loop.second].travel, self.keyframes[loop.first].travel
            if here - there > AGAIN:
                self._tied = max(self._tied, here)
            ends = {self.keyframes[loop.first].segment, self.keyframes[loop.second].segment}
            if ends & self._joined:
                self._joined |= ends

    def _keep(self, scan: Scan, match: ScanMatch, relative: Floats) -> None:
        here = len(self.keyframes)
        broken = match.kind == "broken"
        self._segment += broken
        beside = GUIDED if match.guided else LINK
        covariance = beside + turned(match.covariance, -float(match.pose[2]))
        doubtful = match.kind in ("odometry", "broken")
        link = Edge(self._anchor[0], here, relative if here else match.pose, covariance, doubtful)
        self.keyframes.append(Keyframe(scan.points, scan.free, link, self._travel, self._segment))
        self._ground.add(self.keyframes[-1])
        self._poses.append(compose(self._poses[link.first], relative) if here else match.pose)
        self._anchor = (here, match.pose)
        self._front.keep(scan, alone=broken)


def _graph_of(keyframes: Sequence[Keyframe], poses: Floats, loops: Sequence[Edge]) -> Graph:
    """Return the graph of keyframes that are about where they belong."""
    graph = Graph()
    graph.extend([keyframe.link for keyframe in keyframes], poses)
    settled = not loops or graph.close(loops, known=True)
    while not settled:
        settled = graph.settle()
    return graph


class KnownGround:
    """Keyframes by place. Corrections move them, so each call takes their poses."""

    def __init__(self) -> None:
        self._travel: Floats = np.empty(0)
        self._segments: NDArray[np.int64] = np.empty(0, np.int64)

    def add(self, keyframe: Keyframe) -> None:
        """Add the next keyframe of the map."""
        self._travel = np.append(self._travel, keyframe.travel)
        self._segments = np.append(self._segments, keyframe.segment)

    def round(self, pose: Floats, travel: float, poses: Floats, joined: set[int]) -> list[int]:
        """Return the keyframes that show the ground round `pose` (3,), the nearest last.

        Earlier passes count only, after `travel` [m] now, and segments that are joined to the map.
        Nothing is returned where there were fewer than PASSES of them.
        """
        earlier = np.flatnonzero(travel - self._travel > TRAVEL)
        away = np.hypot(*(poses[earlier, :2] - pose[:2]).T)
        around = away < REACH
        around &= np.isin(self._segments[earlier], list(joined))
        ids, away = earlier[around], away[around]
        if self._passes(ids[away < NEAR]) < PASSES:
            return []
        return _chosen(ids, poses[ids], pose)

    def _passes(self, ids: NDArray[np.intp]) -> int:
        """Return how often the robot has come by these keyframes, which are in their order."""
        passes, last = 0, -np.inf
        for travel in self._travel[ids].tolist():
            if travel - last > TRAVEL:
                passes, last = passes + 1, travel
        return passes


def _chosen(ids: NDArray[np.intp], poses: Floats, pose: Floats) -> list[int]:
    """Return the newest keyframe of each place and direction; of those the nearest ones."""
    places = np.floor(poses / (SQUARE, SQUARE, SECTOR))
    _, newest = np.unique(places[::-1], axis=0, return_index=True)
    ids, poses = ids[::-1][newest], poses[::-1][newest]
    off = poses - pose
    far = np.hypot(off[:, 0], off[:, 1]) + TURNED * np.abs(wrap(off[:, 2]))
    order = np.lexsort((ids, far))[:MAX_CANDIDATES]
    return [int(k) for k in ids[order[::-1]]]
