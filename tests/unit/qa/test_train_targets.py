"""Training targets of the net, and augmentation of the training pictures."""

import cv2
import numpy as np
import pytest

from gigabrain_zenoh.qa.train.pictures import Labelled
from gigabrain_zenoh.qa.train.targets import augment, targets
from gigabrain_zenoh.vision.labels import CLASSES
from gigabrain_zenoh.vision.recognizer import decode


def labelled(*things, ignored=()):
    boxes = np.array([box for _, box in things], np.float32).reshape(-1, 4)
    labels = np.array([CLASSES.index(name) for name, _ in things], np.int64)
    picture = np.zeros((240, 320, 3), np.uint8)
    for x0, y0, x1, y1 in boxes.astype(int):
        picture[y0:y1, x0:x1] = 255
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    flags = np.array([k in ignored for k in range(len(things))], bool)
    return Labelled(jpeg, boxes, labels, np.ones(len(things), np.float32), flags)


def perfect_output(one):
    """Return a perfect net's output: logits by the heat, distances to the box's sides."""
    heat, _, boxes, weights = targets(one, 240, 320)
    rows, columns = np.indices(weights.shape) * 8 + 4
    middle = np.stack([columns, rows], -1)
    sides = np.concatenate([middle - boxes[..., :2], boxes[..., 2:] - middle], -1)
    logits = np.where(heat > 0.999, 4.0, -9.0)
    raw = np.log(np.maximum(sides, 0.3) / 16)
    return np.concatenate([logits, raw], -1).transpose(2, 0, 1).astype(np.float32)


@pytest.mark.parametrize("box", [(40, 60, 90, 200), (3, 4, 12, 14), (0, 0, 320, 240)])
def test_perfect_output_is_decoded_to_the_same_box(box):
    found = decode(perfect_output(labelled(("can", box))))
    assert found.names() == ("can",)
    assert found.boxes[0] == pytest.approx(box, abs=0.01)


def test_a_small_thing_before_a_large_one_keeps_its_cells():
    found = decode(
        perfect_output(labelled(("person", (40, 0, 200, 240)), ("can", (110, 110, 130, 130))))
    )
    boxes = dict(zip(found.names(), found.boxes.tolist(), strict=True))
    assert boxes["can"] == pytest.approx([110, 110, 130, 130], abs=0.01)


def test_an_ignored_thing_is_masked_in_its_class_only():
    heat, mask, _, weights = targets(labelled(("can", (40, 40, 80, 80)), ignored=(0,)), 240, 320)
    assert not heat.any()
    assert not weights.any()
    assert mask[7, 7, CLASSES.index("can")] == 0
    assert mask[7, 7, CLASSES.index("ball")] == 1


@pytest.mark.long
def test_boxes_move_with_the_augmented_picture():
    one = labelled(("cube", (100, 60, 180, 160)))
    for seed in range(30):
        picture, changed = augment(np.random.default_rng(seed), one, 320, 240)
        if changed.ignored[0]:
            continue
        x0, y0, x1, y1 = changed.boxes[0].astype(int)
        inside = picture[y0 + 3 : y1 - 3, x0 + 3 : x1 - 3].astype(float).mean()
        assert picture.shape == (240, 320, 3)
        assert inside > 100


@pytest.mark.long
def test_a_thing_that_is_mostly_cropped_is_ignored():
    one = labelled(("cube", (0, 60, 60, 160)))
    changes = [augment(np.random.default_rng(seed), one, 320, 240)[1] for seed in range(60)]
    small = [c for c in changes if c.boxes[0, 2] - c.boxes[0, 0] < 20]
    assert small
    assert all(c.ignored[0] for c in small)


@pytest.mark.long
def test_a_smaller_picture_has_smaller_boxes():
    one = labelled(("cube", (100, 60, 180, 160)))
    whole = [augment(np.random.default_rng(s), one, 320, 240)[1].boxes[0] for s in range(20)]
    half = [augment(np.random.default_rng(s), one, 160, 120)[1].boxes[0] for s in range(20)]
    sizes = [np.mean([box[2] - box[0] for box in boxes]) for boxes in (whole, half)]
    assert sizes[0] / sizes[1] == pytest.approx(2, abs=0.1)
    assert augment(np.random.default_rng(1), one, 160, 120)[0].shape == (120, 160, 3)
