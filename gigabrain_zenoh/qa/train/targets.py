"""The net's targets for a picture, and random changes of pictures for training."""

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.qa.train.looks import Random
from gigabrain_zenoh.qa.train.pictures import Labelled, degrade
from gigabrain_zenoh.vision.labels import CLASSES
from gigabrain_zenoh.vision.recognizer import STRIDE_PX

CORE = 0.54  # share of a box, whose cells predict the box
ZOOM = (0.8, 1.5)
MIN_LEFT = 0.45  # a box is ignored if a smaller share of it is left after cropping

Floats = NDArray[np.float32]
Target = tuple[Floats, Floats, Floats, Floats]


def augment(
    rng: Random, one: Labelled, width: int, height: int
) -> tuple[NDArray[np.uint8], Labelled]:
    """Decode, scale, mirror, zoom, shift, and degrade a picture, and move its boxes."""
    picture, boxes = one.picture(), one.boxes.copy()
    if picture.shape[:2] != (height, width):
        boxes *= np.tile([width, height], 2) / np.tile(picture.shape[1::-1], 2)
        picture = np.asarray(
            cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8
        )
    if rng.random() < 0.5:
        picture = np.ascontiguousarray(picture[:, ::-1])
        boxes[:, [0, 2]] = width - boxes[:, [2, 0]]
    ignored = one.ignored.copy()
    if rng.random() < 0.7:
        zoom = rng.uniform(*ZOOM)
        dx, dy = (rng.uniform(min(0, n - n * zoom), max(0, n - n * zoom)) for n in (width, height))
        matrix = np.array([[zoom, 0, dx], [0, zoom, dy]])
        fill = tuple(float(v) for v in rng.integers(0, 256, 3))
        moved_picture = cv2.warpAffine(picture, matrix, (width, height), borderValue=fill)
        picture = np.asarray(moved_picture, np.uint8)
        moved = boxes * zoom + np.array([dx, dy, dx, dy], np.float32)
        boxes = np.clip(moved, 0, [width, height, width, height]).astype(np.float32)
        ignored |= _area(boxes) < MIN_LEFT * _area(moved)
        ignored |= np.minimum(boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]) < 3
    seen = degrade(rng, relight(rng, picture))
    return seen, Labelled(b"", boxes, one.labels, one.fractions, ignored)


def relight(rng: Random, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Change the light: colour cast, contrast, and a gradient of brightness."""
    h, w = picture.shape[:2]
    levels = np.linspace(0, 1, 256)[:, None] ** rng.uniform(0.7, 1.4) * rng.uniform(0.65, 1.15, 3)
    out = cv2.LUT(picture, (255 * np.clip(levels, 0, 1)).astype(np.uint8)[:, None])
    if rng.random() < 0.5:
        corners = rng.uniform(0.6, 1.2, (2, 2)).astype(np.float32)
        gain = cv2.resize(corners, (w, h), interpolation=cv2.INTER_LINEAR)[..., None]
        out = np.clip(out * gain, 0, 255)
    return np.asarray(out, np.uint8)


def _area(boxes: Floats) -> Floats:
    return (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])


def targets(one: Labelled, height: int, width: int) -> Target:
    """Return heat (h, w, classes), its mask, boxes (h, w, 4) [px] and their weights (h, w)."""
    h, w = height // STRIDE_PX, width // STRIDE_PX
    heat = np.zeros((h, w, len(CLASSES)), np.float32)
    mask = np.ones((h, w, len(CLASSES)), np.float32)
    boxes, weights = np.zeros((h, w, 4), np.float32), np.zeros((h, w), np.float32)
    for k in np.argsort(-_area(one.boxes)):
        box, label = one.boxes[k], one.labels[k]
        x0, y0, x1, y1 = box / STRIDE_PX
        if one.ignored[k]:
            mask[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1, label] = 0
            continue
        bump = np.outer(_bump(y0, y1, h), _bump(x0, x1, w))
        heat[..., label] = np.maximum(heat[..., label], bump)
        mask[..., label][bump > 0] = 1
        core = bump > 0
        boxes[core] = box
        weights[core] = (bump / bump.sum() * np.log(max(float(_area(box[None])[0]), 16)))[core]
    return heat, mask, boxes, weights


def _bump(low: float, high: float, n: int) -> Floats:
    """Return a Gaussian (n,) along one side of a box: 1 in its middle cell, 0 outside its core."""
    middle = min(int((low + high) / 2), n - 1)
    radius = int((high - low) / 2 * CORE)
    sigma = (2 * radius + 1) / 6
    gap = np.arange(n) - middle
    return np.where(np.abs(gap) <= radius, np.exp(-(gap**2) / (2 * sigma**2)), 0).astype(np.float32)
