"""`gigabrain bench slam`: maps from recorded logs and simulated worlds, against what is true."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.bench.slam import Drive, SlamResult
    from gigabrain_zenoh.bench.slam_logs import Log

WIDE = 140  # columns of what is not printed on a terminal


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
    robot passed at different times. A log is an .npz file with `ranges` [cm] (scans, beams),
    counter-clockwise over 180°, and poses `ref` and `odom` (scans, 3).

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

    from gigabrain_zenoh import results
    from gigabrain_zenoh.bench.slam import judged, total
    from gigabrain_zenoh.bench.slam_logs import load, relations
    from gigabrain_zenoh.bench.slam_picture import draw

    results.check_place(json)
    logs = [load(path) for path in paths]
    for one in logs:
        relations(one)  # or it says at once what is wrong
    drives = _driven(logs)
    result = total([judged(one, driven) for one, driven in drives])
    if png:
        draw(drives, png)
    results.write(result, json)
    console = Console()
    console = console if console.is_terminal else Console(width=WIDE)
    console.print(_table(result))
    return 0


def _driven(logs: "list[Log]") -> "list[tuple[Log, Drive]]":
    from functools import partial

    from rich.console import Console
    from rich.progress import Progress

    from gigabrain_zenoh.bench.slam import drive
    from gigabrain_zenoh.mapping.warm import warm_up

    with Progress(console=Console(stderr=True), transient=True) as progress:
        compiling = progress.add_task("compiling", total=None)
        warm_up()
        progress.remove_task(compiling)
        tasks = [progress.add_task(one.name, total=len(one.ranges)) for one in logs]
        return [
            (one, drive(one, partial(progress.advance, task)))
            for one, task in zip(logs, tasks, strict=True)
        ]


def _table(result: "SlamResult") -> "Table":
    from rich.table import Table

    table = Table(
        title="Errors of relations, mean ± standard deviation",
        caption=f"graph, mean of the logs {result.mean_m:.3f} m; memory at most "
        f"{result.peak_mb:.0f} MB. Times are of the CPU.",
    )
    for title in ("log", "scans", "beams", "odometry", "front end", "graph"):
        table.add_column(title, justify="left" if title == "log" else "right")
    for title in ("loops", "not matched", "breaks", "scan p50, p99", "loop p99, max"):
        table.add_column(title, justify="right")
    for one in result.logs:
        table.add_row(
            one.log,
            str(one.scans),
            str(one.beams),
            f"{one.odometry.mean_m:.2f} m",
            f"{one.front_end.mean_m:.2f} m",
            f"{one.graph.mean_m:.3f} ± {one.graph.std_m:.3f} m, {one.graph.mean_deg:.2f}°",
            str(one.loops),
            str(one.unmatched),
            str(one.breaks),
            f"{one.scan.p50_ms:.1f}, {one.scan.p99_ms:.1f} ms",
            f"{one.loop.p99_ms:.1f}, {one.loop_max_ms:.1f} ms",
        )
    return table
