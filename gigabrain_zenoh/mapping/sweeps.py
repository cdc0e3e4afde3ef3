"""The scans that a map is drawn from, each hung on a keyframe, so that it moves with it.

Of those seen from one place only the newest stay, so there are as many as the ground has room for.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.se2 import Floats, between, compose
from gigabrain_zenoh.mapping.frozen import REACH_M, split
from gigabrain_zenoh.mapping.grid import Grid
from gigabrain_zenoh.mapping.localizer import View
from gigabrain_zenoh.mapping.points import Points

APART_M, APART_RAD = 0.1, math.radians(10)  # nearer ones replace one another
SQUARE_M, SECTOR_RAD = 0.5, math.pi / 2  # a place, and a direction in which it is looked from
NEWEST = 3  # sweeps that stay of each of them

Place = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Sweep:
    """One scan that was drawn."""

    keyframe: int  # on which it hangs
    relative: Floats  # (3,), of the body in that keyframe's frame
    hits: Points  # (n, 2), in the body's frame [m]
    free: Points  # (m, 2)
    sensor: Floats  # (2,), where the beams start

    def draw(self, into: Grid, keyframe: Floats) -> None:
        """Draw it, `keyframe` (3,) being in the map now."""
        pose = compose(keyframe, self.relative)
        beam = compose(pose, np.array((self.sensor[0], self.sensor[1], 0.0)))
        offset = self.sensor.astype(np.float32)
        into.draw(beam, self.hits - offset, self.free - offset)


class Sweeps:
    """All sweeps of a map, in the order in which they were seen."""

    def __init__(self) -> None:
        self._kept: dict[int, Sweep] = {}  # by their number
        self._at: dict[Place, list[int]] = defaultdict(list)  # numbers, the oldest first
        self._place: Floats | None = None  # in the map, of the newest that stays
        self._standing = False  # whether the last one gives way to the next
        self.seen = 0  # how many were added, but for those that gave way where the robot stood

    def __len__(self) -> int:
        return len(self._kept)

    def all(self) -> list[Sweep]:
        """As they are now."""
        return list(self._kept.values())

    def add(self, view: View, keyframe: int, relative: Floats, pose: Floats) -> Sweep:
        """One more, seen from `pose` in the map; while the robot stands, the newest is enough."""
        sweep = Sweep(keyframe, relative, view.scan.points, view.scan.free, view.sensor)
        if self._standing:
            self._kept.popitem()
            self._kept[self.seen] = sweep
        else:
            numbers = self._keep(sweep, pose)
            while len(numbers) > NEWEST:
                del self._kept[numbers.pop(0)]
        self._standing = self._place is not None and not _apart(self._place, pose)
        if not self._standing:
            self._place = pose
        return sweep

    def _keep(self, sweep: Sweep, pose: Floats) -> list[int]:
        """Keep the sweep, and return the numbers of all that were seen from the same place."""
        self.seen += 1
        self._kept[self.seen] = sweep
        x, y, yaw = (pose / (SQUARE_M, SQUARE_M, SECTOR_RAD)).tolist()
        numbers = self._at[math.floor(x), math.floor(y), math.floor(yaw)]
        numbers.append(self.seen)
        return numbers

    def still(self) -> "Sweeps":
        """A copy to be frozen, which stays as it is."""
        held = Sweeps()
        held._kept, held.seen = dict(self._kept), self.seen
        return held

    def freeze(self) -> dict[str, NDArray[Any]]:
        """All of them, in arrays."""
        empty, kept = np.empty((0, 2), np.float32), self.all()
        return {
            "sweep_keyframes": np.array([one.keyframe for one in kept], np.int32),
            "sweep_relative": np.array([one.relative for one in kept]).reshape(-1, 3),
            "sweep_sensor": np.array([one.sensor for one in kept]).reshape(-1, 2),
            "sweep_hits": np.concatenate([empty, *(one.hits for one in kept)]),
            "sweep_hits_each": np.array([len(one.hits) for one in kept], np.int32),
            "sweep_free": np.concatenate([empty, *(one.free for one in kept)]),
            "sweep_free_each": np.array([len(one.free) for one in kept], np.int32),
        }

    @classmethod
    def thaw(cls, arrays: Mapping[str, NDArray[Any]], poses: Floats) -> "Sweeps":
        """What was frozen, keyframes being at `poses` (n, 3) in the map.

        Raises KeyError or ValueError if the arrays do not belong together.
        """
        keyframes = len(poses)
        on = arrays["sweep_keyframes"].astype(int)
        relative = arrays["sweep_relative"].astype(np.float64)
        if len(on) and not 0 <= on.min() <= on.max() < keyframes:
            raise ValueError(f"a sweep hangs on keyframe {on.max()} of {keyframes}")
        sensor = arrays["sweep_sensor"].astype(np.float64)
        for name, values, columns in (("poses", relative, 3), ("sensors", sensor, 2)):
            near = np.abs(values) <= REACH_M
            if values.shape != (len(on), columns) or not near.all():
                raise ValueError(f"{len(on)} sweeps, but {name} of shape {values.shape}")
        hits = split(arrays["sweep_hits"], arrays["sweep_hits_each"])
        free = split(arrays["sweep_free"], arrays["sweep_free_each"])
        rows = zip(on, relative, hits, free, sensor, strict=True)
        thawed = cls()
        for keyframe, *rest in rows:
            sweep = Sweep(int(keyframe), *rest)
            thawed._keep(sweep, compose(poses[sweep.keyframe], sweep.relative))
        return thawed


def _apart(one: Floats, other: Floats) -> bool:
    x, y, yaw = between(one, other).tolist()
    return math.hypot(x, y) > APART_M or abs(yaw) > APART_RAD
