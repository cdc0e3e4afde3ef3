"""The part of `gigabrain bench slam` that maps simulated worlds."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from gigabrain_zenoh.cli.checked import above_zero
from gigabrain_zenoh.cli.side_by_side import side_by_side
from gigabrain_zenoh.host import files

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.qa.bench.slam_world import PoseErrors, WorldResult


def slam_world(
    worlds: Sequence[str], minutes: float, body: str, seed: int, png: Path | None, json: Path | None
) -> int:
    """Let a robot roam each of the worlds, and show what its maps are worth."""
    from rich.console import Console
    from rich.progress import Progress

    from gigabrain_zenoh.qa.bench.slam_world import WorldsResult, draw_worlds, map_world

    above_zero("minutes", minutes)
    files.check_result_path(json)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        tasks = [progress.add_task(world, total=minutes) for world in worlds]
        toured = [
            map_world(body, world, seed, minutes, partial(progress.advance, task))
            for world, task in zip(worlds, tasks, strict=True)
        ]
    result = WorldsResult(worlds=tuple(one.result for one in toured))
    if png:
        draw_worlds(toured, png)
    files.write_result(result, json)
    Console().print(_table(result.worlds))
    return 0


def _table(worlds: "Sequence[WorldResult]") -> "Table":
    return side_by_side(
        "Errors of poses against the physics: mean, most",
        f"{worlds[0].body}, seed {worlds[0].seed}. Times are of the CPU.",
        [one.world for one in worlds],
        {
            "driven, in minutes": [f"{one.driven_m:g} m, {one.minutes:g}" for one in worlds],
            "contacts": [str(one.contacts) for one in worlds],
            "scans, not localized": [f"{one.scans}, {one.not_localized}" for one in worlds],
            "keyframes": [str(one.keyframes) for one in worlds],
            "loops closed, drawn anew": [f"{one.loops}, {one.drawn_anew}" for one in worlds],
            "odometry with gyro": [_off(one.fused) for one in worlds],
            "map": [_off(one.slam) for one in worlds],
            "map, last minute": [_off(one.last_minute) for one in worlds],
            "scan p50, p99 [ms]": [f"{o.scan.p50_ms:.1f}, {o.scan.p99_ms:.1f}" for o in worlds],
            "memory, most": [f"{one.growth.most_mb:.0f} MB" for one in worlds],
            "its slope after a quarter": [f"{o.growth.mb_an_hour:+.1f} MB/h" for o in worlds],
            "occupied cells, by the hour": [
                ", ".join(map(str, one.growth.walls)) for one in worlds
            ],
        },
    )


def _off(off: "PoseErrors") -> str:
    return f"{off.mean_m:.3f}, {off.max_m:.3f} m; {off.mean_deg:.2f}, {off.max_deg:.2f}°"
