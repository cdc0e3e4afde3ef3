"""A map's keyframes and loops as arrays, to be saved, and back."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.mapping.keyframe import Edge, Keyframe
from gigabrain_zenoh.mapping.points import Points, pairs

Arrays = Mapping[str, NDArray[np.generic]]

REACH_M = 200.0  # of a beam: what it passes is drawn cell by cell


def freeze_keyframes(keyframes: Sequence[Keyframe]) -> dict[str, NDArray[np.generic]]:
    """All of the keyframes."""
    return {
        **freeze_edges("link", [keyframe.link for keyframe in keyframes]),
        "travel": np.array([keyframe.travel for keyframe in keyframes]),
        "segment": np.array([keyframe.segment for keyframe in keyframes], np.int32),
        "points": _joined(keyframe.points for keyframe in keyframes),
        "points_each": np.array([len(keyframe.points) for keyframe in keyframes], np.int32),
        "free": _joined(keyframe.free for keyframe in keyframes),
        "free_each": np.array([len(keyframe.free) for keyframe in keyframes], np.int32),
    }


def thaw_keyframes(arrays: Arrays) -> list[Keyframe]:
    """The keyframes again; KeyError or ValueError if the arrays do not belong together."""
    links = thaw_edges("link", arrays)
    points = split(arrays["points"], arrays["points_each"])
    free = split(arrays["free"], arrays["free_each"])
    rows = zip(links, points, free, arrays["travel"], arrays["segment"], strict=True)
    return [
        Keyframe(pairs("points", hits), pairs("free", ends), link, float(travel), int(segment))
        for link, hits, ends, travel, segment in rows
    ]


def freeze_edges(name: str, edges: Sequence[Edge]) -> dict[str, NDArray[np.generic]]:
    """The edges as three arrays whose names begin with `name`."""
    return {
        f"{name}_ends": np.array([(e.first, e.second) for e in edges], np.int32).reshape(-1, 2),
        f"{name}_relative": np.array([e.relative for e in edges]).reshape(-1, 3),
        f"{name}_covariance": np.array([e.covariance for e in edges]).reshape(-1, 3, 3),
        f"{name}_doubtful": np.array([e.doubtful for e in edges], np.bool_),
    }


def thaw_edges(name: str, arrays: Arrays) -> list[Edge]:
    """The edges again."""
    ends = arrays[f"{name}_ends"].astype(int)
    relative = arrays[f"{name}_relative"].astype(np.float64)
    covariance = arrays[f"{name}_covariance"].astype(np.float64)
    keyframes = len(arrays["link_ends"])
    if ends.ndim != 2 or relative.shape != (len(ends), 3) or covariance.shape != (len(ends), 3, 3):
        raise ValueError(f"{name}: {len(ends)} edges, but {len(relative)} poses")
    if not ((ends >= 0) & (ends < keyframes)).all():
        raise ValueError(f"{name}: joins keyframes that there are not, of {keyframes}")
    if not (np.linalg.eigvalsh(covariance) > 0).all():
        raise ValueError(f"{name}: a covariance that is none")
    rows = zip(ends, relative, covariance, arrays[f"{name}_doubtful"], strict=True)
    return [Edge(int(first), int(second), r, c, bool(d)) for (first, second), r, c, d in rows]


def shaped(arrays: Arrays, name: str, *shape: int) -> NDArray[np.float64]:
    """One of the arrays; KeyError without it, ValueError if it is of another shape."""
    values = arrays[name].astype(np.float64)
    if values.shape != shape:
        raise ValueError(f"{name} of shape {values.shape}, expected {shape}")
    return values


def _joined(parts: Iterable[Points]) -> Points:
    return np.concatenate([np.empty((0, 2), np.float32), *parts])


def split(rows: NDArray[np.generic], each: NDArray[np.generic]) -> list[Points]:
    """Points (n, 2) of all scans, scan by scan; ValueError for what no lidar has seen."""
    counts, points = each.astype(int), rows.astype(np.float32)
    if points.shape != (counts.sum(), 2) or (counts < 0).any():
        raise ValueError(f"expected {counts.sum()} points, got {points.shape}")
    if points.size and not -REACH_M <= points.min() <= points.max() <= REACH_M:
        raise ValueError(f"expected points within {REACH_M:g} m")
    return np.split(points, np.cumsum(counts)[:-1]) if len(counts) else []
