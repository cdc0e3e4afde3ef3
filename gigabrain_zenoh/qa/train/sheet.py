"""A sheet of pictures: right findings green, wrong ones red, things white (named if missed)."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.qa.train.pictures import Labelled
from gigabrain_zenoh.qa.train.scores import OVERLAP, overlaps
from gigabrain_zenoh.vision.labels import CLASSES
from gigabrain_zenoh.vision.recognizer import Found

WHITE, GREEN, RED, GREY = (255, 255, 255), (60, 230, 60), (255, 60, 60), (120, 120, 120)
COLUMNS = 4
MIN_CONFIDENCE = 0.3


def mistakes(one: Labelled, found: Found) -> int:
    """Return the number of missed things plus that of wrong findings."""
    right, detected = _hits(one, found)
    return int((~right).sum() + (~detected & ~one.ignored).sum())


def sheet(pictures: Sequence[Labelled], found: Sequence[Found]) -> NDArray[np.uint8]:
    """Return all pictures in rows, RGB, with boxes drawn in."""
    tiles = [_tile(one, guess) for one, guess in zip(pictures, found, strict=True)]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
    rows = [np.concatenate(tiles[k : k + COLUMNS], 1) for k in range(0, len(tiles), COLUMNS)]
    return np.concatenate(rows)


def _sure(found: Found) -> NDArray[np.bool_]:
    return np.asarray(found.confidences >= MIN_CONFIDENCE)


def _hits(one: Labelled, found: Found) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return flags of right findings, among the sure ones, and of detected things."""
    sure = _sure(found)
    shares = overlaps(found.boxes[sure], one.boxes, one.ignored)
    hits = (shares >= OVERLAP) & (found.labels[sure][:, None] == one.labels[None])
    return hits.any(axis=1), hits.any(axis=0)


def _tile(one: Labelled, found: Found) -> NDArray[np.uint8]:
    picture, sure = one.picture().copy(), _sure(found)
    right, detected = _hits(one, found)
    for box, label, ignored, hit in zip(one.boxes, one.labels, one.ignored, detected, strict=True):
        missed = "" if hit or ignored else CLASSES[label]
        _rectangle(picture, box, GREY if ignored else WHITE, missed)
    for box, label, hit in zip(found.boxes[sure], found.labels[sure], right, strict=True):
        _rectangle(picture, box, GREEN if hit else RED, CLASSES[label])
    return picture


def _rectangle(
    picture: NDArray[np.uint8], box: NDArray[np.float32], colour: tuple[int, int, int], text: str
) -> None:
    x0, y0, x1, y1 = (int(v) for v in box)
    cv2.rectangle(picture, (x0, y0), (x1 - 1, y1 - 1), colour, 1)
    if text:
        at = (min(x0, picture.shape[1] - 50), max(y0 - 2, 9))
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.35, colour, 1, cv2.LINE_AA)
