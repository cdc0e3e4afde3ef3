"""`gigabrain bench slam`: maps from recorded logs and simulated worlds, against what is true."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.side_by_side import side_by_side
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import files

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.qa.bench.slam_logs import LaserLog, MappedLog, SlamResult


def slam(
    *,
    log: Annotated[tuple[Path, ...], Parameter(consume_multiple=True)] = (),
    world: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = (),
    minutes: float = 10.0,
    body: str = "turtlebot3_waffle",
    seed: int = 0,
    png: Path | None = None,
    json: Path | None = None,
) -> int:
    """Map recorded laser logs or simulated worlds, and tell how far the maps are from the truth.

    Example: gigabrain bench slam --log intel.npz fhw.npz --png maps.png
    Example: gigabrain bench slam --world house warehouse --minutes 10 --png maps.png

    Errors are those of Kümmerle et al. (2009): of poses that are near one another, and that the
    robot passed at different times. Crispness is the number of 0.1 m cells that all scans fill, per
    cell that they fill at the reference poses: below 1 is better. A log is an .npz file with
    `ranges` [cm] (scans, beams), counter-clockwise over 180°, and poses `ref` and `odom`
    (scans, 3).

    Parameters
    ----------
    log
        The logs, one or more files.
    world
        Worlds that a simulated robot roams instead; see `gigabrain worlds`. Errors are of all its
        poses then, against the physics.
    minutes
        How long it roams each [min of its own time].
    body
        Which robot roams; see `gigabrain robots`.
    seed
        For its start and the noise of its sensors.
    png
        Draw the maps into this file.
    json
        Write all figures into this file.
    """
    if bool(log) == bool(world):
        raise ConfigError("expected --log with .npz files, or --world with names of worlds")
    if world:
        from gigabrain_zenoh.cli.bench_slam_world import slam_world

        return slam_world(world, minutes, body, seed, png, json)
    return _slam_logs(log, png, json)


def _slam_logs(paths: tuple[Path, ...], png: Path | None, json: Path | None) -> int:
    """Map what was recorded, and show how far the maps are from the reference."""
    from rich.console import Console

    from gigabrain_zenoh.qa.bench.slam_logs import draw_logs, judge_log, load, relations, total

    files.check_result_path(json)
    logs = [load(path) for path in paths]
    for one in logs:
        relations(one)  # or it says at once what is wrong
    drives = _driven(logs)
    result = total([judge_log(one, driven) for one, driven in drives])
    if png:
        draw_logs(drives, png)
    files.write_result(result, json)
    Console().print(_table(result))
    return 0


def _driven(logs: "list[LaserLog]") -> "list[tuple[LaserLog, MappedLog]]":
    from functools import partial

    from rich.console import Console
    from rich.progress import Progress

    from gigabrain_zenoh.mapping.slam_map import warm_up
    from gigabrain_zenoh.qa.bench.slam_logs import map_log

    with Progress(console=Console(stderr=True), transient=True) as progress:
        compiling = progress.add_task("compiling", total=None)
        warm_up()
        progress.remove_task(compiling)
        tasks = [progress.add_task(one.name, total=len(one.ranges)) for one in logs]
        return [
            (one, map_log(one, partial(progress.advance, task)))
            for one, task in zip(logs, tasks, strict=True)
        ]


def _table(result: "SlamResult") -> "Table":
    logs = result.logs
    return side_by_side(
        "Errors of relations: mean ± standard deviation",
        f"graph, mean of the logs {result.mean_m:.3f} m; memory at most "
        f"{result.peak_mb:.0f} MB. Times are of the CPU.",
        [one.log for one in logs],
        {
            "odometry [m]": [f"{one.odometry.mean_m:.2f}" for one in logs],
            "front end [m]": [f"{one.front_end.mean_m:.2f}" for one in logs],
            "graph [m]": [f"{one.graph.mean_m:.3f} ± {one.graph.std_m:.3f}" for one in logs],
            "graph [°]": [f"{one.graph.mean_deg:.2f}" for one in logs],
            "crispness": [f"{one.crispness:.3f}" for one in logs],
            "scans, beams": [f"{one.scans}, {one.beams}" for one in logs],
            "loops closed": [str(one.loops) for one in logs],
            "scans not matched": [str(one.unmatched) for one in logs],
            "breaks": [str(one.breaks) for one in logs],
            "scan p50, p99 [ms]": [f"{one.scan.p50_ms:.1f}, {one.scan.p99_ms:.1f}" for one in logs],
            "loop p99, max [ms]": [f"{one.loop.p99_ms:.1f}, {one.loop_max_ms:.1f}" for one in logs],
        },
    )
