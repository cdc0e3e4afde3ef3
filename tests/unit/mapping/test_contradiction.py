"""The share of beams that a map rules out does not depend on the cap of distances."""

import numpy as np
import pytest

from gigabrain_zenoh.mapping.keyframes import Beams
from gigabrain_zenoh.mapping.likelihood_field import CONTRADICTION_CAP_M, contradiction, field_of

CELL = 0.05
POSE = np.zeros(3)


def ruled_out(ends: list[tuple[float, float]], farthest: float) -> float:
    """Return the share for beams from the middle of a free room of 6 m with a wall at x = 1.5 m."""
    cells = np.zeros((120, 120), np.int8)
    cells[:, 90] = 100
    field = field_of(cells, CELL, (-3.0, -3.0), farthest)
    beams = Beams(np.array(ends), np.zeros((0, 2)), np.zeros(2))
    return contradiction(field, beams, POSE)


@pytest.mark.long
def test_capped_distances_rule_out_the_same_beams_as_long_ones() -> None:
    on_wall, through, in_free = (1.52, 0.3), (2.5, 0.4), (-1.0, 0.2)
    for ends, expected in (
        ([on_wall], 0.0),
        ([on_wall, in_free], 0.5),
        ([on_wall, on_wall, on_wall, in_free], 0.25),
        ([on_wall, (1.3, 0.1)], 0.0),  # too near to the wall to be in free space
        ([on_wall, (1.2, 0.1)], 0.5),
    ):
        assert ruled_out(ends, CONTRADICTION_CAP_M) == ruled_out(ends, 2.0) == expected
    assert ruled_out([through], CONTRADICTION_CAP_M) == ruled_out([through], 2.0) >= 1.0
