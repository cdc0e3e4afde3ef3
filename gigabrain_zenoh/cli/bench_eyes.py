"""`gigabrain bench eyes`, `cameras`, `clutter`, `objects`: benefits and costs of cameras."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from gigabrain_zenoh.cli.bench import finish, side_by_side
from gigabrain_zenoh.cli.options import (
    AnySeed,
    Body,
    JsonFile,
    World,
    check_names,
    check_positive,
    print_progress,
)
from gigabrain_zenoh.host import files
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.qa.judging import table_of

if TYPE_CHECKING:
    from gigabrain_zenoh.qa.bench.clutter import ClutterResult, ClutterRun
    from gigabrain_zenoh.qa.bench.eyes import EyesResult
    from gigabrain_zenoh.qa.bench.objects import ObjectsResult


def eyes(
    *,
    worlds: int = 40,
    seconds: float = 8.0,
    ghosts: int = 30,
    seed: AnySeed = 0,
    json: JsonFile = None,
) -> int:
    """Measure obstacle contours against the simulator's truth, with a sensor's errors and without.

    Example: gigabrain bench eyes --worlds 40 --seconds 8 --ghosts 30

    Each world is drawn at random and rendered at 10 Hz while the robot drives
    for one second. Two cameras are measured: the one of turtlebot3_waffle, and
    one on a mast that looks down. Errors are those of the first thing along
    each line of sight, up to 3 m; recall is of things of at least 3 cm, up to
    2 m. It needs EGL or OSMesa: set MUJOCO_GL=egl.

    Args:
        worlds: Number of cluttered worlds.
        seconds: Time on each of 15 empty floors: 5 textures, 3 lights [s].
        ghosts: Number of things that go away.
        seed: First random seed of the worlds and the sensor's errors.
    """
    from gigabrain_zenoh.qa.bench.eyes import measure_eyes
    from gigabrain_zenoh.qa.bench.eyes_worlds import bodies

    files.check_result_path(json)
    check_positive(worlds=worlds, seconds=seconds, ghosts=ghosts)
    result = measure_eyes(bodies(), worlds, seconds, ghosts, seed, print_progress)
    finish(_eyes_table(result), result, json)
    return 0


def _eyes_table(result: "EyesResult") -> Table:
    figures = result.figures
    return side_by_side(
        "Contours against the truth",
        f"{figures[0].worlds} worlds from seed {result.seed}. CPU time is of one picture, "
        "unpacking and contours included. By colour: of a camera without depth.",
        [f"{figure.camera}\n{figure.sensor}" for figure in figures],
        {
            "error p50, p95 [cm]": [
                _cm(figure.error_p50_m, figure.error_p95_m) for figure in figures
            ],
            "beyond the truth p95 [cm]": [_cm(figure.beyond_p95_m) for figure in figures],
            "not covered p95 [cm]": [_cm(figure.missed_p95_m) for figure in figures],
            "pits p50, p95 [cm]": [_cm(figure.pit_p50_m, figure.pit_p95_m) for figure in figures],
            "pits, found": [f"{figure.pits}, {figure.pits_found:.3f}" for figure in figures],
            "things within 2 m": [str(figure.things) for figure in figures],
            "recall": [f"{figure.recall:.3f}" for figure in figures],
            "... in the first picture": [f"{figure.recall_first:.3f}" for figure in figures],
            "false contours in clutter": [str(figure.false_in_clutter) for figure in figures],
            "false on empty floors [1/min]": [f"{figure.false_per_min:g}" for figure in figures],
            "... by colour [1/min]": [f"{figure.colour_per_min:.3g}" for figure in figures],
            "... pictures": [str(figure.empty_pictures) for figure in figures],
            "ghosts p50, max [s]": [
                f"{figure.ghost_p50_s:g}, {figure.ghost_max_s:g}" for figure in figures
            ],
            "... things gone": [str(figure.ghosts) for figure in figures],
            "CPU p50, p99 [ms]": [
                f"{figure.cpu_p50_ms:.1f}, {figure.cpu_p99_ms:.1f}" for figure in figures
            ],
        },
    )


def _cm(*metres: float) -> str:
    return ", ".join(f"{100 * one:.1f}" for one in metres)


def cameras(
    *,
    seconds: float = 20.0,
    body: Body = "turtlebot3_waffle",
    world: World = "arena",
    json: JsonFile = None,
) -> int:
    """Measure what cameras cost a whole robot, and how soon the world has their contours.

    Example: gigabrain bench cameras --seconds 20

    The same robot drives without its cameras, then with them. It needs EGL or OSMesa.

    Args:
        seconds: Duration of each run [s].
    """
    from gigabrain_zenoh.qa.bench.camera_cost import cameras_table, measure_cameras

    files.check_result_path(json)
    check_positive(seconds=seconds)
    check_names([body], [world])
    result = run_async(measure_cameras(body, world, seconds, print_progress))
    finish(cameras_table(result), result, json)
    return 0


def clutter(
    *,
    seeds: str = "0-9",
    speed: float = 3.0,
    seconds: float = 120.0,
    lidar_only: bool = False,
    body: Body = "turtlebot3_waffle",
    json: JsonFile = None,
    logs: Path | None = None,
) -> int:
    """Drive a whole robot to ten goals in each of many cluttered worlds.

    Example: gigabrain bench clutter --seeds 0-99 --json clutter.json
    Example: gigabrain bench clutter --seeds 0-99 --json clutter.json --lidar-only

    Each world is drawn at random: tables, low boxes, shelves and bars that hang, door sills, steps
    down, and few things that a lidar sees. Contacts and falls are those of the physics; after a
    fall a world is over. It needs EGL or OSMesa: set MUJOCO_GL=egl.

    A file that exists is continued: worlds that it holds are not driven again. Exit code 1 if a
    robot with cameras touched something, fell, or missed over two goals of a world.

    Args:
        seeds: Seeds of the worlds, such as 0-99 or 3,5,20-22.
        speed: Real-time factor.
        seconds: Time in each world, from the first goal [s of robot time].
        lidar_only: Leave the cameras off.
        logs: Keep the worlds and the logs of all processes in this folder.
    """
    from gigabrain_zenoh.qa.bench.clutter import ClutterCourse, earlier, measure_clutter, seeds_of

    check_positive(speed=speed, seconds=seconds)
    check_names([body])
    files.check_result_path(json)
    wanted = seeds_of(seeds)
    course = ClutterCourse(
        body=body, cameras=not lidar_only, speed=speed, seconds=seconds, logs=logs
    )
    before = earlier(json, course)

    def keep(result: "ClutterResult") -> None:
        files.write_result(result, json)

    result = run_async(measure_clutter(wanted, course, before, keep, print_progress))
    finish(_clutter_table(result), result, json)
    return 0 if all(one.ok for one in result.of(cameras=True)) else 1


def objects(
    *,
    seeds: str = "0-9",
    speed: float = 3.0,
    seconds: float = 120.0,
    body: Body = "turtlebot3_waffle",
    json: JsonFile = None,
) -> int:
    """Measure what a robot with cameras remembers of things in a room, against the truth.

    Example: gigabrain bench objects --seeds 0-9

    Seven things of five classes stand in each room: cubes, balls, cylinders, cans, boxes. The robot
    drives to eight places, and what it remembers is compared with the physics. It needs EGL or
    OSMesa: set MUJOCO_GL=egl.

    Args:
        seeds: Seeds of the worlds, such as 0-9 or 3,5,20-22.
        speed: Real-time factor.
        seconds: Time in each world, from the first place on [s of robot time].
    """
    from gigabrain_zenoh.qa.bench.clutter import seeds_of
    from gigabrain_zenoh.qa.bench.objects import measure_objects

    check_positive(speed=speed, seconds=seconds)
    check_names([body])
    files.check_result_path(json)
    result = run_async(measure_objects(seeds_of(seeds), body, speed, seconds, print_progress))
    finish(_objects_table(result), result, json)
    return 0


def _objects_table(result: "ObjectsResult") -> Table:
    table = table_of(
        "class", "there", "remembered", "not there", title="Things that are remembered"
    )
    runs = result.runs
    for label in sorted({one for run in runs for one in run.things}):
        found = [
            yes
            for run in runs
            for name, yes in zip(run.things, run.found, strict=True)
            if name == label
        ]
        false = sum(run.false.count(label) for run in runs)
        table.add_row(label, str(len(found)), str(sum(found)), str(false))
    errors = sorted(error for run in runs for error in run.errors_m)
    p50, p95 = (_cm(percentile(errors, share) or 0.0) for share in (0.5, 0.95))
    table.caption = (
        f"{len(runs)} rooms, {result.body}, x{result.speed:g} real time. "
        f"Position off p50 {p50} cm, p95 {p95} cm."
    )
    return table


def _clutter_table(result: "ClutterResult") -> Table:
    columns = {"with cameras": result.of(cameras=True), "lidar alone": result.of(cameras=False)}
    shown = {name: _clutter_cells(runs) for name, runs in columns.items() if runs}
    figures = next(iter(shown.values()), {})
    return side_by_side(
        "Ten goals in cluttered worlds",
        f"{result.body}, x{result.speed:g} real time, at most {result.seconds:g} s in each world.",
        list(shown),
        {figure: [cells[figure] for cells in shown.values()] for figure in figures},
    )


def _clutter_cells(runs: "Sequence[ClutterRun]") -> dict[str, str]:
    goals, unharmed = sum(run.reached for run in runs), sum(run.unharmed for run in runs)
    return {
        "worlds": str(len(runs)),
        "contacts": str(sum(run.contacts for run in runs)),
        "falls": str(sum(run.falls for run in runs)),
        "worlds without both": str(unharmed),
        "goals reached": f"{goals} of {10 * len(runs)}",
        "worlds with 8 goals or more": str(sum(run.reached >= 8 for run in runs)),
        "without contact and fall, and with 8 goals": str(sum(run.ok for run in runs)),
        "least goals in a world": str(min(run.reached for run in runs)),
        "least clearance [m]": f"{min(run.min_clearance_m for run in runs):.3f}",
        "distance in a world, mean [m]": f"{_mean(runs, 'distance_m'):.1f}",
        "time in a world, mean [s]": f"{_mean(runs, 'seconds'):.0f}",
    }


def _mean(runs: "Sequence[ClutterRun]", field: str) -> float:
    return float(sum(getattr(run, field) for run in runs) / len(runs))
