"""Views of a depth camera on a body whose tilt changes with each picture."""

import gc
import weakref

import numpy as np
import pytest

from gigabrain_zenoh.safety.depth import Up, view_of
from tests.unit.safety.depth_scene import CAMERA, SEEING

PIXELS = ((70, 90, 110), (80, 40, 120))  # rows and columns: far, left, and near on the right
Three = tuple[int, int, int]


@pytest.mark.parametrize(
    ("up", "above", "within", "below"),
    [
        ((0.0, 0.0), (1143, 413, 253), (754, 413, 253), (65535, 508, 299)),
        ((0.1, 0.0), (1143, 413, 253), (754, 413, 253), (65535, 1058, 447)),
        ((-0.1, 0.0), (478, 266, 185), (478, 266, 185), (65535, 508, 299)),
        ((0.0, 0.2), (1134, 413, 218), (754, 413, 218), (65535, 711, 299)),
        ((-0.3, -0.05), (182, 129, 107), (182, 129, 107), (65535, 508, 299)),
    ],
)
def test_the_floor_of_the_level_or_the_tilted_body_is_no_obstacle(
    up: Up, above: Three, within: Three, below: Three
) -> None:
    view = view_of(SEEING, CAMERA, up)
    for found, expected in ((view.above, above), (view.within, within), (view.below, below)):
        np.testing.assert_allclose(found[PIXELS].astype(int), expected, atol=1)


@pytest.mark.long
def test_few_views_are_cached_and_they_share_arrays_that_no_tilt_changes() -> None:
    level = view_of(SEEING, CAMERA)
    kept = []
    for number in range(1, 41):
        view = view_of(SEEING, CAMERA, (number / 100, 0.02))
        kept.append(weakref.ref(view.above))
        for name in ("rays", "flat", "own", "floor", "sure"):
            assert getattr(view, name) is getattr(level, name)
    del view
    gc.collect()
    assert sum(view() is not None for view in kept) <= 8
