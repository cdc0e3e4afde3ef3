"""Things that nobody has seen whole yet: arcs beside what hides them, as discs of a known size."""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.perception.obstacles.arc import on_rim, place_of

Floats = NDArray[np.float64]
Place = tuple[float, float, float]

GAP_M = 0.2  # between hits; a wider one ends an arc
FEWEST = 8  # hits of an arc
LONGEST = 2.0  # radii; what is longer is a wall
BEHIND = 0.7  # radii, so far behind the middle of its hits the middle of a disc may be
MOST_NOISE_M = 0.08  # standard deviation of its place
ON_RIM = 0.9  # share of the hits


def discs_of(points: Floats, eye: tuple[float, float], radius: float) -> list[Place]:
    """Discs of this `radius` [m] that arcs of the `points` (n, 2) belong to, as seen from `eye`.

    The points are in the order of their beams. Each disc: its middle (x, y) [m] and the standard
    deviation of that.
    """
    if len(points) < FEWEST:
        return []
    apart = np.hypot(*np.diff(points, axis=0).T)
    arcs = np.split(points, np.flatnonzero(apart > GAP_M) + 1)
    found = (_disc(arc, eye, radius) for arc in arcs)
    return [place for place in found if place]


def _disc(arc: Floats, eye: tuple[float, float], radius: float) -> Place | None:
    """The disc that an arc belongs to, if there is one."""
    if len(arc) < FEWEST or np.hypot(*(arc[-1] - arc[0])) > LONGEST * radius:
        return None
    middle = arc.mean(axis=0)
    away = middle - eye
    ray = away / np.hypot(*away)
    begin_x, begin_y = (middle + BEHIND * radius * ray).tolist()
    place = place_of(arc, begin_x, begin_y, radius)
    if place is None or place[2] > MOST_NOISE_M:
        return None
    x, y, _ = place
    faces = float((np.array((x, y)) - middle) @ ray) > 0.0
    return place if faces and on_rim(arc, x, y, radius).mean() > ON_RIM else None
