from itertools import pairwise

import cv2
import numpy as np
import pytest
from numpy.random import default_rng

from gigabrain_zenoh.kernels.images import connected_parts, dilated, squared_distance

RNG = default_rng(1)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.4, 0.7, 1.0])
def test_connected_parts_equal_those_of_opencv_ordered_by_first_cell(share: float) -> None:
    mask = RNG.random((60, 43)) < share
    count, labels = cv2.connectedComponents(mask.view(np.uint8))
    expected = sorted(np.flatnonzero(labels == label).tolist() for label in range(1, count))
    cells, starts = connected_parts(mask)
    assert starts[-1] == len(cells)
    parts = [sorted(cells[start:end].tolist()) for start, end in pairwise(starts)]
    assert parts == expected


@pytest.mark.parametrize(("before", "after"), [(0, 7), (1, 1), (2, 0), (0, 0)])
def test_dilation_equals_that_of_opencv(before: int, after: int) -> None:
    image = RNG.integers(0, 256, (31, 50)).astype(np.uint8)
    side = before + after + 1
    expected = cv2.dilate(image, np.ones((side, side), np.uint8), anchor=(before, before))
    np.testing.assert_array_equal(dilated(image, before, after), expected)


def test_distances_equal_those_of_opencv_up_to_the_cap() -> None:
    cells = np.where(RNG.random((80, 70)) < 0.01, np.int8(100), np.int8(0))
    exact = cv2.distanceTransform(
        np.where(cells, 0, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
    )
    distances = np.sqrt(squared_distance(cells, 12))
    expected = np.minimum(exact, 12)
    np.testing.assert_allclose(distances, expected, rtol=2e-7)  # OpenCV approximates roots
