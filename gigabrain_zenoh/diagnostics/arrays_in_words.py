"""Arrays of numbers in a line: how many, how large, how many that are no numbers."""

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas import arrays
from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.sensors import Image, LaserScan


class Summary(Struct, frozen=True, kw_only=True):
    """What is to be said of many numbers. The figures are of the finite ones."""

    count: int
    min: float | None = None
    median: float | None = None
    max: float | None = None
    nan: int = 0
    inf: int = 0

    def __str__(self) -> str:
        parts = [f"{self.count} values"]
        for name in ("min", "median", "max"):
            value = getattr(self, name)
            if value is not None:
                parts.append(f"{name} {value:.6g}")
        parts += [f"{n} {what}" for n, what in ((self.nan, "nan"), (self.inf, "inf")) if n]
        return ", ".join(parts)


def summary(values: Sequence[float] | NDArray[np.generic]) -> Summary:
    """Of numbers, whatever their shape."""
    numbers = np.asarray(values, dtype=np.float64).ravel()
    finite = numbers[np.isfinite(numbers)]
    return Summary(
        count=numbers.size,
        min=float(finite.min()) if finite.size else None,
        median=float(np.median(finite)) if finite.size else None,
        max=float(finite.max()) if finite.size else None,
        nan=int(np.isnan(numbers).sum()),
        inf=int(np.isinf(numbers).sum()),
    )


def array_of(message: Message) -> tuple[str, NDArray[np.generic]] | None:
    """The name of the field that holds an array, and the array; None where there is none."""
    if isinstance(message, LaserScan):
        return "ranges", arrays.ranges(message)
    if isinstance(message, OccupancyGrid):
        return "cells", arrays.cells(message)
    if isinstance(message, Image) and message.encoding != "jpeg":
        return "data", arrays.pixels(message)
    return None


def plain(value: float) -> float | str | None:
    """A number for JSON: null for what is no number, "inf" for what is beyond all."""
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")
