"""Average precision on cases that were calculated by hand."""

import numpy as np
import pytest

from gigabrain_zenoh.qa.train.scores import Wanted, average_precision, table
from gigabrain_zenoh.vision.recognizer import Found

BOX, FAR = (0, 0, 10, 10), (50, 50, 60, 60)


def wanted(*boxes, label=0, ignored=()):
    n = len(boxes)
    flags = np.array([k in ignored for k in range(n)], bool)
    return Wanted(np.array(boxes, np.float32).reshape(-1, 4), np.full(n, label), flags)


def found(*pairs, label=0):
    boxes = np.array([box for box, _ in pairs], np.float32).reshape(-1, 4)
    sure = np.array([c for _, c in pairs], np.float32)
    return Found(boxes, np.full(len(pairs), label), sure)


def test_the_score_is_1_if_all_things_are_found_and_nothing_else():
    assert average_precision([found((BOX, 0.9))], [wanted(BOX)], 0) == 1.0


def test_the_score_is_0_if_nothing_is_found():
    assert average_precision([found()], [wanted(BOX)], 0) == 0.0


def test_a_wrong_box_with_higher_confidence_halves_precision():
    guess = found((FAR, 0.9), (BOX, 0.8))
    assert average_precision([guess], [wanted(BOX)], 0) == pytest.approx(0.5)


def test_half_of_the_things_found_gives_51_of_101_points():
    truth = wanted(BOX, FAR)
    assert average_precision([found((BOX, 0.9))], [truth], 0) == pytest.approx(51 / 101)


def test_a_second_box_on_one_thing_is_wrong():
    truths = [wanted(BOX, FAR)]
    guess = found((BOX, 0.9), (BOX, 0.8), (FAR, 0.7))
    assert average_precision([guess], truths, 0) == pytest.approx((51 + 50 * 2 / 3) / 101)


def test_a_box_on_an_ignored_thing_does_not_count():
    truth = wanted(BOX, FAR, ignored=(1,))
    guess = found((FAR, 0.9), (BOX, 0.8))
    assert average_precision([guess], [truth], 0) == 1.0


def test_overlap_of_less_than_a_half_is_wrong():
    assert average_precision([found(((0, 0, 10, 4.9), 0.9))], [wanted(BOX)], 0) == 0.0
    assert average_precision([found(((0, 0, 10, 5.1), 0.9))], [wanted(BOX)], 0) == 1.0


def test_boxes_of_another_picture_or_class_do_not_count():
    guesses = [found((BOX, 0.9)), found()]
    assert average_precision(guesses, [wanted(), wanted(BOX)], 0) == 0.0
    assert average_precision([found((BOX, 0.9), label=1)], [wanted(BOX)], 0) == 0.0


def test_a_class_without_things_has_no_score():
    scores = table([found((BOX, 0.9))], [wanted(BOX)])
    assert scores["cube"] == 1.0
    assert np.isnan(scores["door"])
