"""How far two keyframes may have drifted apart, and which loops that rules out.

Drift is summed along the least uncertain way from one to the other, over links and loops. That is
an upper bound of what the whole graph knows, and it tells an aisle from the next one like it.
"""

import heapq
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from gigabrain_zenoh.geometry.se2 import Floats, between
from gigabrain_zenoh.mapping.keyframe import Edge

JOINT = 0.03  # [m] and [rad], of every loop
GATE = 16.3  # 99.9 % of chi-square with three degrees of freedom


@dataclass(frozen=True, slots=True)
class Rates:
    """How fast matched scans may drift at most."""

    away: float = 0.05  # [m] per square root of a metre driven
    turn: float = 0.01  # [rad] per square root of a metre driven


class Drift:
    """The ways between keyframes, with the variance of yaw [rad²] and of place [m²] on each."""

    def __init__(self, rates: Rates) -> None:
        self._rates = rates
        self._ways: dict[int, list[tuple[int, float, float]]] = defaultdict(list)

    def linked(self, link: Edge) -> None:
        """Add the link of a keyframe, unless it is the first."""
        if link.first == link.second:
            return
        if link.doubtful:
            away = float(link.covariance[:2, :2].trace()) / 2
            self._add(link, float(link.covariance[2, 2]), away)
        else:
            driven = float(np.hypot(*link.relative[:2]))
            self._add(link, self._rates.turn**2 * driven, self._rates.away**2 * driven)

    def closed(self, loop: Edge) -> None:
        """Add a loop that is beyond doubt."""
        self._add(loop, JOINT**2, JOINT**2)

    def _add(self, edge: Edge, turn: float, away: float) -> None:
        self._ways[edge.first].append((edge.second, turn, away))
        self._ways[edge.second].append((edge.first, turn, away))

    def explains(self, loop: Edge, poses: Floats) -> bool:
        """Whether drift may have brought about what closing `loop` would correct."""
        return explained(loop, poses, *self.between(loop.first, loop.second, poses))

    def between(self, first: int, second: int, poses: Floats) -> tuple[float, float]:
        """The variance of yaw and of place on the least uncertain way (Dijkstra)."""
        turn, away = self._spread(second, poses, first)
        if not np.isfinite(turn[first]):
            raise ValueError(f"no way from keyframe {first} to {second}")
        return float(turn[first]), float(away[first])

    def spread(self, to: int, poses: Floats) -> tuple[Floats, Floats]:
        """Return the variances of yaw and of place from each keyframe to one of them, (n,) each."""
        return self._spread(to, poses)

    def _spread(self, to: int, poses: Floats, only: int | None = None) -> tuple[Floats, Floats]:
        far = poses[:, :2] - poses[to, :2]
        levers = (far * far).sum(axis=1).tolist()  # a turn on the way moves what is far from it
        turns, aways = np.full(len(poses), np.inf), np.full(len(poses), np.inf)
        queue = [(JOINT**2, JOINT**2, to)]
        done = set()
        while queue:
            turn, away, at = heapq.heappop(queue)
            if at in done:
                continue
            done.add(at)
            turns[at], aways[at] = turn, away
            if at == only:
                break
            for by, more_turn, more_away in self._ways[at]:
                if by not in done:
                    moved = away + more_away + more_turn * levers[at]
                    heapq.heappush(queue, (turn + more_turn, moved, by))
        return turns, aways


def explained(loop: Edge, poses: Floats, turn: float, away: float) -> bool:
    """Return whether drift of these variances may have brought about what the loop corrects."""
    x, y, yaw = between(between(poses[loop.first], poses[loop.second]), loop.relative)
    return bool((x * x + y * y) / away + yaw * yaw / turn < GATE)
