"""The maps of recorded logs, as a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.se2 import transform
from gigabrain_zenoh.qa.bench.slam import Drive
from gigabrain_zenoh.qa.bench.slam_logs import Log, laid_onto

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIDE = 7.0  # [inch] of each map
DOTS = 130  # per inch
WALLS, DRIVEN, REFERENCE = "#1d2733", "#d9480f", "#1c7ed6"


def draw(drives: Sequence[tuple[Log, Drive]], to: Path) -> None:
    """Draw each map with the way that was driven, side by side. Raises ConfigError."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ConfigError(
            "pictures need matplotlib: pip install 'gigabrain-zenoh[record]'"
        ) from None
    columns = min(len(drives), 2)
    rows = -(-len(drives) // columns)
    figure = Figure(figsize=(SIDE * columns, SIDE * rows), layout="constrained")
    cells = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in cells:
        axes.set_axis_off()
    for axes, (log, driven) in zip(cells, drives, strict=False):
        _map(axes, log, driven)
    try:
        figure.savefig(to, format="png", dpi=DOTS)
    except OSError as error:
        raise ConfigError(f"cannot write {to}: {error.strerror}") from None


def _map(axes: "Axes", log: Log, driven: Drive) -> None:
    keyframes = zip(driven.slam.poses, driven.slam.keyframes, strict=True)
    walls = np.concatenate([transform(pose, keyframe.points) for pose, keyframe in keyframes])
    poses = driven.poses()
    reference = laid_onto(log.reference, poses)
    axes.set_axis_on()
    axes.plot(*walls.T, ",", color=WALLS, alpha=0.3)
    axes.plot(*reference[:, :2].T, color=REFERENCE, linewidth=1.2, label="reference")
    axes.plot(*poses[:, :2].T, color=DRIVEN, linewidth=0.8, label="as mapped")
    axes.set_title(log.name)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(loc="best")
