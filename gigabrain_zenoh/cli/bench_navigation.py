"""`gigabrain bench slam`, `barn` and `goals`: compares maps, avoidance and goals with the truth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from gigabrain_zenoh.cli.bench import finish, side_by_side
from gigabrain_zenoh.cli.options import (
    AnySeed,
    Body,
    JsonFile,
    check_names,
    check_positive,
    print_progress,
)
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import files
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_zenoh.qa.bench.barn import BarnResult
    from gigabrain_zenoh.qa.bench.barn_course import BarnTrial
    from gigabrain_zenoh.qa.bench.goals import GoalsResult
    from gigabrain_zenoh.qa.bench.slam_logs import LaserLog, MappedLog, SlamResult
    from gigabrain_zenoh.qa.bench.slam_world import PoseErrors, WorldResult


def slam(
    *,
    log: Annotated[tuple[Path, ...], Parameter(consume_multiple=True)] = (),
    world: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = (),
    minutes: float = 10.0,
    body: Body = "turtlebot3_waffle",
    seed: AnySeed = 0,
    png: Path | None = None,
    json: JsonFile = None,
) -> int:
    """Measure the errors of maps, of recorded laser logs or of simulated worlds.

    Example: gigabrain bench slam --log intel.npz fhw.npz --png maps.png
    Example: gigabrain bench slam --world house warehouse --minutes 10

    Errors of logs are those of Kümmerle et al. (2009): of poses near one
    another, at different times. Errors of worlds are of all poses, against the
    simulator. Crispness is the number of 0.1 m cells that all scans fill, per
    cell that they fill at the reference poses: below 1 is better.

    A log is an .npz file with `ranges` [cm] (scans, beams), counter-clockwise
    over 180°, and poses `ref` and `odom` (scans, 3).

    Args:
        log: Log files.
        world: Simulated worlds to explore instead; see `gigabrain worlds`.
        minutes: Time in each world [min of robot time].
        seed: Random seed of the start pose and the sensor noise in a world.
        png: Draw the maps to this PNG file.
    """
    if bool(log) == bool(world):
        raise ConfigError("expected either --log with .npz files, or --world with names of worlds")
    files.check_picture_path(png)
    if world:
        return _slam_worlds(world, minutes, body, seed, png, json)
    return _slam_logs(log, png, json)


def _slam_logs(paths: tuple[Path, ...], png: Path | None, json: Path | None) -> int:
    from gigabrain_zenoh.qa.bench.slam_logs import draw_logs, judge_log, load, relations, total

    files.check_result_path(json)
    logs = [load(path) for path in paths]
    for log in logs:
        relations(log)  # raises for a wrong log, before the long run
    drives = _map_logs(logs)
    result = total([judge_log(log, driven) for log, driven in drives])
    if png:
        draw_logs(drives, png)
    finish(_logs_table(result), result, json)
    return 0


def _map_logs(logs: "list[LaserLog]") -> "list[tuple[LaserLog, MappedLog]]":
    from gigabrain_zenoh.mapping.slam_map import warm_up
    from gigabrain_zenoh.qa.bench.slam_logs import map_log

    with Progress(console=Console(stderr=True), transient=True) as progress:
        compiling = progress.add_task("compiling", total=None)
        warm_up()
        progress.remove_task(compiling)
        tasks = [progress.add_task(log.name, total=len(log.ranges)) for log in logs]
        return [
            (log, map_log(log, partial(progress.advance, task)))
            for log, task in zip(logs, tasks, strict=True)
        ]


def _logs_table(result: "SlamResult") -> Table:
    logs = result.logs
    return side_by_side(
        "Errors of relations: mean ± standard deviation",
        f"graph, mean of the logs {result.mean_m:.3f} m; memory at most "
        f"{result.peak_mb:.0f} MB. Times are CPU time.",
        [log.log for log in logs],
        {
            "odometry [m]": [f"{log.odometry.mean_m:.2f}" for log in logs],
            "front end [m]": [f"{log.front_end.mean_m:.2f}" for log in logs],
            "graph [m]": [f"{log.graph.mean_m:.3f} ± {log.graph.std_m:.3f}" for log in logs],
            "graph [°]": [f"{log.graph.mean_deg:.2f}" for log in logs],
            "crispness": [f"{log.crispness:.3f}" for log in logs],
            "scans, beams": [f"{log.scans}, {log.beams}" for log in logs],
            "loops closed": [str(log.loops) for log in logs],
            "scans not matched": [str(log.unmatched) for log in logs],
            "breaks": [str(log.breaks) for log in logs],
            "scan p50, p99 [ms]": [f"{log.scan.p50_ms:.1f}, {log.scan.p99_ms:.1f}" for log in logs],
            "loop p99, max [ms]": [f"{log.loop.p99_ms:.1f}, {log.loop_max_ms:.1f}" for log in logs],
        },
    )


def _slam_worlds(
    worlds: Sequence[str], minutes: float, body: str, seed: int, png: Path | None, json: Path | None
) -> int:
    from gigabrain_zenoh.qa.bench.slam_world import WorldsResult, draw_worlds, map_world

    check_positive(minutes=minutes)
    check_names([body], worlds)
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
    finish(_worlds_table(result.worlds), result, json)
    return 0


def _worlds_table(worlds: "Sequence[WorldResult]") -> Table:
    return side_by_side(
        "Errors of poses against the simulator: mean, largest",
        f"{worlds[0].body}, seed {worlds[0].seed}. Times are CPU time.",
        [world.world for world in worlds],
        {
            "driven, in minutes": [f"{world.driven_m:g} m, {world.minutes:g}" for world in worlds],
            "contacts": [str(world.contacts) for world in worlds],
            "scans, not localized": [f"{world.scans}, {world.not_localized}" for world in worlds],
            "keyframes": [str(world.keyframes) for world in worlds],
            "loops closed, redrawn": [f"{world.loops}, {world.drawn_anew}" for world in worlds],
            "odometry with gyro": [_error(world.fused) for world in worlds],
            "map": [_error(world.slam) for world in worlds],
            "map, last minute": [_error(world.last_minute) for world in worlds],
            "scan p50, p99 [ms]": [
                f"{world.scan.p50_ms:.1f}, {world.scan.p99_ms:.1f}" for world in worlds
            ],
            "memory, largest": [f"{world.growth.most_mb:.0f} MB" for world in worlds],
            "its slope after a quarter": [
                f"{world.growth.mb_an_hour:+.1f} MB/h" for world in worlds
            ],
            "occupied cells, by the hour": [
                ", ".join(map(str, world.growth.walls)) for world in worlds
            ],
        },
    )


def _error(off: "PoseErrors") -> str:
    return f"{off.mean_m:.3f}, {off.max_m:.3f} m; {off.mean_deg:.2f}, {off.max_deg:.2f}°"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BarnOptions:
    """Worlds and plant of a BARN run."""

    worlds: Path
    "File of worlds: .npz for BARN, JSON for DynaBARN."
    trials: int = 1
    "Number of trials in each world."
    only: str = ""
    "Numbers of worlds, separated by commas. Default: all."
    dynamic: bool = False
    "DynaBARN: the obstacles move."
    plant: Literal["hard", "ideal", "mujoco"] = "hard"
    (
        "hard: 100 ms delay, 150 ms lag, slip to 0.6, drift 2 %, 3 cm noise, 10 % dropouts.\n"
        "ideal: only 1 cm noise.\n"
        "mujoco: a skid-steer Jackal among solid posts, otherwise as hard; not with --dynamic."
    )
    nodes: Annotated[bool, Parameter(negative="--no-nodes")] = True
    (
        "Run the robot's nodes. Without them, and with --dynamic, only the functions that they "
        "call run, without map, bus and safety process."
    )
    samples: int = 1000
    "Plans per cycle."
    jobs: int = 2
    "Number of trials at the same time."

    def check(self) -> None:
        """Raise ConfigError for options that exclude each other."""
        check_positive(trials=self.trials, samples=self.samples, jobs=self.jobs)
        if self.dynamic and self.plant == "mujoco":
            raise ConfigError("--plant mujoco has no moving obstacles; leave out --dynamic")


def barn(*, options: BarnOptions, json: JsonFile = None) -> int:
    """Drive a Jackal through unknown worlds, scored as in the BARN challenge.

    Example: gigabrain bench barn --worlds worlds.npz --trials 1 --only 1,7

    The robot's own nodes, its gate and safety run in memory and in fake time,
    against a plant with delay, lag, slip, drift and noise. Contacts are checked
    in every tick.
    """
    from gigabrain_zenoh.qa.bench.barn import measure_barn
    from gigabrain_zenoh.qa.bench.barn_course import choose_worlds, read_worlds

    options.check()
    files.check_result_path(json)
    chosen = choose_worlds(read_worlds(options.worlds, options.dynamic), options.only)
    result = measure_barn(
        chosen, options.trials, options.plant, options.samples, options.jobs, _print_trial,
        nodes=options.nodes and not options.dynamic,
    )  # fmt: skip
    finish(_barn_table(result, options.worlds.name, options.plant), result, json)
    return 0


def _print_trial(trial: "BarnTrial") -> None:
    text = f"world {trial.world} trial {trial.trial}: {trial.result} after {trial.seconds:.2f} s"
    print_progress(f"{text}, least clearance {trial.least_clearance:.3f} m")


def _barn_table(result: "BarnResult", file: str, plant: str) -> Table:
    title = f"{file}, plant {plant}, {result.samples} plans per cycle"
    table = Table(title=title, show_header=False)
    table.add_column()
    table.add_column(justify="right")
    smallest, median = result.clearances
    rows = (
        ("trials", str(len(result.trials))),
        ("success", f"{result.share('success'):.3f}"),
        ("collision", f"{result.share('collision'):.3f}"),
        ("timeout", f"{result.share('timeout'):.3f}"),
        ("score (2024 and later, of 0.5)", f"{result.score:.4f}"),
        ("mean time of successes, s", _number(result.seconds)),
        ("least clearance, m", f"{smallest:.3f}"),
        ("median of each trial's least, m", f"{median:.3f}"),
        ("planning p50, ms", _number(result.cycle_ms(0.5))),
        ("planning p99, ms", _number(result.cycle_ms(0.99))),
    )
    for what, figure in rows:
        if figure is not None:  # planning is not timed inside the nodes
            table.add_row(what, figure)
    return table


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:.2f}"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class GoalsOptions:
    """Robots, worlds and length of a goals run."""

    bodies: tuple[str, ...] = ("turtlebot3_waffle", "mycustombot", "alpha")
    "Robot; may be given again."
    worlds: tuple[str, ...] = ("house", "warehouse")
    "World; may be given again."
    goals: int = 100
    "Number of goals for each robot in each world."
    meetings: int = 0
    "Continue until the person of the world has stopped for the robot this many times."
    hours: float = 0.0
    "Continue for this time [h of robot time], and report the memory of perception."
    link: Literal["sim", "emulated"] = "sim"
    "How to reach the robots."
    speed: float = 5.0
    "Real-time factor; emulated robots run at 1."
    seed: int = 0
    "Random seed of the start pose, the sensor noise and the goals."
    headings: bool = False
    "Give each goal a heading, and use only poses that the robot can reach."


GOALS = GoalsOptions()


def goals(*, options: GoalsOptions = GOALS, json: JsonFile = None, logs: Path | None = None) -> int:
    """Explore each world with each robot, then drive to random goals.

    Example: gigabrain bench goals --bodies alpha --worlds house --goals 10 --speed 1
    Example: gigabrain bench goals --bodies turtlebot3_waffle --worlds house --hours 8
    Example: gigabrain bench goals --bodies ackermann_car --worlds house --goals 30 --headings
    Example: gigabrain bench goals --bodies turtlebot3_ros2 --link emulated --goals 30

    Columns: time to map the world, goals reached, contacts, least clearance,
    mean time per goal, largest error of position and heading at rest (against
    the simulator, so with errors of the map), how often the person
    stopped for the robot, and ticks without the brain because the host was too busy.

    A goal counts as reached only within 0.5 m and 15° by the simulator. Exit
    code 1 after a contact, or if over 1 % of the goals were not reached.

    Args:
        logs: Keep the logs of all processes in this folder.
    """
    from gigabrain_zenoh.qa.bench.goals import GoalCourse, measure_goals

    check_positive(goals=options.goals, speed=options.speed, hours=options.hours or None)
    check_names(options.bodies, options.worlds)
    files.check_result_path(json)
    course = GoalCourse(
        goals=options.goals,
        meetings=options.meetings,
        hours=options.hours,
        speed=options.speed if options.link == "sim" else 1.0,
        seed=options.seed,
        headings=options.headings,
        link=options.link,
        logs=logs,
    )
    result = run_async(measure_goals(options.bodies, options.worlds, course, print_progress))
    finish(_goals_table(result), result, json)
    _print_failures(result)
    return 0 if result.ok else 1


def _print_failures(result: "GoalsResult") -> None:
    """Print the memory of each run, and each goal that was not reached."""
    from gigabrain_zenoh.decision.behaviours import describe_goal

    console = Console()
    for run in result.runs:
        growth = run.growth
        console.print(
            f"{run.body} in {run.world}: perception at most {growth.most_mb:.0f} MB, "
            f"{growth.mb_an_hour:+.1f} MB/h after the first quarter; "
            f"occupied cells by the hour: {', '.join(map(str, growth.walls))}",
            soft_wrap=True,
        )
    for run in result.runs:
        for failure in run.failures:
            after = f"after {failure.seconds:.0f} s"
            goal = describe_goal(failure.goal)
            text = f"{run.body} in {run.world}, {goal} {after}: {failure.reason}"
            console.print(text, markup=False, soft_wrap=True)


def _goals_table(result: "GoalsResult") -> Table:
    faster = ", ".join(sorted({f"x{run.speed:g}" for run in result.runs}))
    title = f"seed {result.seed}, {faster} real time"
    table = Table("body", "world", title=title, box=None, padding=(0, 1, 0, 0), pad_edge=False)
    for name in (
        "mapped\n[s]", "reached", "con-\ntacts", "room\n[m]", "goal\n[s]", "off\n[m]", "turn\n[°]",
        "met", "alone",
    ):  # fmt: skip
        table.add_column(Text(name), justify="right")  # fits 80 columns
    for run in result.runs:
        per_goal = run.seconds_per_goal
        table.add_row(
            run.body, run.world, f"{run.explored_s:.0f}", f"{run.reached}/{run.goals}",
            f"{run.contacts}", f"{run.min_clearance_m:.3f}",
            "-" if per_goal is None else f"{per_goal:.1f}",
            f"{run.worst_m:.2f}", f"{math.degrees(run.worst_rad):.1f}",
            f"{run.met}", f"{run.alone}",
        )  # fmt: skip
    return table
