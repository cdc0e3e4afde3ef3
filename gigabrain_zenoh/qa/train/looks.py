"""Shapes of each class: parts of random proportions that stand on the floor and face +x.

`wide` is 0 for proportions of training, and 1 for those beyond, which only tests use.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gigabrain_zenoh.vision.labels import CLASSES

Random = np.random.Generator
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Geom:
    """A geom: MuJoCo's type and half sizes [m], its pose, and its paint.

    Parts with the same paint share a colour that is drawn for each picture. `fixed` gives a
    colour (r, g, b) instead. Unlabelled parts are background.
    """

    kind: str  # box, cylinder, sphere, capsule, ellipsoid, or a mesh of `meshes`
    size: Sequence[float]
    at: Vector
    turn: Quaternion = UPRIGHT
    paint: str = "body"
    fixed: Vector | None = None
    shine: float = 0.2
    labelled: bool = True


@dataclass(frozen=True)
class Look:
    """One thing: its class (empty for a distractor), its parts, and limits of its pose."""

    label: str
    parts: tuple[Geom, ...]
    radius: float  # [m], of the circle on the ground that it covers
    height: float  # [m]
    hides: float = 0.0  # [m], half the width that it hides; 0 for its radius
    lies: float = 0.0  # chance to lie on its side
    fits: bool = True  # it counts only if most of it is within the picture
    facing: float = math.pi  # [rad], largest yaw away from the camera
    nearest: float = 0.5  # [m], least distance from the camera


def about(axis: Vector, angle: float) -> Quaternion:
    """Return the quaternion of a turn by `angle` [rad] about a unit axis."""
    s = math.sin(angle / 2)
    return (math.cos(angle / 2), axis[0] * s, axis[1] * s, axis[2] * s)


ALONG_Y = about((1.0, 0.0, 0.0), math.pi / 2)


def ranged(rng: Random, low: float, high: float, wide: int, spread: float = 1.35) -> float:
    """Draw from low to high; with `wide`, from beyond, by up to a factor of `spread`."""
    if not wide:
        return float(rng.uniform(low, high))
    if rng.random() < 0.5:
        return float(rng.uniform(low / spread, low))
    return float(rng.uniform(high, high * spread))


def rod(
    a: Vector, b: Vector, radius: float, paint: str, kind: str = "capsule", **more: float
) -> Geom:
    """Return a capsule or cylinder from a to b."""
    d = np.subtract(b, a)
    length = float(np.linalg.norm(d))
    d = d / length
    axis = np.cross((0, 0, 1), d)
    sine = float(np.linalg.norm(axis))
    turn = UPRIGHT
    if sine > 1e-6:
        x, y, z = (float(v) for v in axis / sine)
        turn = about((x, y, z), math.atan2(sine, float(d[2])))
    x, y, z = (float(v) for v in np.add(a, b) / 2)
    return Geom(kind, (radius, length / 2), (x, y, z), turn, paint, **more)  # type: ignore[arg-type]


def cube(rng: Random, wide: int) -> Look:
    """A plain cube of one paint, 6 to 24 cm."""
    e = ranged(rng, 0.03, 0.12, wide)
    return Look("cube", (Geom("box", (e, e, e), (0, 0, e)),), e * 1.42, 2 * e)


def box(rng: Random, wide: int) -> Look:
    """A carton: flat or tall, never as high as wide; most have tape and a label."""
    if rng.random() < 0.6:
        x, y = rng.uniform(0.1, 0.3, 2)
        z = min(x, y) * ranged(rng, 0.35, 0.62, wide)
    else:
        x, y = rng.uniform(0.06, 0.18, 2)
        z = max(x, y) * ranged(rng, 1.6, 2.4, wide)
    parts = [Geom("box", (x, y, z), (0, 0, z), paint="carton")]
    if rng.random() < 0.9:
        w, e = 0.025, 0.0015
        parts += [Geom("box", (x + e, w, z + e), (0, 0, z), paint="tape", shine=0.6)]
        face = 1 if rng.random() < 0.5 else -1
        parts += [
            Geom("box", (e, y * 0.3, z * 0.3), (face * (x + e), y * 0.5, z * 1.1), paint="label"),
            Geom("box", (x * 0.3, e, z * 0.3), (x * 0.4, face * (y + e), z * 0.9), paint="label"),
        ]
    return Look("box", tuple(parts), math.hypot(x, y), 2 * z)


def ball(rng: Random, wide: int) -> Look:
    """A ball of 6 to 26 cm, plain or with a band."""
    r = ranged(rng, 0.03, 0.13, wide)
    parts = [Geom("sphere", (r,), (0, 0, r), shine=0.5)]
    if rng.random() < 0.3:
        tilt = about((1.0, 0.0, 0.0), rng.uniform(0, math.pi))
        parts += [Geom("ellipsoid", (r * 1.004, r * 1.004, r * 0.3), (0, 0, r), tilt, "band")]
        parts[1] = replace(parts[1], kind="cylinder", size=(r * 0.985, r * 0.2))
    return Look("ball", tuple(parts), r, 2 * r)


def cylinder(rng: Random, wide: int) -> Look:
    """A drum or pillar of one paint without rims, 12 to 36 cm thick."""
    r = ranged(rng, 0.06, 0.18, wide)
    h = min(r * rng.uniform(0.9, 3.5), 0.42)
    return Look("cylinder", (Geom("cylinder", (r, h), (0, 0, h)),), r, 2 * h, lies=0.25)


def can(rng: Random, wide: int) -> Look:
    """A drinks can or tin: bright metal rims above and below a coloured label."""
    r = ranged(rng, 0.031, 0.05, wide, 1.25)
    h = r * rng.uniform(1.15, 2.2)
    rim, metal = r * rng.uniform(0.25, 0.4), {"fixed": (0.8, 0.81, 0.83), "shine": 0.9}
    parts = [
        Geom("cylinder", (r, h - rim), (0, 0, h), paint="label", shine=0.6),
        Geom("cylinder", (r * 0.9, h - rim / 3), (0, 0, h), **metal),  # type: ignore[arg-type]
        Geom("cylinder", (r * 0.78, h), (0, 0, h), **metal),  # type: ignore[arg-type]
        Geom("box", (r * 0.35, r * 0.2, 0.001), (r * 0.25, 0, 2 * h), fixed=(0.4, 0.4, 0.42)),
    ]
    if rng.random() < 0.6:
        parts += [
            Geom("cylinder", (r * 1.003, h * 0.25), (0, 0, h * 1.1), paint="print", shine=0.6)
        ]
    return Look("can", tuple(parts), r, 2 * h, lies=0.25)


def person(rng: Random, wide: int) -> Look:
    """A standing or walking figure of 1.5 to 1.95 m: legs, trunk, arms, neck, head, hair."""
    tall = ranged(rng, 1.5, 1.95, wide, 1.2)
    fat = ranged(rng, 0.85, 1.2, wide, 1.25)
    hip, step = 0.5 * tall, rng.uniform(-0.45, 0.45)
    sizes = {  # half sizes and middles (x, z) of ellipsoids, and their paints
        "trunk": ((0.085 * fat, 0.12 * fat, 0.2), (0.0, 0.65), "shirt"),
        "hips": ((0.08 * fat, 0.1 * fat, 0.09), (0.0, 0.5), "trousers"),
        "head": ((0.058, 0.047, 0.068), (0.008, 0.925), "skin"),
        "crown": ((0.06, 0.051, 0.058), (0.0, 0.945), "hair"),
    }
    parts = [rod((0, 0, 0.82 * tall), (0.01, 0, 0.88 * tall), 0.03 * tall, "skin")]
    for size, (x, z), paint in sizes.values():
        lengths = [tall * length for length in size]
        parts += [Geom("ellipsoid", lengths, (x * tall, 0, z * tall), paint=paint)]
    for side in (-1, 1):
        foot = (math.sin(step * side) * hip, side * 0.055 * tall, 0.05 * tall)
        parts += [*_leg(tall, fat, foot), *_arm(rng, tall, fat, foot[0], side)]
    return Look("person", tuple(parts), 0.3, tall, hides=0.15, fits=False, nearest=0.9)


def _leg(tall: float, fat: float, foot: Vector) -> list[Geom]:
    knee = (foot[0] * 0.4 + 0.04, foot[1], 0.27 * tall)
    shoe = (0.075 * tall, 0.028 * tall, 0.02 * tall)
    return [
        rod((0, foot[1], 0.5 * tall), knee, 0.045 * tall * fat, "trousers"),
        rod(knee, foot, 0.033 * tall * fat, "trousers"),
        Geom("box", shoe, (foot[0] + 0.03, foot[1], 0.02 * tall), paint="shoes"),
    ]


def _arm(rng: Random, tall: float, fat: float, swing: float, side: int) -> list[Geom]:
    out, bent = rng.uniform(0.1, 0.5), rng.uniform(0.0, 0.25)
    elbow = (-0.3 * swing, side * (0.12 + 0.06 * out) * tall, 0.64 * tall)
    hand = (elbow[0] + bent, elbow[1] * 0.95, elbow[2] - rng.uniform(0.02, 0.15) * tall)
    return [
        rod((0, side * 0.1 * tall * fat, 0.8 * tall), elbow, 0.028 * tall * fat, "shirt"),
        rod(elbow, hand, 0.022 * tall * fat, "skin" if rng.random() < 0.5 else "shirt"),
        Geom("sphere", (0.03 * tall,), hand, paint="skin"),
    ]


def figure(rng: Random, wide: int) -> Look:
    """The person of the simulated worlds: a capsule with a head and hair."""
    r, tall = ranged(rng, 0.2, 0.28, wide, 1.2), ranged(rng, 1.3, 1.55, wide, 1.2)
    parts = (
        rod((0, 0, 0), (0, 0, tall - r), r, "shirt"),
        Geom("sphere", (0.14,), (0, 0, tall + 0.1), paint="skin"),
        Geom("ellipsoid", (0.16, 0.15, 0.1), (-0.02, 0, tall + 0.18), paint="hair"),
    )
    return Look("person", parts, r, tall + 0.28, nearest=2.4)


def robot(rng: Random, wide: int) -> Look:
    """A wheeled base: round or square decks, wheels, a lidar drum, at times a camera on a mast."""
    r, h = ranged(rng, 0.08, 0.22, wide), ranged(rng, 0.04, 0.1, wide)
    wheel, is_round = ranged(rng, 0.03, 0.07, wide), rng.random() < 0.45
    x, y = r, r if is_round else r * rng.uniform(0.75, 1.3)
    parts, top = [], wheel * 0.8
    for _ in range(int(rng.integers(1, 4))):
        thick = rng.uniform(0.006, 0.02) if rng.random() < 0.6 else h * 0.6
        gap = h * rng.uniform(0.3, 0.8)
        parts += [
            _deck(is_round, x, y, thick, top + thick, "body" if rng.random() < 0.5 else "deck")
        ]
        top += 2 * thick
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            at = (a * x * 0.62, b * y * 0.62, top + gap / 2)
            parts += [Geom("cylinder", (0.005, gap / 2), at, paint="post", shine=0.8)]
        board = (x * 0.45, y * 0.4, gap * 0.3)
        parts += [Geom("box", board, (0, 0, top + gap * 0.3), paint="board")]
        top += gap
    parts += [_deck(is_round, x, y, 0.006, top, "deck")]
    for along in (0.0,) if rng.random() < 0.5 else (-0.65, 0.65):
        for side in (-1, 1):
            at = (along * x, side * (y + 0.012), wheel)
            parts += [Geom("cylinder", (wheel, 0.014), at, ALONG_Y, fixed=(0.08, 0.08, 0.09))]
            parts += [Geom("cylinder", (wheel * 0.6, 0.016), at, ALONG_Y, paint="rim", shine=0.7)]
    parts += _lidar(rng.uniform(0.03, 0.045), top)
    if rng.random() < 0.35:
        head = (-x * 0.5, 0.0, top + rng.uniform(0.1, 0.4))
        parts += [rod((-x * 0.5, 0, top), head, 0.012, "post", "cylinder")]
        parts += [Geom("box", (0.02, 0.05, 0.018), head, fixed=(0.1, 0.1, 0.12), shine=0.7)]
    return Look("robot", tuple(parts), math.hypot(x, y) + 0.02, top + 0.06)


def _deck(is_round: bool, x: float, y: float, thick: float, z: float, paint: str) -> Geom:
    if is_round:
        return Geom("cylinder", (x, thick), (0, 0, z), paint=paint)
    return Geom("box", (x, y, thick), (0, 0, z), paint=paint)


def _lidar(r: float, z: float) -> list[Geom]:
    return [
        Geom("cylinder", (r, 0.012), (0, 0, z + 0.012), fixed=(0.1, 0.1, 0.11)),
        Geom("cylinder", (r, 0.014), (0, 0, z + 0.04), fixed=(0.07, 0.07, 0.08), shine=0.7),
        Geom("cylinder", (r * 0.8, 0.004), (0, 0, z + 0.026), paint="ring"),
    ]


def charger(rng: Random, wide: int) -> Look:
    """A docking station: upright back, ramp on the floor, two bright contacts, a lamp, stripes."""
    w, h = ranged(rng, 0.1, 0.2, wide), ranged(rng, 0.09, 0.18, wide)
    depth, thick = ranged(rng, 0.08, 0.16, wide), rng.uniform(0.02, 0.045)
    brass = (0.85, 0.65, 0.2) if rng.random() < 0.6 else (0.85, 0.86, 0.88)
    lamp = [(0.1, 1.0, 0.3), (0.1, 0.5, 1.0), (1.0, 0.5, 0.1)][rng.integers(3)]
    parts = [
        Geom("box", (thick, w, h), (-depth, 0, h)),
        Geom("box", (depth, w, 0.008), (0, 0, 0.008), paint="ramp"),
        Geom(
            "box",
            (0.004, w * 0.75, 0.014),
            (-depth + thick + 0.002, 0, 2 * h - 0.03),
            fixed=lamp,
            shine=0.8,
        ),
    ]
    for side in (-1, 1):
        parts += [
            Geom(
                "box",
                (depth * 0.75, 0.014, 0.004),
                (0, side * w * 0.45, 0.018),
                fixed=brass,
                shine=0.9,
            ),
            Geom(
                "box",
                (0.006, 0.014, h * 0.4),
                (-depth + thick + 0.004, side * w * 0.45, h * 0.75),
                fixed=brass,
                shine=0.9,
            ),
            Geom("box", (depth * 0.9, 0.01, 0.02), (0, side * w, 0.02), paint="body"),
        ]
    return Look("charger", tuple(parts), math.hypot(w, depth + thick), 2 * h, facing=1.9)


def door(rng: Random, wide: int) -> Look:
    """A door in its frame in a piece of wall: leaf with panels and a handle, shut or ajar."""
    w, h = ranged(rng, 0.38, 0.5, wide, 1.25), ranged(rng, 0.95, 1.07, wide, 1.15)
    ajar = rng.uniform(0.2, 1.2) if rng.random() < 0.35 else 0.0
    side = float(rng.choice([-1, 1]))
    post, deep = rng.uniform(0.03, 0.06), 0.06
    parts = [
        Geom("box", (deep, post, h), (0, w + post, h), paint="frame"),
        Geom("box", (deep, post, h), (0, -w - post, h), paint="frame"),
        Geom("box", (deep, w + 2 * post, post), (0, 0, 2 * h + post), paint="frame"),
        *_leaf(rng, w, h, ajar, side),
    ]
    high = 2 * h + 2 * post
    for s in (-1, 1):
        parts += [
            Geom(
                "box",
                (0.04, 0.6, 1.3),
                (0, s * (w + 2 * post + 0.6), 1.3),
                paint="wall",
                labelled=False,
            )
        ]
    lintel = (2.6 - high) / 2
    if lintel > 0.01:
        parts += [
            Geom(
                "box",
                (0.04, w + 2 * post, lintel),
                (0, 0, high + lintel),
                paint="wall",
                labelled=False,
            )
        ]
    return Look("door", tuple(parts), 0.35, high, fits=False, facing=0.9, nearest=1.3)


def _leaf(rng: Random, w: float, h: float, ajar: float, side: float) -> list[Geom]:
    """The leaf of a door, turned by `ajar` [rad] about its hinges at y = -side * w."""
    turn = about((0.0, 0.0, 1.0), -side * ajar)
    c, s = math.cos(-side * ajar), math.sin(-side * ajar)

    def at(x: float, y: float, z: float) -> Vector:
        y += side * w  # from the hinges
        return (c * x - s * y, s * x + c * y - side * w, z)

    parts = [Geom("box", (0.02, w, h), at(0, 0, h), turn, "leaf")]
    rows = int(rng.integers(0, 4))
    for row in range(rows):
        z = 2 * h * (row + 0.5) / rows
        for x in (-0.021, 0.021):
            parts += [Geom("box", (0.003, w * 0.7, h / rows * 0.75), at(x, 0, z), turn, "panel")]
    for x in (-0.05, 0.05):
        metal = {"fixed": (0.7, 0.7, 0.72), "shine": 0.9}
        parts += [Geom("box", (0.004, 0.02, 0.1), at(x / 2, side * w * 0.85, 1.02), turn, **metal)]  # type: ignore[arg-type]
        parts += [Geom("box", (0.01, 0.06, 0.01), at(x, side * w * 0.78, 1.04), turn, **metal)]  # type: ignore[arg-type]
    return parts


Maker = Callable[[Random, int], Look]
MAKERS: dict[str, tuple[Maker, ...]] = {
    "cube": (cube,),
    "ball": (ball,),
    "cylinder": (cylinder,),
    "can": (can,),
    "box": (box,),
    "person": (person, person, person, figure),
    "robot": (robot,),
    "charger": (charger,),
    "door": (door,),
}
if tuple(MAKERS) != CLASSES:
    raise AssertionError("looks and labels name different classes")
