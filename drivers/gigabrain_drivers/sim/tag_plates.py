"""AprilTags on plates, made of boxes, because viewers and cameras draw no textures."""

import importlib.util
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.world import Box, Pose
from gigabrain_zenoh.errors import ConfigError

PLATE_M, LAYER_M = 0.01, 0.001  # thickness of the plate, and of each layer on it
INSTALL = "tags need OpenCV; install it with: pip install 'gigabrain-zenoh[eyes]'"


def tag_plate(tag: int, family: str, face: Pose, height: float, size: float) -> list[Box]:
    """Return a white plate with a tag, facing along the yaw of `face`.

    `height` is that of its centre, `size` that of its black square [m]. Raises ConfigError.
    """
    if not importlib.util.find_spec("cv2"):
        raise ConfigError(INSTALL)
    from gigabrain_zenoh.vision.tags import cells  # cv2: 50 MB, for worlds with tags only

    try:
        white = cells(tag, family)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    count = len(white)
    cell = size / count
    edge = (count + 2) * cell / 2  # with a border of one white cell

    def box(left: float, right: float, low: float, high: float, layer: int, colour: str) -> Box:
        """Return a box on the plate, by its edges from the centre, as seen from the front [m]."""
        back = PLATE_M / 2 + 2 * LAYER_M if not layer else (2.5 - layer) * LAYER_M
        half = PLATE_M / 2 if not layer else LAYER_M / 2
        across = (left + right) / 2
        x = face.x - back * math.cos(face.yaw) - across * math.sin(face.yaw)
        y = face.y - back * math.sin(face.yaw) + across * math.cos(face.yaw)
        tall = high - low
        return Box(x, y, half, (right - left) / 2, tall, colour, face.yaw, height + low)

    boxes = [
        box(-edge, edge, -edge, edge, 0, "white"),
        box(-size / 2, size / 2, -size / 2, size / 2, 1, "black"),
    ]
    for left, top, right, bottom in rectangles(white):
        boxes.append(box(
            left * cell - size / 2, right * cell - size / 2,
            size / 2 - bottom * cell, size / 2 - top * cell, 2, "white",
        ))  # fmt: skip
    return boxes


def rectangles(cells: NDArray[np.bool_]) -> Iterator[tuple[int, int, int, int]]:
    """Yield rectangles that cover the true cells: left, top, right, bottom."""
    left = cells.copy()
    for top, first in np.argwhere(cells).tolist():
        if not left[top, first]:
            continue
        right = first
        while right < cells.shape[1] and left[top, right]:
            right += 1
        bottom = top + 1
        while bottom < len(cells) and left[bottom, first:right].all():
            bottom += 1
        left[top:bottom, first:right] = False
        yield first, top, right, bottom
