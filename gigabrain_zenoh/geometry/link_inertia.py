"""Mass, centre and inertia of links, from their primitive shapes, as MuJoCo computes them."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.sim import ShapeKind

DENSITY = 1000.0  # [kg/m3], MuJoCo's default for a shape without mass and density


class Inertial(NamedTuple):
    """Mass and inertia of a part."""

    mass: float  # [kg]
    centre: Floats  # (3,) [m], of mass
    tensor: Floats  # (3, 3) [kg m2], about the centre, along the frame's axes


def volume(kind: ShapeKind, size: Sequence[float]) -> float:
    """Return the volume of a shape [m3]. Sizes are as in `link_model.Shape`."""
    a, b, c = size
    ball = 4 / 3 * math.pi * a**3
    tube = 2 * b * math.pi * a**2
    found = {
        "box": 8 * a * b * c, "ellipsoid": 4 / 3 * math.pi * a * b * c,
        "sphere": ball, "cylinder": tube, "capsule": tube + ball,
    }  # fmt: skip
    return found[kind]


def moments(kind: ShapeKind, size: Sequence[float], mass: float) -> Floats:
    """Return the principal moments (3,) [kg m2] of a shape about its centre."""
    a, b, c = size
    if kind in ("box", "ellipsoid"):
        sides = np.square((b, a, a)) + np.square((c, c, b))
        return np.asarray(mass / (3 if kind == "box" else 5) * sides)
    if kind == "sphere":
        return np.full(3, 0.4 * mass * a**2)
    ends = 0.0
    if kind == "capsule":  # a hemisphere at each end
        ends = mass * (4 / 3 * math.pi * a**3) / volume(kind, size)
    tube = mass - ends
    across = tube * (a**2 / 4 + b**2 / 3) + ends * (0.4 * a**2 + b**2 + 0.75 * a * b)
    return np.array([across, across, tube * a**2 / 2 + ends * 0.4 * a**2])


def turned(tensor: Floats, quaternion: Sequence[float]) -> Floats:
    """Return a tensor (3, 3), or moments (3,) as one, turned by a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    axes = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    full = np.diag(tensor) if tensor.ndim == 1 else tensor
    return np.asarray(axes @ full @ axes.T)


def combined(parts: Iterable[Inertial]) -> Inertial | None:
    """Return the inertia of rigidly connected parts; None if they have no mass."""
    massive = [part for part in parts if part.mass > 0]
    mass = sum(part.mass for part in massive)
    if not mass:
        return None
    centre = sum((part.mass * part.centre for part in massive), np.zeros(3)) / mass
    tensor = np.zeros((3, 3))
    for part in massive:
        off = part.centre - centre
        tensor += part.tensor + part.mass * ((off @ off) * np.eye(3) - np.outer(off, off))
    return Inertial(mass, centre, tensor)
