"""The share of beams that a map rules out, by distances that are capped nearer than others."""

import numpy as np
import pytest

from gigabrain_zenoh.mapping.keyframes import Beams
from gigabrain_zenoh.mapping.likelihood_field import CONTRADICTION_CAP_M, contradiction, field_of

CELL = 0.05
AT = np.zeros(3)


def share(ends: list[tuple[float, float]], farthest: float) -> float:
    """Of beams from the middle of a free room of 6 m, with a wall at x = 1.5 m."""
    cells = np.zeros((120, 120), np.int8)
    cells[:, 90] = 100
    field = field_of(cells, CELL, (-3.0, -3.0), farthest)
    beams = Beams(np.array(ends), np.zeros((0, 2)), np.zeros(2))
    return contradiction(field, beams, AT)


@pytest.mark.long
def test_short_distances_tell_the_same_of_beams_as_long_ones() -> None:
    on_wall, through, amid = (1.52, 0.3), (2.5, 0.4), (-1.0, 0.2)
    for ends, expected in (
        ([on_wall], 0.0),
        ([on_wall, amid], 0.5),
        ([on_wall, on_wall, on_wall, amid], 0.25),
        ([on_wall, (1.3, 0.1)], 0.0),  # too near to the wall to be amid free ground
        ([on_wall, (1.2, 0.1)], 0.5),
    ):
        assert share(ends, CONTRADICTION_CAP_M) == share(ends, 2.0) == expected
    assert share([through], CONTRADICTION_CAP_M) == share([through], 2.0) >= 1.0
