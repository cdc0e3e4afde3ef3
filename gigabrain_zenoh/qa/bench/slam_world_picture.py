"""Maps of simulated worlds, with the way as mapped and as driven."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gigabrain_schemas.arrays import cells
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.bench.slam_picture import DOTS, DRIVEN, REFERENCE, SIDE
from gigabrain_zenoh.qa.bench.slam_world import Toured

UNKNOWN = 55  # grey between free and occupied, in percent of black


def draw(worlds: Sequence[Toured], to: Path) -> None:
    """Draw the maps side by side. Raises ConfigError."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ConfigError(
            "pictures need matplotlib: pip install 'gigabrain-zenoh[record]'"
        ) from None
    figure = Figure(figsize=(SIDE * len(worlds), SIDE), layout="constrained")
    for axes, one in zip(figure.subplots(1, len(worlds), squeeze=False).flat, worlds, strict=True):
        grid, shown = one.grid, cells(one.grid).astype(np.int16)
        shown[shown < 0] = UNKNOWN
        left, low = grid.origin_x, grid.origin_y
        right, high = left + grid.width * grid.resolution, low + grid.height * grid.resolution
        axes.imshow(
            100 - shown, "gray", origin="lower", extent=(left, right, low, high), vmin=0, vmax=100
        )
        axes.plot(*one.truth[:, :2].T, color=REFERENCE, linewidth=1.2, label="true")
        axes.plot(*one.poses[:, :2].T, color=DRIVEN, linewidth=0.8, label="as mapped")
        axes.set_title(one.result.world)
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        axes.legend(loc="best")
    try:
        figure.savefig(to, format="png", dpi=DOTS)
    except OSError as error:
        raise ConfigError(f"cannot write {to}: {error.strerror}") from None
