"""Procedural textures: some families are drawn for training, others for tests only."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Picture = NDArray[np.uint8]  # (n, n, 3), RGB
Grey = NDArray[np.float32]  # (n, n), share of the second colour, 0 to 1
Random = np.random.Generator


def _grid(n: int) -> tuple[Grey, Grey]:
    """Return the coordinates u and v of each pixel, 0 to 1."""
    v, u = np.indices((n, n)).astype(np.float32) / n
    return u, v


def _grey(share: ArrayLike) -> Grey:
    return np.asarray(share, np.float32)


def clouds(rng: Random, n: int, coarse: int = 3) -> Grey:
    """Smooth noise of some octaves."""
    total = np.zeros((n, n), np.float32)
    for octave in range(4):
        cells = min(coarse * 2**octave, n)
        small = rng.random((cells, cells), np.float32)
        total += cv2.resize(small, (n, n), interpolation=cv2.INTER_CUBIC) / 2**octave
    total -= total.min()
    return _grey(total / max(float(total.max()), 1e-6))


def plain(rng: Random, n: int) -> Grey:
    """One colour with slight spots."""
    return _grey(0.15 * clouds(rng, n))


def speckles(rng: Random, n: int) -> Grey:
    """Terrazzo: spots of a few pixels."""
    noise = cv2.GaussianBlur(rng.random((n, n), np.float32), (0, 0), rng.uniform(0.6, 2.0))
    return _grey(noise > np.quantile(noise, rng.uniform(0.6, 0.95)))


def checks(rng: Random, n: int) -> Grey:
    """A chessboard."""
    u, v = _grid(n)
    cells = int(rng.integers(1, 5)) * 2
    return _grey((np.floor(u * cells) + np.floor(v * cells)) % 2)


def stripes(rng: Random, n: int) -> Grey:
    """Parallel stripes of one slope."""
    u, v = _grid(n)
    a, b = rng.integers(0, 4, 2)
    return _grey(((u * (a + 1) + v * b) % 1.0) < rng.uniform(0.2, 0.8))


def tiles(rng: Random, n: int) -> Grey:
    """Square tiles or bricks with joints."""
    u, v = _grid(n)
    rows, joint = int(rng.integers(2, 7)), rng.uniform(0.03, 0.1)
    shift = 0.5 * (np.floor(v * rows) % 2) * rng.integers(0, 2)
    across = (u * rows * rng.choice([0.5, 1.0]) + shift) % 1.0
    joints = (across < joint) | ((v * rows) % 1.0 < joint)
    return _grey(np.maximum(joints, 0.25 * clouds(rng, n)))


def planks(rng: Random, n: int) -> Grey:
    """Wooden boards with grain along them."""
    u, v = _grid(n)
    rows = int(rng.integers(3, 8))
    grain = clouds(rng, n, 2)
    wood = 0.5 + 0.5 * np.sin(40 * v + 9 * grain + 3 * u)
    tone = rng.random(rows).astype(np.float32)[np.floor(v * rows).astype(int) % rows]
    joint = ((v * rows) % 1.0 < 0.06).astype(np.float32)
    return _grey(np.clip(0.3 * wood + 0.4 * tone + joint, 0, 1))


def marble(rng: Random, n: int) -> Grey:
    """Veins (tests only)."""
    u, v = _grid(n)
    veins = np.abs(np.sin(rng.uniform(3, 9) * (u + v) + 8 * clouds(rng, n)))
    return _grey(veins ** rng.uniform(0.3, 1.0))


def plaid(rng: Random, n: int) -> Grey:
    """Crossing bands of several widths (tests only)."""
    u, v = _grid(n)
    bands = [rng.random(int(rng.integers(6, 14))).astype(np.float32) for _ in range(2)]
    across, along = (
        b[np.floor(x * len(b)).astype(int)] for b, x in zip(bands, (u, v), strict=True)
    )
    return _grey((across + along) / 2)


def hexagons(rng: Random, n: int) -> Grey:
    """Honeycomb with joints (tests only)."""
    u, v = _grid(n)
    rows = int(rng.integers(3, 7))
    x, y = u * rows, v * rows * 1.1547
    nearest = np.full((2, n, n), np.inf, np.float32)
    for shift in (0.0, 0.5):
        dx = (x + shift) % 1.0 - 0.5
        dy = (y + shift * 1.7321) % 1.7321 - 0.8660
        gap = np.hypot(dx, dy)
        nearest = np.sort(np.stack([*nearest, gap]), axis=0)[:2]
    return _grey((nearest[1] - nearest[0]) < 0.12)


def waves(rng: Random, n: int) -> Grey:
    """Rings and ripples (tests only)."""
    u, v = _grid(n)
    cu, cv = rng.random(2)
    return _grey(0.5 + 0.5 * np.sin(rng.uniform(20, 60) * np.hypot(u - cu, v - cv)))


Family = Callable[[Random, int], Grey]
TRAIN: tuple[Family, ...] = (plain, plain, speckles, checks, stripes, tiles, planks, clouds)
TEST: tuple[Family, ...] = (plain, marble, plaid, hexagons, waves)


def colour(rng: Random, vivid: float = 0.5, darkest: float = 0.15) -> NDArray[np.float32]:
    """Draw a colour, RGB from 0 to 1: bright with chance `vivid`, else close to grey."""
    saturation = rng.uniform(0.45, 1.0) if rng.random() < vivid else rng.uniform(0.0, 0.2)
    hsv = np.array([[[rng.uniform(0, 360), saturation, rng.uniform(darkest, 1.0)]]], np.float32)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0], np.float32)


def draw(
    rng: Random, families: tuple[Family, ...], n: int, contrast: float = 1.0, vivid: float = 0.3
) -> Picture:
    """Draw a texture (n, n, 3) of one of the families, in two colours."""
    share = families[rng.integers(len(families))](rng, n)[..., None] * contrast
    first, second = colour(rng, vivid, 0.3), colour(rng, vivid, 0.3)
    picture = first * (1 - share) + second * share
    picture += rng.normal(0, 0.02, (n, n, 1))
    return np.asarray(np.clip(255 * picture, 0, 255), np.uint8)
