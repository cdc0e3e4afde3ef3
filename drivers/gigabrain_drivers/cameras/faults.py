"""Faults of simulated cameras, for tests; set by the parameter `NAME_fault`."""

from typing import Literal, get_args

import numpy as np

from gigabrain_drivers.cameras.base import Frame

CameraFault = Literal["none", "frozen", "repeats", "covered", "dark", "bright", "unplugged"]
FAULTS: tuple[CameraFault, ...] = get_args(CameraFault)
DARK_GREY, BRIGHT_GREY = 6, 252  # of 255
REPEATS = 3  # equal pictures in a row, for the fault `repeats`


class FaultyCamera:
    """Applies a fault to exposures. `fault` may be set at any time."""

    def __init__(self) -> None:
        self.fault: CameraFault = "none"
        self._last: Frame | None = None
        self._count = 0

    def put(self, name: str) -> None:
        """Set the fault. Raises ValueError for an unknown one."""
        if name not in FAULTS:
            raise ValueError(name)
        self.fault = name

    def spoil(self, frame: Frame) -> Frame | None:
        """Return the exposure with the fault applied; None for an unplugged camera."""
        self._count += 1
        fault, last = self.fault, self._last
        if fault == "unplugged":
            return None
        if last and (fault == "frozen" or (fault == "repeats" and self._count % REPEATS)):
            return Frame(last.picture, last.depth, frame.tick, frame.stamp_ns)
        self._last = frame
        if fault in ("covered", "dark"):
            return _flat(frame, DARK_GREY, covered=fault == "covered")
        return _flat(frame, BRIGHT_GREY, covered=False) if fault == "bright" else frame


def _flat(frame: Frame, grey: int, *, covered: bool) -> Frame:
    """Return a uniformly grey exposure with the picture's noise; without depth if covered."""
    picture, depth = frame.picture, frame.depth
    if picture is not None:
        noise = picture % 4
        picture = noise + np.uint8(grey)
    if covered and depth is not None:
        depth = np.zeros_like(depth)
    return Frame(picture, depth, frame.tick, frame.stamp_ns)
