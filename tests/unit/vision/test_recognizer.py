"""The runner of the net: what it makes of raw answers, and of pictures of any size."""

import numpy as np
import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.vision.labels import CLASSES
from gigabrain_zenoh.vision.recognizer import Recognizer, decode, fit, suppress

BALL, CAN = CLASSES.index("ball"), CLASSES.index("can")


def raw(*things: tuple[int, int, int, float, tuple[float, float, float, float]]) -> np.ndarray:
    """An answer with some cells: class, row, column, logit, distances to the sides [px]."""
    cells = np.full((13, 30, 40), -9.0, np.float32)
    for label, row, column, logit, distances in things:
        cells[label, row, column] = logit
        cells[9:, row, column] = np.log(np.array(distances) / 16)
    return cells


def test_a_cell_tells_class_confidence_and_the_box_around_its_middle():
    found = decode(raw((BALL, 10, 20, 2.0, (8, 16, 24, 32))))
    assert found.names() == ("ball",)
    assert found.confidences == pytest.approx([0.8808], abs=1e-4)
    assert found.boxes == pytest.approx(np.array([[156, 68, 188, 116]]), abs=1e-3)


def test_of_overlapping_boxes_of_one_class_the_surest_is_kept():
    sides = (20.0, 20.0, 20.0, 20.0)
    found = decode(raw((BALL, 10, 20, 1.0, sides), (BALL, 10, 21, 2.0, sides)))
    assert found.names() == ("ball",)
    assert found.boxes[0, 0] == pytest.approx(152)


def test_overlapping_boxes_of_two_classes_are_both_kept_surest_first():
    sides = (10.0, 10.0, 10.0, 10.0)
    found = decode(raw((BALL, 10, 20, 1.0, sides), (CAN, 10, 20, 2.0, sides)))
    assert found.names() == ("can", "ball")


def test_boxes_apart_are_both_kept():
    boxes = np.array([[0, 0, 10, 10], [20, 0, 30, 10]], np.float32)
    assert suppress(boxes, np.zeros(2, int), np.array([0.5, 0.6], np.float32)).tolist() == [1, 0]


def test_what_is_unsure_is_left_out():
    cells = raw((BALL, 10, 20, -0.5, (8, 8, 8, 8)))
    assert len(decode(cells, 0.3)) == 1
    assert len(decode(cells, 0.5)) == 0


def test_boxes_end_at_the_edges():
    found = decode(raw((BALL, 0, 0, 3.0, (90, 90, 510, 510))))
    assert found.boxes.tolist() == [[0, 0, 320, 240]]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_net_that_answers_nonsense_gives_boxes_inside_the_picture_or_none(value):
    found = decode(np.full((13, 30, 40), value, np.float32))
    assert np.isfinite(found.boxes).all()
    assert (found.boxes >= 0).all()


def test_a_picture_of_another_shape_is_scaled_into_the_middle():
    fitted, scale, left, top = fit(np.zeros((480, 480, 3), np.uint8))
    assert fitted.shape == (240, 320, 3)
    assert (scale, left, top) == (0.5, 40, 0)
    assert (fitted[0, 39], fitted[0, 40]) == (pytest.approx([114] * 3), pytest.approx([0] * 3))


def test_weights_that_are_none_are_refused_in_one_line(tmp_path):
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(b"no net")
    with pytest.raises(ConfigError, match=r"bad\.onnx") as refused:
        Recognizer(bad)
    assert "\n" not in str(refused.value)
    with pytest.raises(ConfigError, match=r"missing\.onnx"):
        Recognizer(tmp_path / "missing.onnx")
