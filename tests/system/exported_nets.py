"""Export nets with random weights from their own packages, and compare our boxes with theirs.

`test_exported_nets.py` starts it in a separate environment: `python exported_nets.py NAME FOLDER`.
Prints a line of JSON: the numbers of boxes, and the largest differences.
"""

import json
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from gigabrain_zenoh.config.settings import RecognizerConfig
from gigabrain_zenoh.vision.nets import load_net

warnings.filterwarnings("ignore")
WANTED_BOXES = 12  # with the highest confidence
SCORE_TOLERANCE = 0.002  # boxes this close to the minimum score may be missing
# torchvision may have its operators for GPUs only; it is imported, but they are not called
OPERATORS = torch.library.Library("torchvision", "FRAGMENT")
for operator in ("nms", "qnms"):
    if not hasattr(torch.ops.torchvision, operator):
        OPERATORS.define(f"{operator}(Tensor dets, Tensor scores, float threshold) -> Tensor")
Boxes = tuple[np.ndarray, np.ndarray, np.ndarray]  # corners [px], labels, confidences
Judge = Callable[[float], Boxes]  # minimum score -> boxes, overlapping ones too


def picture() -> np.ndarray:
    """Return an RGB picture (240, 320, 3) with edges and colours."""
    rng = np.random.default_rng(5)
    blocks = rng.integers(0, 255, (12, 16, 3), dtype=np.uint8)
    return cv2.resize(blocks, (320, 240), interpolation=cv2.INTER_CUBIC)


def vary_scores(model: Any) -> None:
    """Vary the scores of a YOLO net with random weights; else all boxes are alike."""
    net = model.model
    norms = [one for one in net.modules() if isinstance(one, torch.nn.BatchNorm2d)]
    for norm in norms:
        norm.momentum = None  # average all pictures
        norm.reset_running_stats()
    seen = np.stack([np.roll(picture(), 40 * n, axis=1) for n in range(4)])
    blob = torch.from_numpy(seen.transpose(0, 3, 1, 2)[:, :, :224].copy()).float() / 255
    net.train()
    with torch.no_grad():
        net(blob)
    net.eval()
    for branch in net.model[-1].cv3:
        branch[-1].bias.data[:] = -2.0


def yolo(name: str, folder: Path, **export: Any) -> tuple[Path, Judge]:
    """Export a YOLO; its judge is ONNX Runtime, with ultralytics' letterbox and scaling."""
    import onnxruntime
    from ultralytics import YOLO
    from ultralytics.data.augment import LetterBox
    from ultralytics.utils.ops import scale_boxes, xywh2xyxy

    model = YOLO(f"{name}.yaml")
    vary_scores(model)
    made = Path(model.export(format="onnx", simplify=False, **export))
    path = made.rename(folder / f"{name}.onnx")

    def judge(min_score: float) -> Boxes:
        fitted = LetterBox(export["imgsz"], auto=False)(image=picture())
        blob = fitted.transpose(2, 0, 1)[None].astype(np.float32) / 255
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        (raw,) = session.run(None, {session.get_inputs()[0].name: blob})[0]
        scores = raw[4:].max(axis=0)
        chosen = scores >= min_score
        boxes = torch.from_numpy(xywh2xyxy(raw[:4].T[chosen]))
        corners = scale_boxes(export["imgsz"], boxes, (240, 320)).numpy()
        return corners, raw[4:].argmax(axis=0)[chosen], scores[chosen]

    return path, judge


def rf_detr(folder: Path) -> tuple[Path, Judge]:
    """Export an RF-DETR; its judge is its package's own inference, by ONNX Runtime."""
    from rfdetr import RFDETRNano
    from rfdetr.export._onnx.inference import _create_onnx_session, _run_inference

    model = RFDETRNano(pretrain_weights=None, device="cpu")
    model.model.model.class_embed.weight.data *= 1.5
    model.model.model.class_embed.bias.data[:] = 0.0
    path = Path(model.export(output_dir=str(folder)))
    cv2.imwrite(str(folder / "picture.png"), picture()[..., ::-1])

    def judge(min_score: float) -> Boxes:
        session = _create_onnx_session(str(path))
        found, _ = _run_inference(
            session,
            folder / "picture.png",
            threshold=min_score,
            num_select=300 * 91,
            background_class_id=None,
        )
        sides = np.array((320, 240, 320, 240))
        return np.clip(found.xyxy, 0, sides), found.class_id, found.confidence

    return path, judge


def detr(folder: Path) -> tuple[Path, Judge]:
    """Export a DETR; its judge is torch, with the post-processing of its package."""
    from transformers import DetrConfig, DetrForObjectDetection, ResNetConfig
    from transformers.models.detr.image_processing_detr import DetrImageProcessor

    small = ResNetConfig(
        embedding_size=16, hidden_sizes=[16, 32, 64, 128], depths=[1] * 4, out_features=["stage4"]
    )
    size = {"d_model": 64, "encoder_layers": 1, "decoder_layers": 1, "num_queries": 40}
    heads = {"encoder_attention_heads": 4, "decoder_attention_heads": 4}
    config = DetrConfig(backbone_config=small, num_labels=91, **size, **heads)
    model = DetrForObjectDetection(config).eval().requires_grad_(False)
    model.class_labels_classifier.weight.data *= 8
    path = folder / "detr.onnx"

    class Heads(torch.nn.Module):
        def forward(self, pixel_values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            made = model(pixel_values=pixel_values)
            return made.logits, made.pred_boxes

    names = {"input_names": ["pixel_values"], "output_names": ["logits", "pred_boxes"]}
    blank = (torch.zeros(1, 3, 256, 320),)
    torch.onnx.export(Heads(), blank, str(path), dynamo=False, opset_version=17, **names)

    def judge(min_score: float) -> Boxes:
        scaled = cv2.resize(picture().astype(np.float32), (320, 256)) / 255
        normal = (scaled - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
        blob = torch.from_numpy(normal.astype(np.float32).transpose(2, 0, 1)[None])
        with torch.no_grad():
            made = model(pixel_values=blob)
        (found,) = DetrImageProcessor.post_process_object_detection(
            None, made, threshold=min_score, target_sizes=[(240, 320)]
        )
        found = {key: value.numpy() for key, value in found.items()}
        sides = np.array((320, 240, 320, 240))
        return np.clip(found["boxes"], 0, sides), found["labels"], found["scores"]

    return path, judge


def compare(path: Path, judge: Judge, layout: str, classes: int) -> dict[str, Any]:
    """Compare our boxes with all boxes of the judge.

    Returns the largest differences from the judge's boxes, and how many of those we miss. A box of
    a YOLO also counts as found if we have a surer, overlapping one of its class.
    """
    (path.parent / "labels.txt").write_text("\n".join(f"class{n}" for n in range(classes)))
    labels = str(path.parent / "labels.txt")
    settings = {"onnx": str(path), "labels": labels, "layout": layout}
    most = load_net(RecognizerConfig(**settings, min_confidence=0.01)).find(picture())
    min_score = float(most.confidences[WANTED_BOXES]) - 1e-6
    found = load_net(RecognizerConfig(**settings, min_confidence=min_score)).find(picture())
    boxes, kinds, scores = judge(min_score - SCORE_TOLERANCE)
    off_px, off_score = 0.0, 0.0
    for box, label, score in zip(found.boxes, found.labels, found.confidences, strict=True):
        same = np.flatnonzero(kinds == label)
        off = np.abs(boxes[same] - box).max(axis=1) + 1e4 * np.abs(scores[same] - score)
        off_px = max(off_px, float(np.abs(boxes[same[off.argmin()]] - box).max()))
        off_score = max(off_score, abs(float(scores[same[off.argmin()]]) - float(score)))
    missed, confident = 0, scores > min_score + SCORE_TOLERANCE
    for box, label, score in zip(
        boxes[confident], kinds[confident], scores[confident], strict=True
    ):
        shared = overlap(found.boxes, box)
        if layout == "yolo":
            missed += not ((found.labels == label) & (found.confidences > score - 1e-6)
                           & (shared > 0.49)).any()  # fmt: skip
        else:
            missed += not (np.abs(found.boxes - box).max(axis=1) < 0.1).any()
    return {
        "judged": len(boxes), "found": len(found), "missed": missed,
        "off_px": off_px, "off_score": off_score,
    }  # fmt: skip


def overlap(boxes: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return the intersection over union of each of `boxes` with `box`."""
    low, high = np.maximum(boxes[:, :2], box[:2]), np.minimum(boxes[:, 2:], box[2:])
    shared = np.clip(high - low, 0, None).prod(axis=1)
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    return shared / (areas + (box[2:] - box[:2]).prod() - shared)


def main(name: str, folder: Path) -> None:
    """Export and compare one net."""
    torch.manual_seed(0)
    os.chdir(folder)
    if name == "detr":
        print(json.dumps(compare(*detr(folder), "detr", 91)))
    elif name == "rf_detr":
        print(json.dumps(compare(*rf_detr(folder), "detr", 91)))
    else:
        model, _, dynamic = name.partition("-")
        how: dict[str, Any] = {"imgsz": (256, 320), "dynamic": bool(dynamic)}
        print(json.dumps(compare(*yolo(model, folder, **how), "yolo", 80)))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
