"""Average precision at an IoU of 0.5, by COCO's rules: 101 points, ignored boxes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.qa.train.pictures import Labelled
from gigabrain_zenoh.vision.labels import CLASSES
from gigabrain_zenoh.vision.recognizer import Found, Recognizer

OVERLAP = 0.5
MIN_CONFIDENCE = 0.01  # low, as the curve needs unsure findings too
HIDDEN = 0.95  # things with a smaller visible share are partly hidden
RECALLS = np.linspace(0, 1, 101)
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Wanted:
    """The things in a picture: boxes (n, 4) [px], labels (n,), and flags to ignore them (n,)."""

    boxes: Floats
    labels: NDArray[np.int64]
    ignored: NDArray[np.bool_]


def overlaps(found: Floats, wanted: Floats, ignored: NDArray[np.bool_]) -> Floats:
    """Return the IoU of each found and each wanted box; for ignored ones, the share of `found`."""
    low = np.maximum(found[:, None, :2], wanted[None, :, :2])
    high = np.minimum(found[:, None, 2:], wanted[None, :, 2:])
    both = np.prod(np.maximum(high - low, 0), axis=-1)
    first, second = (np.prod(b[:, 2:] - b[:, :2], axis=-1) for b in (found, wanted))
    union = np.where(ignored, first[:, None], first[:, None] + second - both)
    return np.asarray(both / np.maximum(union, 1e-9), np.float32)


def match(guess: Found, wanted: Wanted, label: int) -> tuple[Floats, NDArray[np.int8]]:
    """Return a class's confidences, highest first, and verdicts: 1 right, 0 wrong, -1 ignored."""
    own = guess.labels == label
    order = np.argsort(-guess.confidences[own], kind="stable")
    found, confidences = guess.boxes[own][order], guess.confidences[own][order]
    is_class = wanted.labels == label
    boxes, ignored = wanted.boxes[is_class], wanted.ignored[is_class]
    shares, taken = overlaps(found, boxes, ignored), np.zeros(len(boxes), bool)
    verdicts = np.zeros(len(found), np.int8)
    for k, share in enumerate(shares):
        free = np.where(taken | ignored, -1.0, share)
        if len(free) and free.max() >= OVERLAP:
            taken[free.argmax()], verdicts[k] = True, 1
        elif np.any(share[ignored] >= OVERLAP):
            verdicts[k] = -1
    return confidences, verdicts


def average_precision(guesses: Sequence[Found], truths: Sequence[Wanted], label: int) -> float:
    """Return a class's average precision over all pictures; nan if it is in none."""
    pairs = [match(guess, truth, label) for guess, truth in zip(guesses, truths, strict=True)]
    count = sum(int(((t.labels == label) & ~t.ignored).sum()) for t in truths)
    if not count:
        return float("nan")
    confidences = np.concatenate([c for c, _ in pairs])
    verdicts = np.concatenate([v for _, v in pairs])[np.argsort(-confidences, kind="stable")]
    right = (verdicts[verdicts >= 0] == 1).astype(np.int64)
    hits = np.cumsum(right)
    precision = np.maximum.accumulate((hits / np.arange(1, len(hits) + 1))[::-1])[::-1]
    at = np.searchsorted(hits / count, RECALLS, side="left")
    return float(np.where(at < len(hits), np.append(precision, 0)[at], 0).mean())


def table(guesses: Sequence[Found], truths: Sequence[Wanted]) -> dict[str, float]:
    """Return the average precision of each class, by name."""
    return {name: average_precision(guesses, truths, k) for k, name in enumerate(CLASSES)}


def run(pictures: Sequence[Labelled], weights: Path) -> tuple[list[Found], list[Wanted]]:
    """Return a net's findings in pictures, and the things in them."""
    recognizer = Recognizer(weights, min_confidence=MIN_CONFIDENCE)
    guesses = [recognizer.find(one.picture()) for one in pictures]
    return guesses, [Wanted(one.boxes, one.labels, one.ignored) for one in pictures]


def describe(split: str, pictures: Sequence[Labelled]) -> str:
    """Return a line about a set: numbers of pictures and things, and the share of hidden ones."""
    counted = np.concatenate([one.fractions[~one.ignored] for one in pictures])
    hidden = float((counted < HIDDEN).mean())
    return f"{split}: {len(pictures)} pictures, {len(counted)} things, {hidden:.0%} partly hidden"


def text(columns: Mapping[str, Mapping[str, float]]) -> str:
    """Return a Markdown table with a row per class and one for the mean."""
    rows = [f"| AP@50 | {' | '.join(columns)} |", f"|---|{'---|' * len(columns)}"]
    for name in CLASSES:
        rows.append(f"| {name} | {' | '.join(f'{c[name]:.3f}' for c in columns.values())} |")
    means = (float(np.nanmean(list(column.values()))) for column in columns.values())
    return "\n".join([*rows, f"| mean | {' | '.join(f'{mean:.3f}' for mean in means)} |"])
