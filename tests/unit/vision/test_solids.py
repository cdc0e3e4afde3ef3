"""Things that are found in a depth picture, and those of which a part cannot be seen."""

import numpy as np
import pytest

from gigabrain_schemas.body import Camera
from gigabrain_zenoh.vision.camera_model import CameraModel
from gigabrain_zenoh.vision.depth_picture import DepthCamera
from gigabrain_zenoh.vision.solid_fit import SolidFit
from gigabrain_zenoh.vision.solids import find_solids
from tests.unit.vision.scenes import Box, depth_of, millimetres

LOW = Camera(name="front", depth=True, x=0.0, z=0.15, pitch=0.6, depth_min=0.15)


def found(*boxes: Box) -> list[SolidFit]:
    camera = DepthCamera(CameraModel(LOW), 0.5)
    view = camera.view(millimetres(LOW, depth_of(LOW, boxes)))
    assert view
    return find_solids(view, camera.model, np.zeros(len(view.obstacles), bool))


def cube(x: float) -> Box:
    return Box(x=x, y=0.0, half_x=0.04, half_y=0.04, top=0.08)


def test_a_thing_ahead_is_found() -> None:
    (one,) = found(cube(0.3))
    assert one.position == pytest.approx((0.3, 0.0, 0.04), abs=0.003)
    assert one.size == pytest.approx((0.08, 0.08, 0.08), abs=0.004)


@pytest.mark.parametrize("x", [0.16, 0.18])
def test_a_thing_is_not_found_by_a_part_whose_rest_is_nearer_than_the_camera_measures(
    x: float,
) -> None:
    assert found(cube(x)) == []
