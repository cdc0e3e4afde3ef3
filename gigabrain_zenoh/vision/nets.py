"""Nets that recognise things: the shipped one, or a user's in a common export layout."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.config.settings import RecognizerConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import file_problem, read_bounded
from gigabrain_zenoh.vision.labels import CLASSES, COCO_IDS
from gigabrain_zenoh.vision.onnx_file import input_of
from gigabrain_zenoh.vision.recognizer import (
    HEIGHT_PX,
    MAX_CANDIDATES,
    WEIGHTS,
    WIDTH_PX,
    Floats,
    Found,
    Picture,
    Recognizer,
    fit,
    read_net,
    reason,
    suppress,
    unfit,
)

STRIDE_PX, LARGEST_PX = 32, 640  # of nets with dynamic axes
MAX_LABEL_BYTES, MAX_LABEL = 1_000_000, 64
GOOD_YOLO = "`yolo export model=my.pt format=onnx imgsz=320 dynamic=False`"
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's pixels, RGB
BOXES = ("dets", "boxes", "pred_boxes")  # names of that output
ORT = "needs ONNX Runtime; install it with: pip install onnxruntime"


class Net(Protocol):
    """Finds things in a picture (h, w, 3), RGB."""

    @property
    def classes(self) -> Sequence[str]:
        """The class of each of its outputs; an empty one is not reported."""
        ...

    def find(self, picture: Picture) -> Found:
        """Return the things in it, most confident first."""
        ...


def load_net(config: RecognizerConfig) -> Net | None:
    """Return the net of the settings; None without shipped weights. Raises ConfigError."""
    own = config.layout != "things"
    if own and not config.onnx:
        text = f"recognizer: layout `{config.layout}` is for your own net"
        raise ConfigError(f"{text}; name its file in `onnx`")
    if own and not config.labels:
        raise ConfigError("recognizer: labels: missing; expected a file with one class a line")
    if not config.onnx and not WEIGHTS.is_file():
        return None
    path = Path(config.onnx) if config.onnx else WEIGHTS
    if not path.is_file():
        raise ConfigError(f"recognizer: {path}: no such file; expected an ONNX file")
    classes = read_labels(Path(config.labels)) if config.labels else CLASSES
    if config.layout == "yolo":
        return YoloNet(path, classes, config)
    if config.layout == "detr":
        return DetrNet(path, classes, config)
    _check_things(path, classes)
    return Recognizer(path, min_confidence=config.min_confidence, classes=classes)


def read_labels(path: Path) -> tuple[str, ...]:
    """Read the classes of a file, one a line; an empty line is a class that is not reported."""
    try:
        text = read_bounded(path, MAX_LABEL_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(f"recognizer: labels: {path}: {file_problem(error)}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"recognizer: labels: {path}: expected UTF-8 text") from None
    lines = [line.strip() for line in text.rstrip().splitlines()]
    for number, line in enumerate(lines, 1):
        if len(line) > MAX_LABEL:
            raise ConfigError(f"{path}:{number}: a class has at most {MAX_LABEL} characters")
    if not any(lines):
        raise ConfigError(f"{path}: no class in it; expected one a line")
    return tuple(lines)


def _check_things(path: Path, classes: Sequence[str]) -> None:
    """Raise ConfigError for a net of another layout than the shipped one's."""
    shape = input_of(path).shape
    if shape[1:] != (3, HEIGHT_PX, WIDTH_PX):
        raise ConfigError(
            f"{path}: takes {_sizes(shape)}; layout `things` takes 1 x 3 x {HEIGHT_PX} x "
            f"{WIDTH_PX}: is it `layout: yolo`, or `detr`?"
        )
    net = read_net(path)
    blob = np.zeros((1, 3, HEIGHT_PX, WIDTH_PX), np.float32)
    made = _run(net, blob, path, "expected a net as training exports it")
    if made.ndim != 4 or made.shape[1] != len(classes) + 4:
        raise ConfigError(
            f"{path}: gives {_sizes(made.shape)}; expected 1 x {len(classes) + 4} x …, for "
            f"{len(classes)} classes"
        )


class YoloNet:
    """A net as ultralytics exports YOLOv8, 11 and newer. Raises ConfigError.

    It gives (1, 4 + classes, n): the middle and size of boxes [px] and scores from 0 to 1; or
    (1, n, 6), where the export drops overlapping boxes itself: corners, score, and class.
    """

    def __init__(self, path: Path, classes: Sequence[str], config: RecognizerConfig) -> None:
        self.classes, self._least = classes, config.min_confidence
        self._size = _input_size(path)
        self._net = read_net(path)
        self._path = path
        made = self._answers(np.zeros((*(self._size or (320, 320)), 3), np.uint8))
        self._final = made.ndim == 3 and made.shape[2] == 6 and made.shape[1] != 4 + len(classes)
        if made.ndim != 3 or len(made) != 1 or (made.shape[1] < 5 and not self._final):
            raise ConfigError(
                f"{path}: gives {_sizes(made.shape)}; layout `yolo` expects "
                f"1 x {4 + len(classes)} x n"
            )
        if not self._final and made.shape[1] != 4 + len(classes):
            raise ConfigError(
                f"{path}: {made.shape[1] - 4} classes, but its labels have {len(classes)}"
            )

    def find(self, picture: Picture) -> Found:
        """Find things in a picture (h, w, 3), RGB, of any size."""
        height, width = self._size or _rounded(picture)
        fitted, scale, left, top = fit(picture, (width, height))
        raw = np.asarray(self._answers(fitted), np.float32)[0]
        boxes, labels, sure = self._unpacked(raw)
        wanted = np.flatnonzero(_known(labels, self.classes) & np.isfinite(boxes).all(axis=1))
        best = wanted[np.argsort(-sure[wanted], kind="stable")[:MAX_CANDIDATES]]
        boxes, labels, sure = boxes[best], labels[best], sure[best]
        if not self._final:
            kept = suppress(boxes, labels, sure)
            boxes, labels, sure = boxes[kept], labels[kept], sure[kept]
        return Found(unfit(boxes, picture, scale, left, top), labels, sure, self.classes)

    def _answers(self, fitted: Picture) -> NDArray[Any]:
        blob = cv2.dnn.blobFromImage(fitted, 1 / 255.0)
        return _run(self._net, blob, self._path, f"export it so: {GOOD_YOLO}")

    def _unpacked(self, raw: Floats) -> tuple[Floats, NDArray[np.int64], Floats]:
        """Return corners, labels and confidences above the least confidence."""
        if self._final:
            final = raw[raw[:, 4] >= self._least]
            return final[:, :4], final[:, 5].astype(np.int64), np.minimum(final[:, 4], 1)
        scores = np.where(_named_ones(self.classes)[:, None], raw[4:], 0)
        labels, sure = np.asarray(scores.argmax(axis=0), np.int64), scores.max(axis=0)
        chosen = np.flatnonzero(sure >= self._least)
        return _corners(raw[:4, chosen].T), labels[chosen], np.minimum(sure[chosen], 1)


class DetrNet:
    """A net with the heads of DETR, such as RF-DETR's, run by ONNX Runtime. Raises ConfigError.

    It gives logits (1, n, classes) and boxes (1, n, 4): middle and size, as shares of the picture.
    Scores are by sigmoid, or by softmax if the last class is "none", as in DETR's own heads.
    """

    def __init__(self, path: Path, classes: Sequence[str], config: RecognizerConfig) -> None:
        self._path, self._least = path, config.min_confidence
        self._size = _input_size(path)
        self._session = _session(path)
        self._input: str = self._session.get_inputs()[0].name
        self._outputs = [one.name for one in self._session.get_outputs()]
        logits, _ = self._run(np.zeros((*(self._size or (320, 320)), 3), np.uint8))
        self.classes = _named(classes, logits.shape[1], path)
        none = logits.shape[1] == len(classes) + 1
        self._softmax = none and "dets" not in self._outputs  # RF-DETR has none, but a sigmoid
        if len(classes) == len(COCO_IDS):
            self._softmax = logits.shape[1] == COCO_IDS[-1] + 2

    def find(self, picture: Picture) -> Found:
        """Find things in a picture (h, w, 3), RGB, of any size."""
        logits, boxes = self._run(picture)
        with np.errstate(all="ignore"):
            if self._softmax:
                scores = np.exp(logits - logits.max(axis=1, keepdims=True))
                scores = (scores / scores.sum(axis=1, keepdims=True))[:, :-1]
            else:
                scores = 1 / (1 + np.exp(-logits))
        scores = np.where(_named_ones(self.classes)[: scores.shape[1]], scores, 0)
        labels, sure = scores.argmax(axis=1), scores.max(axis=1)
        index = np.flatnonzero((sure >= self._least) & np.isfinite(boxes).all(axis=1))
        index = index[np.argsort(-sure[index], kind="stable")][:MAX_CANDIDATES]
        height, width = picture.shape[:2]
        sides = np.array((width, height, width, height))
        corners = np.clip(_corners(boxes[index]) * sides, 0, sides).astype(np.float32)
        return Found(corners, labels[index], sure[index].astype(np.float32), self.classes)

    def _run(self, picture: Picture) -> tuple[Floats, Floats]:
        """Return logits (n, classes) and boxes (n, 4)."""
        height, width = self._size or _rounded(picture)
        scaled = cv2.resize(picture.astype(np.float32), (width, height)) / 255
        normal = (scaled - np.array(MEAN, np.float32)) / np.array(DEVIATION, np.float32)
        made = self._answers(np.ascontiguousarray(normal.transpose(2, 0, 1)[None]))
        heads = [one for one in made if one.ndim == 3 and len(one) == 1]
        boxes = [one[0] for one in heads if one.shape[2] == 4]
        logits = [one[0] for one in heads if one.shape[2] != 4]
        if len(boxes) == len(heads) == 2:  # three classes, and none
            first = self._outputs[0] in BOXES
            boxes, logits = (boxes[:1], boxes[1:]) if first else (boxes[1:], boxes[:1])
        if len(boxes) != 1 or len(logits) != 1 or len(boxes[0]) != len(logits[0]):
            gives = ", ".join(_sizes(one.shape) for one in made)
            raise ConfigError(
                f"{self._path}: gives {gives}; layout `detr` expects logits 1 x n x classes and "
                "boxes 1 x n x 4"
            )
        return logits[0], boxes[0]

    def _answers(self, blob: Floats) -> list[NDArray[np.float32]]:
        try:
            return [np.asarray(one) for one in self._session.run(None, {self._input: blob})]
        except Exception as error:  # noqa: BLE001 - its errors have no base of their own
            why = str(error).strip().splitlines()[0][:160]
            raise ConfigError(f"{self._path}: cannot be run: {why}") from None


def _session(path: Path) -> Any:
    if not importlib.util.find_spec("onnxruntime"):
        raise ConfigError(f"{path}: layout `detr` {ORT}")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - its errors have no base of their own
        why = str(error).strip().splitlines()[0][:160]
        raise ConfigError(f"{path}: not a net that ONNX Runtime can run: {why}") from None


def _named(classes: Sequence[str], outputs: int, path: Path) -> tuple[str, ...]:
    """Return the class of each output; 80 labels of COCO are spread over its 90 numbers."""
    if len(classes) == len(COCO_IDS) and outputs > COCO_IDS[-1]:
        names = dict(zip(COCO_IDS, classes, strict=True))
        return tuple(names.get(number, "") for number in range(outputs))
    if outputs not in (len(classes), len(classes) + 1):
        raise ConfigError(f"{path}: {outputs} classes, but its labels have {len(classes)}")
    return (*classes, "")[:outputs]


def _known(labels: NDArray[np.int64], classes: Sequence[str]) -> NDArray[np.bool_]:
    """Return which labels have a name."""
    inside = (labels >= 0) & (labels < len(classes))
    named = _named_ones(classes)[np.clip(labels, 0, len(classes) - 1)]
    return np.asarray(inside & named, np.bool_)


def _named_ones(classes: Sequence[str]) -> NDArray[np.bool_]:
    """Return which classes have a name."""
    return np.array([bool(name) for name in classes])


def _corners(boxes: Floats) -> Floats:
    """Return left, top, right, bottom of boxes given by middle and size (n, 4)."""
    middles, halves = boxes[:, :2], boxes[:, 2:] / 2
    return np.concatenate([middles - halves, middles + halves], axis=1)


def _input_size(path: Path) -> tuple[int, int] | None:
    """Return height and width of a net's input; None for a dynamic one. Raises ConfigError."""
    shape = input_of(path).shape
    if len(shape) != 4 or shape[0] not in (None, 1) or shape[1] not in (None, 3):
        raise ConfigError(f"{path}: takes {_sizes(shape)}; expected one picture, 1 x 3 x h x w")
    height, width = shape[2:]
    return (height, width) if height and width else None


def _rounded(picture: Picture) -> tuple[int, int]:
    """Return height and width of a dynamic net for a picture: whole strides, at most 640."""
    height, width = picture.shape[:2]
    scale = min(1.0, LARGEST_PX / max(height, width))
    tall, wide = (-(-round(side * scale) // STRIDE_PX) * STRIDE_PX for side in (height, width))
    return tall, wide


def _run(net: cv2.dnn.Net, blob: Any, path: Path, advice: str) -> NDArray[Any]:
    """Return a net's output for a picture. Raises ConfigError if it cannot run."""
    try:
        net.setInput(blob)
        return np.asarray(net.forward())
    except cv2.error as error:
        raise ConfigError(f"{path}: cv2.dnn cannot run it: {reason(error)}; {advice}") from None


def _sizes(shape: Sequence[int | None]) -> str:
    return " x ".join("?" if side is None else str(side) for side in shape) or "nothing"
