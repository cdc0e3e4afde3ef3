"""The scans that a map is drawn from, each hung on a keyframe, so that it moves with it."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.mapping.grid import Grid
from gigabrain_zenoh.mapping.localizer import View
from gigabrain_zenoh.mapping.points import Points
from gigabrain_zenoh.mapping.se2 import Floats, between, compose

APART_M, APART_RAD = 0.1, math.radians(10)  # nearer ones replace one another


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

    def __init__(self, kept: Iterable[Sweep] = ()) -> None:
        self._kept = list(kept)
        self._place: Floats | None = None  # in the map, of the newest that stays
        self._standing = False  # whether the last one gives way to the next

    def __len__(self) -> int:
        return len(self._kept)

    def all(self) -> list[Sweep]:
        """As they are now."""
        return list(self._kept)

    def add(self, view: View, keyframe: int, relative: Floats, pose: Floats) -> Sweep:
        """One more, seen from `pose` in the map; while the robot stands, the newest is enough."""
        sweep = Sweep(keyframe, relative, view.scan.points, view.scan.free, view.sensor)
        if self._standing:
            self._kept.pop()
        self._kept.append(sweep)
        self._standing = self._place is not None and not _apart(self._place, pose)
        if not self._standing:
            self._place = pose
        return sweep

    def freeze(self) -> dict[str, NDArray[Any]]:
        """All of them, in arrays."""
        empty = np.empty((0, 2), np.float32)
        return {
            "sweep_keyframes": np.array([one.keyframe for one in self._kept], np.int32),
            "sweep_relative": np.array([one.relative for one in self._kept]).reshape(-1, 3),
            "sweep_sensor": np.array([one.sensor for one in self._kept]).reshape(-1, 2),
            "sweep_hits": np.concatenate([empty, *(one.hits for one in self._kept)]),
            "sweep_hits_each": np.array([len(one.hits) for one in self._kept], np.int32),
            "sweep_free": np.concatenate([empty, *(one.free for one in self._kept)]),
            "sweep_free_each": np.array([len(one.free) for one in self._kept], np.int32),
        }

    @classmethod
    def thaw(cls, arrays: Mapping[str, NDArray[Any]], keyframes: int) -> "Sweeps":
        """What was frozen; KeyError or ValueError if the arrays do not belong together."""
        on = arrays["sweep_keyframes"].astype(int)
        relative = arrays["sweep_relative"].astype(np.float64)
        if len(on) and not 0 <= on.min() <= on.max() < keyframes:
            raise ValueError(f"a sweep hangs on keyframe {on.max()} of {keyframes}")
        sensor = arrays["sweep_sensor"].astype(np.float64)
        for name, values, columns in (("poses", relative, 3), ("sensors", sensor, 2)):
            if values.shape != (len(on), columns) or not np.isfinite(values).all():
                raise ValueError(f"{len(on)} sweeps, but {name} of shape {values.shape}")
        hits = _split(arrays["sweep_hits"], arrays["sweep_hits_each"])
        free = _split(arrays["sweep_free"], arrays["sweep_free_each"])
        rows = zip(on, relative, hits, free, sensor, strict=True)
        return cls(Sweep(int(k), r, h, f, s) for k, r, h, f, s in rows)


def _split(rows: NDArray[Any], each: NDArray[Any]) -> list[Points]:
    counts = each.astype(int)
    if rows.shape != (counts.sum(), 2) or (counts < 0).any() or not np.isfinite(rows).all():
        raise ValueError(f"expected {counts.sum()} points, got {rows.shape}")
    return np.split(rows.astype(np.float32), np.cumsum(counts)[:-1]) if len(counts) else []


def _apart(one: Floats, other: Floats) -> bool:
    x, y, yaw = between(one, other).tolist()
    return math.hypot(x, y) > APART_M or abs(yaw) > APART_RAD
