"""Average precision compared with that of the independent `hotcoco`, on random findings."""

import json

import numpy as np
import pytest

from gigabrain_zenoh.qa.train.scores import Wanted, table
from gigabrain_zenoh.vision.labels import CLASSES
from gigabrain_zenoh.vision.recognizer import Found

judge = pytest.importorskip("hotcoco")


def random_case(rng, pictures):
    """Return random findings and truths: some ignored, found twice, wrong, or missed."""
    truths, guesses = [], []
    for _ in range(pictures):
        n = int(rng.integers(0, 6))
        corner = rng.uniform(0, 200, (n, 2))
        boxes = np.concatenate([corner, corner + rng.uniform(8, 100, (n, 2))], 1)
        labels, ignored = rng.integers(0, len(CLASSES), n), rng.random(n) < 0.15
        truths.append(Wanted(boxes.astype(np.float32), labels, ignored))
        near = np.repeat(np.arange(n), rng.integers(0, 3, n))
        found = boxes[near] + rng.normal(0, 6, (len(near), 4))
        found[:, 2:] = np.maximum(found[:, 2:], found[:, :2] + 2)
        wrong = rng.random(len(near)) < 0.1
        kinds = np.where(wrong, rng.integers(0, len(CLASSES), len(near)), labels[near])
        sure = rng.permutation(len(near)) / 100 + rng.uniform(0, 0.9, len(near))
        guesses.append(Found(found.astype(np.float32), kinds, sure.astype(np.float32)))
    return guesses, truths


def judged(guesses, truths, folder):
    """Return hotcoco's average precision of each class at an IoU of 0.5."""
    annotations, results = [], []
    for image, (guess, truth) in enumerate(zip(guesses, truths, strict=True), 1):
        for box, label, ignored in zip(truth.boxes, truth.labels, truth.ignored, strict=True):
            sized = [*box[:2].tolist(), *(box[2:] - box[:2]).tolist()]
            annotations.append(
                {"id": len(annotations) + 1, "image_id": image, "category_id": int(label) + 1,
                 "bbox": sized, "area": sized[2] * sized[3], "iscrowd": int(ignored)}
            )  # fmt: skip
        for box, label, sure in zip(guess.boxes, guess.labels, guess.confidences, strict=True):
            sized = [*box[:2].tolist(), *(box[2:] - box[:2]).tolist()]
            results.append(
                {
                    "image_id": image,
                    "category_id": int(label) + 1,
                    "bbox": sized,
                    "score": float(sure),
                }
            )
    images = [{"id": k + 1, "width": 320, "height": 240} for k in range(len(truths))]
    categories = [{"id": k + 1, "name": name} for k, name in enumerate(CLASSES)]
    (folder / "truth.json").write_text(
        json.dumps({"images": images, "annotations": annotations, "categories": categories})
    )
    (folder / "found.json").write_text(json.dumps(results))
    truth = judge.COCO(str(folder / "truth.json"))
    evaluation = judge.COCOeval(truth, truth.load_res(str(folder / "found.json")), "bbox")
    evaluation.evaluate()
    evaluation.accumulate()
    precision = np.asarray(evaluation.eval["precision"])[0, :, :, 0, -1]  # IoU 0.5, all sizes
    return dict(zip(CLASSES, precision.mean(axis=0), strict=True))


@pytest.mark.parametrize("seed", range(5))
def test_average_precision_is_that_of_hotcoco(seed, tmp_path):
    guesses, truths = random_case(np.random.default_rng(seed), 60)
    ours, theirs = table(guesses, truths), judged(guesses, truths, tmp_path)
    assert 0.2 < ours["can"] < 0.98
    for name in CLASSES:
        assert ours[name] == pytest.approx(theirs[name], abs=1e-6), name
