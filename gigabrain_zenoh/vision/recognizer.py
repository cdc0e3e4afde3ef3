"""Finds things of known classes in a picture, with a small net in `cv2.dnn`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.vision.labels import CLASSES

WEIGHTS = Path(__file__).parent / "weights" / "things.onnx"
WIDTH_PX, HEIGHT_PX, STRIDE_PX = 320, 240, 8
UNIT_PX = 16.0  # distance to a side at raw 0
RAW_LIMITS = (-4.0, 3.5)  # of raw distances
MAX_CANDIDATES = 200  # before overlapping ones are dropped
MIN_CONFIDENCE, MAX_OVERLAP = 0.4, 0.5
GREY = (114, 114, 114)  # around pictures of another shape

Picture = NDArray[np.uint8]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Found:
    """Things found in one picture, most confident first.

    boxes: float32 (n, 4), left, top, right, bottom [px of the picture]; labels: int64 (n,),
    indices into `classes`; confidences: float32 (n,), 0 to 1.
    """

    boxes: Floats
    labels: NDArray[np.int64]
    confidences: Floats
    classes: Sequence[str] = CLASSES

    def __len__(self) -> int:
        return len(self.labels)

    def names(self) -> tuple[str, ...]:
        """Return the class of each."""
        return tuple(self.classes[label] for label in self.labels)


class Recognizer:
    """The shipped net, or another of its layout. Raises ConfigError if it cannot be loaded.

    One picture costs some 10 ms of a core at 320 x 240; it is for one thread.
    """

    def __init__(
        self,
        weights: Path = WEIGHTS,
        *,
        min_confidence: float = MIN_CONFIDENCE,
        classes: Sequence[str] = CLASSES,
    ) -> None:
        if not weights.is_file():
            raise ConfigError(
                f"{weights}: no such file; `python -m gigabrain_zenoh.qa.train all` makes it"
            )
        self._net = read_net(weights)
        self._min_confidence, self.classes = min_confidence, classes

    def find(self, picture: Picture) -> Found:
        """Find things in a picture (h, w, 3), RGB, of any size."""
        if (
            picture.ndim != 3
            or picture.shape[2] != 3
            or picture.dtype != np.uint8
            or not picture.size
        ):
            raise ValueError(f"a picture is uint8 (h, w, 3), not {picture.dtype} {picture.shape}")
        fitted, scale, left, top = fit(picture)
        self._net.setInput(cv2.dnn.blobFromImage(fitted, 1 / 255.0))
        found = decode(np.asarray(self._net.forward())[0], self._min_confidence)
        boxes = unfit(found.boxes, picture, scale, left, top)
        return Found(boxes, found.labels, found.confidences, self.classes)


def read_net(path: Path) -> cv2.dnn.Net:
    """Return the net of an ONNX file. Raises ConfigError if cv2.dnn cannot run it."""
    try:
        return cv2.dnn.readNetFromONNX(str(path))
    except cv2.error as error:
        raise ConfigError(f"{path}: not a net that cv2.dnn can run: {reason(error)}") from error


def reason(error: cv2.error) -> str:
    """Return OpenCV's error as one line."""
    return str(error).split("error:")[-1].strip().splitlines()[0][:120]


def fit(
    picture: Picture, size: tuple[int, int] = (WIDTH_PX, HEIGHT_PX)
) -> tuple[Picture, float, int, int]:
    """Scale a picture to a net's size (width, height), grey around it.

    Returns it, with scale, left and top [px].
    """
    height, width = picture.shape[:2]
    if (width, height) == size:
        return picture, 1.0, 0, 0
    scale = min(size[0] / width, size[1] / height)
    inner = max(1, round(width * scale)), max(1, round(height * scale))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(picture, inner, interpolation=how)
    left, top = (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2
    canvas = np.full((size[1], size[0], 3), GREY, np.uint8)
    canvas[top : top + inner[1], left : left + inner[0]] = small
    return canvas, scale, left, top


def unfit(boxes: Floats, picture: Picture, scale: float, left: int, top: int) -> Floats:
    """Return boxes of a fitted picture as boxes of the picture itself."""
    height, width = picture.shape[:2]
    moved = (boxes - np.array([left, top, left, top], np.float32)) / scale
    clipped: Floats = np.clip(moved, 0, [width, height, width, height]).astype(np.float32)
    return clipped


def decode(raw: Floats, min_confidence: float = MIN_CONFIDENCE) -> Found:
    """Decode the net's output (classes + 4, h, w), without overlapping boxes.

    Logits of classes come first, then the logarithms of distances to left, top, right, bottom.
    """
    classes = len(raw) - 4
    odds = np.log(min_confidence) - np.log1p(-min_confidence)
    labels, rows, columns = np.nonzero(raw[:classes] > odds)
    logits = raw[labels, rows, columns]
    best = np.argsort(-logits, kind="stable")[:MAX_CANDIDATES]
    labels, rows, columns, logits = labels[best], rows[best], columns[best], logits[best]
    d = UNIT_PX * np.exp(np.clip(raw[classes:, rows, columns], *RAW_LIMITS))
    x, y = (columns + 0.5) * STRIDE_PX, (rows + 0.5) * STRIDE_PX
    boxes = np.stack([x - d[0], y - d[1], x + d[2], y + d[3]], axis=1)
    height, width = raw.shape[1] * STRIDE_PX, raw.shape[2] * STRIDE_PX
    boxes = np.clip(boxes, 0, [width, height, width, height]).astype(np.float32)
    confidences = (1 / (1 + np.exp(-logits))).astype(np.float32)
    kept = suppress(boxes, labels, confidences)
    return Found(boxes[kept], labels[kept].astype(np.int64), confidences[kept])


def suppress(
    boxes: Floats, labels: NDArray[np.int64], confidences: Floats, overlap: float = MAX_OVERLAP
) -> NDArray[np.int64]:
    """Return the boxes to keep, most confident first; drop those that overlap a better one."""
    if not len(boxes):
        return np.zeros(0, np.int64)
    sized = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    kept: Sequence[int] = cv2.dnn.NMSBoxesBatched(
        sized.tolist(), confidences.tolist(), labels.tolist(), 0.0, overlap
    )
    index = np.asarray(kept, np.int64).ravel()
    return index[np.argsort(-confidences[index], kind="stable")]
