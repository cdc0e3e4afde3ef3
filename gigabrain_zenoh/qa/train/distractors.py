"""Things without a label: furniture, boards, poles, bottles, plants. None looks like a class."""

import math

import numpy as np

from gigabrain_zenoh.qa.train.looks import ALONG_Y, Geom, Look, Random, about, rod


def hull(points: list[tuple[float, float, float]], paint: str = "body") -> Geom:
    """Return the convex hull of points [m] as a part."""
    return Geom("hull", tuple(float(v) for p in points for v in p), (0, 0, 0), paint=paint)


def frustum(
    low: float, high: float, z0: float, z1: float, paint: str = "body", n: int = 20
) -> Geom:
    """Return a cone or bucket: radius `low` at z0, `high` at z1 [m]."""
    turns = [2 * math.pi * k / n for k in range(n)]
    rings = [
        (r * math.cos(a), r * math.sin(a), z) for r, z in ((low, z0), (high, z1)) for a in turns
    ]
    return hull(rings, paint)


def board(rng: Random) -> Look:
    """A thin board on edge with three to five slanted sides: not a rectangle like a box's face."""
    w, h, thin = rng.uniform(0.06, 0.2), rng.uniform(0.1, 0.5), rng.uniform(0.005, 0.02)
    tops = [(rng.uniform(-0.7, 0.7), 1.0)]
    tops += [(side * rng.uniform(0.6, 1.2), rng.uniform(0.3, 0.8)) for side in (-1, 1)]
    outline = [(-rng.uniform(0.3, 0.9), 0.0), (rng.uniform(0.3, 0.9), 0.0), *tops]
    corners = [(x, w * u, h * v) for u, v in outline for x in (-thin, thin)]
    return Look("", (hull(corners),), 0.12, h, hides=0.6 * w)


def pole(rng: Random) -> Look:
    """A thin post, often with a foot."""
    r, h = rng.uniform(0.01, 0.03), rng.uniform(0.4, 1.0)
    parts = [Geom("cylinder", (r, h), (0, 0, h), shine=0.6)]
    if rng.random() < 0.6:
        parts += [Geom("cylinder", (r * 5, 0.01), (0, 0, 0.01), paint="foot")]
    return Look("", tuple(parts), 0.08, 2 * h, hides=r)


def cone(rng: Random) -> Look:
    """A traffic cone on a plate, with a band."""
    r, h = rng.uniform(0.06, 0.17), rng.uniform(0.2, 0.6)
    parts = [frustum(r, 0.15 * r, 0, h), Geom("box", (r * 1.25, r * 1.25, 0.01), (0, 0, 0.01))]
    parts += [frustum(0.68 * r, 0.5 * r, 0.4 * h, 0.6 * h, "band")]
    return Look("", tuple(parts), r * 1.4, h)


def wedge(rng: Random) -> Look:
    """A prism, seen from its triangular end: from its side it looks like a box."""
    x, y, z = rng.uniform(0.08, 0.3), rng.uniform(0.08, 0.3), rng.uniform(0.06, 0.3)
    ridge = rng.uniform(-y, y)
    points = [(sx * x, sy * y, 0.0) for sx in (-1, 1) for sy in (-1, 1)]
    points += [(-x, ridge, z), (x, ridge, z)]
    return Look("", (hull(points),), math.hypot(x, y), z, hides=y, facing=0.6)


def egg(rng: Random) -> Look:
    """An ellipsoid, upright or flat enough not to look like a ball from any side."""
    r, ratio = rng.uniform(0.03, 0.1), rng.uniform(1.7, 3.0)
    size = (r * ratio, r * ratio, r) if rng.random() < 0.4 else (r, r, r * ratio)
    return Look("", (Geom("ellipsoid", size, (0, 0, size[2])),), max(size), 2 * size[2])


def sausage(rng: Random) -> Look:
    """A capsule on the floor, seen from its side: from its end it looks like a ball."""
    r, half = rng.uniform(0.03, 0.08), rng.uniform(0.1, 0.3)
    parts = (Geom("capsule", (r, half), (0, 0, r), ALONG_Y),)
    return Look("", parts, half + r, 2 * r, facing=0.7)


def bottle(rng: Random) -> Look:
    """A bottle with shoulders, neck and cap."""
    r, h = rng.uniform(0.03, 0.05), rng.uniform(0.18, 0.32)
    parts = (
        Geom("cylinder", (r, h * 0.3), (0, 0, h * 0.3), shine=0.8),
        frustum(r, r * 0.35, h * 0.6, h * 0.75),
        Geom("cylinder", (r * 0.35, h * 0.12), (0, 0, h * 0.87), shine=0.8),
        Geom("cylinder", (r * 0.42, h * 0.03), (0, 0, h * 0.98), paint="cap"),
    )
    return Look("", parts, r, h)


def bucket(rng: Random) -> Look:
    """A pot or bucket, wider above; with leaves it is a plant."""
    r, h = rng.uniform(0.06, 0.16), rng.uniform(0.12, 0.3)
    parts = [frustum(r * 0.65, r, 0, h)]
    if rng.random() < 0.7:
        for _ in range(int(rng.integers(6, 14))):
            a, up = rng.uniform(0, 2 * math.pi), rng.uniform(0.3, 1.4)
            length = rng.uniform(0.08, 0.25)
            turn = about((-math.sin(a), math.cos(a), 0.0), math.pi / 2 - up)
            at = (math.cos(a) * math.cos(up) * length, math.sin(a) * math.cos(up) * length)
            parts += [
                Geom(
                    "ellipsoid",
                    (0.03, 0.012, length),
                    (*at, h + math.sin(up) * length),
                    turn,
                    "leaf",
                )
            ]
    return Look("", tuple(parts), r, h)


def table(rng: Random) -> Look:
    """A table or bench on four legs; small things may stand on it."""
    x, y, h = rng.uniform(0.25, 0.5), rng.uniform(0.25, 0.6), rng.uniform(0.25, 0.75)
    parts = [Geom("box", (x, y, 0.015), (0, 0, h - 0.015))]
    for sx, sy in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        a = (sx * (x - 0.03), sy * (y - 0.03), 0.0)
        parts += [rod(a, (a[0], a[1], h - 0.03), 0.018, "legs", "cylinder")]
    return Look("", tuple(parts), math.hypot(x, y), h)


def chair(rng: Random) -> Look:
    """A chair with a back."""
    w, h = rng.uniform(0.18, 0.24), rng.uniform(0.38, 0.48)
    parts = [Geom("box", (w, w, 0.015), (0, 0, h))]
    for sx, sy in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        top = h if sx > 0 else 2 * h
        a = (sx * (w - 0.02), sy * (w - 0.02), 0.0)
        parts += [rod(a, (a[0], a[1], top), 0.014, "legs", "cylinder")]
    parts += [Geom("box", (0.01, w, h * 0.2), (-w + 0.02, 0, 1.75 * h))]
    return Look("", tuple(parts), w * 1.4, h)


def shelf(rng: Random) -> Look:
    """Open shelves between two sides."""
    w, h, d = rng.uniform(0.2, 0.5), rng.uniform(0.3, 0.9), rng.uniform(0.1, 0.18)
    parts = [Geom("box", (d, 0.01, h), (0, s * w, h)) for s in (-1, 1)]
    rows = int(rng.integers(2, 5))
    parts += [
        Geom("box", (d, w, 0.01), (0, 0, 0.02 + (2 * h - 0.03) * k / rows)) for k in range(rows + 1)
    ]
    return Look("", tuple(parts), math.hypot(w, d), 2 * h)


def picture(rng: Random) -> Look:
    """A framed picture or a window on a wall."""
    w, h, up = rng.uniform(0.15, 0.5), rng.uniform(0.15, 0.5), rng.uniform(0.6, 1.7)
    parts = (
        Geom("box", (0.01, w, h), (0, 0, up), paint="frame"),
        Geom("box", (0.012, w * 0.88, h * 0.88), (0, 0, up), paint="body"),
    )
    return Look("", parts, 0.05, up + h)


OCCLUDERS = (board, board, pole, cone, wedge, bottle, bucket, egg, sausage, chair)
FURNITURE = (table, table, chair, shelf, picture)


def draw_all(rng: Random) -> list[Look]:
    """Draw the distractors of one studio."""
    return [maker(rng) for maker in (*OCCLUDERS, *FURNITURE)]


def is_table(look: Look) -> bool:
    """Return whether things can stand on it."""
    return (
        not look.label
        and len(look.parts) == 5
        and look.parts[0].kind == "box"
        and bool(np.isclose(look.parts[0].at[2], look.height - 0.015))
    )
