"""Groups of cells and their outlines: polygons that are nearly convex."""

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats

LINK_M = 0.05  # cells of this size that touch belong together
DIRECTIONS = 16  # of an outline's corners; those of boxes are always among them
SPLIT_ROUNDS = 6
SAME_M = 1e-6  # largest distance of equal corners
HOLLOW_M = 0.07  # largest distance of an outline from its cells, along a part of an edge
AROUND_M = 0.4  # a viewer this near to an outline, or in it, sees all of its edges
EDGE_M, EDGE_PARTS = 0.15, 8  # least length of checked edges, and their number of parts
Labels = NDArray[np.intp]
_angles = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
AXES: Floats = np.stack((np.cos(_angles), np.sin(_angles)))


def connected(places: Floats, link: float = LINK_M) -> Labels:
    """Return the number of the group of each place (n, 2) [m]; groups are `link` [m] apart."""
    if not len(places):
        return np.empty(0, np.intp)
    index = np.floor(places / link).astype(np.int64)
    index -= index.min(axis=0)
    width = int(index[:, 1].max()) + 3
    flat = (index[:, 0] + 1) * width + index[:, 1] + 1
    used, of_place = np.unique(flat, return_inverse=True)
    begins, ends = [], []
    for step in (1, width - 1, width, width + 1):
        at = np.minimum(np.searchsorted(used, used + step), len(used) - 1)
        linked = np.flatnonzero(used[at] == used + step)
        begins.append(linked)
        ends.append(at[linked])
    labels = _joined(len(used), np.concatenate(begins), np.concatenate(ends))
    _, numbers = np.unique(labels, return_inverse=True)
    return np.asarray(numbers[of_place], np.intp)


def _joined(count: int, begin: Labels, end: Labels) -> Labels:
    """Return the least number that is linked with each of `count` numbers."""
    labels = np.arange(count)
    while True:
        least = np.minimum(labels[begin], labels[end])
        joined = labels.copy()
        np.minimum.at(joined, labels[begin], least)
        np.minimum.at(joined, labels[end], least)
        joined = joined[joined]
        if np.array_equal(joined, labels):
            return labels
        labels = joined


def split(low: Floats, high: Floats, labels: Labels, viewer: Floats) -> Labels:
    """Return finer groups of the boxes from `low` to `high` (n, 2), so that none is hollow.

    The space behind the boxes, seen from `viewer` (2,), is unknown. It may be in an outline, unless
    the outline is so near that the viewer may be in that space itself.
    """
    middle = (low + high) / 2
    labels = labels.copy()
    open_ = np.arange(len(labels))  # boxes of groups that may be hollow
    for _ in range(SPLIT_ROUNDS):
        order = open_[np.argsort(labels[open_], kind="stable")]
        first = np.flatnonzero(np.diff(labels[order], prepend=-1))
        outline = support_polygons(low[order], high[order], first)
        hollow = _hollow(middle[order], outline, first, viewer)
        if not hollow.any():
            break
        open_ = _halve(middle, labels, order, first, hollow)
    return labels


def _hollow(middle: Floats, outline: Floats, first: Labels, viewer: Floats) -> NDArray[np.bool_]:
    """Return groups with an edge towards `viewer` that is far from all their boxes.

    A viewer in an outline, as in the corner of two walls, may be where that edge cuts the corner.
    """
    group = np.repeat(np.arange(len(first)), np.diff(first, append=len(middle)))
    edge = np.roll(outline, -1, axis=1) - outline
    length = np.hypot(edge[..., 0], edge[..., 1])
    to_viewer = viewer - (outline + edge / 2)
    before = edge[..., 1] * to_viewer[..., 0] - edge[..., 0] * to_viewer[..., 1]
    beyond = np.where(length > 0.0, before / np.maximum(length, SAME_M), -np.inf).max(axis=1)
    facing = (before > 0.0) | (beyond < AROUND_M)[:, None]
    long = (length > EDGE_M) & facing
    box, side = np.nonzero(long[group])
    of = group[box]
    direction = edge[of, side] / length[of, side][:, None]
    off = middle[box] - outline[of, side]
    along = (off * direction).sum(axis=1) / length[of, side]
    inward = direction[:, 0] * off[:, 1] - direction[:, 1] * off[:, 0]
    part = np.clip((along * EDGE_PARTS).astype(np.intp), 0, EDGE_PARTS - 1)
    nearest = np.full((len(first), DIRECTIONS, EDGE_PARTS), np.inf)
    np.minimum.at(nearest, (of, side, part), inward)
    return np.asarray(np.any(np.isfinite(nearest) & (nearest > HOLLOW_M), axis=(1, 2)))


def _halve(
    middle: Floats, labels: Labels, order: Labels, first: Labels, hollow: NDArray[np.bool_]
) -> Labels:
    """Split hollow groups across their longer axis, where they bend; return their boxes."""
    ends = np.append(first[1:], len(order))
    fresh = int(labels.max()) + 1
    touched = []
    for group in np.flatnonzero(hollow):
        members = order[first[group] : ends[group]]
        centred = middle[members] - middle[members].mean(axis=0)
        _, axes = np.linalg.eigh(centred.T @ centred)
        along, across = centred @ axes[:, 1], centred @ axes[:, 0]
        cut = along[np.argmax(np.abs(across))]
        span = float(np.ptp(along))
        if min(cut - along.min(), along.max() - cut) < span / 8:
            cut = 0.0
        labels[members[along > cut]] = fresh
        fresh += 1
        touched.append(members)
    return np.concatenate(touched)


def support_polygons(low: Floats, high: Floats, first: Labels) -> Floats:
    """Return outlines (groups, DIRECTIONS, 2) of boxes from `low` to `high` (n, 2), in groups.

    `first` is where each group begins. The corners are the outermost ones in as many directions,
    counter-clockwise; some of them are the same.
    """
    size = np.diff(first, append=len(low))
    x = np.where(AXES[0][:, None] >= 0.0, high[:, 0], low[:, 0])  # (DIRECTIONS, n)
    y = np.where(AXES[1][:, None] >= 0.0, high[:, 1], low[:, 1])
    reach = AXES[0][:, None] * x + AXES[1][:, None] * y
    outermost = np.repeat(np.maximum.reduceat(reach, first, axis=1), size, axis=1)
    number = np.where(reach == outermost, np.arange(len(low)), len(low))
    at = np.minimum.reduceat(number, first, axis=1)
    corners = np.stack((np.take_along_axis(x, at, axis=1), np.take_along_axis(y, at, axis=1)))
    return np.asarray(corners.transpose(2, 1, 0))


def distinct(outline: Floats) -> list[tuple[float, float]]:
    """Return the corners of an outline (n, 2) without those that repeat."""
    moves = np.abs(outline - np.roll(outline, 1, axis=0)).max(axis=1) > SAME_M
    return [(x, y) for x, y in outline[moves].tolist()]
