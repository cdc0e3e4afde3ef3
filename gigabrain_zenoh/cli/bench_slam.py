"""`gigabrain bench slam`: maps from recorded logs and simulated worlds, against what is true."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.bench.slam import Drive, SlamResult
    from gigabrain_zenoh.bench.slam_logs import Errors, Log


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
    from rich.console import Console

    from gigabrain_zenoh import results
    from gigabrain_zenoh.bench.slam import judged, total
    from gigabrain_zenoh.bench.slam_logs import load
    from gigabrain_zenoh.bench.slam_picture import draw

    results.check_place(json)
    drives = _driven([load(path) for path in log])
    result = total([judged(one, driven) for one, driven in drives])
    if png:
        draw(drives, png)
    results.write(result, json)
    Console().print(_table(result))
    return 0


def _driven(logs: "list[Log]") -> "list[tuple[Log, Drive]]":
    from functools import partial

    from rich.console import Console
    from rich.progress import Progress

    from gigabrain_zenoh.bench.slam import drive
    from gigabrain_zenoh.mapping.slam import warm_up

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
        title="Errors of relations: mean ± standard deviation",
        caption=f"graph, mean of the logs {result.mean_m:.3f} m; memory at most "
        f"{result.peak_mb:.0f} MB. Times are of the CPU.",
    )
    table.add_column("")
    for one in result.logs:
        table.add_column(one.log, justify="right")
    rows = {
        "scans, of so many beams": [f"{one.scans}, {one.beams}" for one in result.logs],
        "keyframes": [str(one.keyframes) for one in result.logs],
        "odometry": [_errors(one.odometry) for one in result.logs],
        "front end": [_errors(one.front_end) for one in result.logs],
        "graph": [_errors(one.graph) for one in result.logs],
        "loops closed": [str(one.loops) for one in result.logs],
        "scans that ICP could not match": [str(one.unmatched) for one in result.logs],
        "breaks in the sequence": [str(one.breaks) for one in result.logs],
        "scan p50, p99 [ms]": [f"{o.scan.p50_ms:.1f}, {o.scan.p99_ms:.1f}" for o in result.logs],
        "loops p50, p99 [ms]": [f"{o.loop.p50_ms:.1f}, {o.loop.p99_ms:.1f}" for o in result.logs],
        "loops max [ms]": [f"{one.loop_max_ms:.1f}" for one in result.logs],
    }
    for title, cells in rows.items():
        table.add_row(title.replace("[", "\\["), *cells)
    return table


def _errors(errors: "Errors") -> str:
    return f"{errors.mean_m:.3f} ± {errors.std_m:.3f} m, {errors.mean_deg:.2f}°"
