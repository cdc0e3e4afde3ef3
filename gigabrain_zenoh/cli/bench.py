"""`gigabrain bench chain`, `stack`, `robots`, `estop`, `bodies`, `plan`: measures this machine."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from gigabrain_zenoh.cli.options import (
    AnySeed,
    Body,
    JsonFile,
    Seed,
    World,
    check_names,
    check_positive,
    print_progress,
)
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import files
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_zenoh.qa.bench.bodies import BodiesResult
    from gigabrain_zenoh.qa.bench.plan import PlanResult

MAX_SCAN_HZ = 50.0  # one scan per tick of the robot's clock
MIN_CELLS = 400  # per side; smaller maps have no path of the required length
PUBLISHED_MS = (  # from the documentation of Nav2
    ("Nav2 NavFn, about 75 m", 146.0),
    ("Nav2 Smac 2D A*, about 75 m", 243.0),
    ("Nav2 Smac Hybrid-A*, about 75 m", 144.0),
    ("Nav2 Smac Lattice, about 75 m", 113.0),
    ("Nav2 Theta*, 87.5 m", 46.0),
    ("Nav2 inflation, 2000 x 2000, one core", 48.9),
)


def finish(page: RenderableType, result: object, json: Path | None) -> None:
    """Print the table of a benchmark, and write its results if a file is given."""
    Console().print(page)
    files.write_result(result, json)


def side_by_side(
    title: str, caption: str, names: Sequence[str], rows: Mapping[str, Sequence[str]]
) -> Table:
    """Return a table with one column per name, and one row per figure."""
    table = Table("", title=title, caption=caption)
    for name in names:
        table.add_column(name, justify="right")
    for figure, cells in rows.items():
        table.add_row(Text(figure), *map(Text, cells))
    return table


def chain(
    *,
    seconds: float = 10.0,
    rounds: int = 3,
    rates: Annotated[tuple[float, ...], Parameter(consume_multiple=True)] = (10.0, 50.0),
    peers: bool = False,
    json: JsonFile = None,
) -> int:
    """Measure scan-to-command latency, in turns with a bare Zenoh relay.

    Example: gigabrain bench chain --seconds 10 --rounds 3 --rates 10 50
    Example: gigabrain bench chain --peers

    Args:
        seconds: Length of each run [s].
        rounds: Number of turns of chain and relay.
        rates: Scans per second [Hz].
        peers: Also run the relay with dora and rospy, where they are installed.
    """
    from gigabrain_zenoh.qa.bench.chain import chain_page, measure_chain
    from gigabrain_zenoh.qa.bench.peer_frameworks import COMMANDS, installed

    files.check_result_path(json)
    check_positive(seconds=seconds, rounds=rounds)
    for rate in rates:
        if not 0 < rate <= MAX_SCAN_HZ:
            raise ConfigError(f"--rates: expected above 0, at most {MAX_SCAN_HZ:g}, got {rate:g}")
    frameworks = installed() if peers else ()
    missing = set(COMMANDS) - {each.name for each in frameworks} if peers else set()
    for name in sorted(missing):
        print_progress(f"{name} is left out: there is no command {COMMANDS[name]!r}")
    result = run_async(measure_chain(seconds, rounds, rates, print_progress, frameworks))
    finish(chain_page(result), result, json)
    return 0


def stack(
    *,
    seconds: float = 20.0,
    body: Body = "turtlebot3_waffle",
    link: Literal["sim", "emulated"] = "sim",
    world: World | None = None,
    goal: bool = False,
    json: JsonFile = None,
) -> int:
    """Measure CPU, memory and start-up time of a whole robot.

    Example: gigabrain bench stack --seconds 20 --world house --goal

    A robot that drives avoids obstacles, by default in the arena. An arm carries out its demo
    mission, by default in the world of its demo.

    Args:
        seconds: Duration [s].
        link: How to reach the robot; the CPU of an emulator does not count.
        goal: Also time a second start with a map, until it accepts a goal.
    """
    from gigabrain_zenoh.qa.bench.stack import measure_stack, stack_page

    files.check_result_path(json)
    check_positive(seconds=seconds)
    check_names([body], [world] if world else [])
    result = run_async(measure_stack(body, link, world, seconds, print_progress, goal=goal))
    finish(stack_page(result), result, json)
    return 0


def robots(
    *,
    count: int = 4,
    seconds: float = 60.0,
    body: Body = "turtlebot3_waffle",
    world: World = "house",
    json: JsonFile = None,
) -> int:
    """Have several robots explore at once, each in a world of its own, at real time.

    Example: gigabrain bench robots --count 4 --seconds 60

    Exit code 1 after a contact, or if this machine is too small for so many.

    Args:
        count: Number of robots.
        seconds: Duration, once all have started [s].
    """
    from gigabrain_zenoh.qa.bench.robots import measure_robots, robots_page

    files.check_result_path(json)
    check_positive(count=count, seconds=seconds)
    check_names([body], [world])
    result = run_async(measure_robots(body, world, count, seconds, print_progress))
    finish(robots_page(result), result, json)
    return 0 if result.ok else 1


def estop(
    *,
    body: Body = "turtlebot3_waffle",
    driving: int = 10,
    latched: int = 200,
    json: JsonFile = None,
) -> int:
    """Time the e-stop, from the press to zero at the gate, idle and on a flooded network.

    Example: gigabrain bench estop --driving 10 --latched 200

    Args:
        driving: Number of presses while it drives.
        latched: Number of presses after that, while it is latched.
    """
    from gigabrain_zenoh.qa.bench.estop import estop_page, measure_estop

    files.check_result_path(json)
    check_positive(driving=driving, latched=latched)
    result = run_async(measure_estop(body, driving, latched, print_progress))
    finish(estop_page(result), result, json)
    return 0


def bodies(
    *names: str,
    link: Literal["sim", "emulated"] = "emulated",
    world: World = "arena",
    seed: Seed = 0,
    seconds: float = 30.0,
    json: JsonFile = None,
) -> int:
    """Drive all robots in turn with one brain, which is neither restarted nor reconfigured.

    Example: gigabrain bench bodies --seconds 30 --world house

    Exit code 1 after a contact, or if a process of the brain was restarted.

    Args:
        names: Robots. Default: all that have the link and a base.
        link: How to reach them.
        seconds: Time that each drives [s of robot time].
    """
    from gigabrain_drivers.driver.catalog import load_robot, simulated
    from gigabrain_zenoh.launch.deployment import Deployment
    from gigabrain_zenoh.qa.bench.bodies import measure_bodies

    check_positive(seconds=seconds)
    files.check_result_path(json)
    check_names(names, [world])
    drives = {name: load_robot(name).description().has_base for name in names or simulated(link)}
    if fixed := [name for name in names if not drives[name]]:
        raise ConfigError(f"{fixed[0]} has no base to drive; leave it out")
    chosen = [name for name, has_base in drives.items() if has_base]
    deployment = Deployment(
        link=link, world=world, seed=seed, resume="auto", router="tcp/127.0.0.1:0"
    )
    console = Console()
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder, console.status("") as status:
        measuring = measure_bodies(chosen, deployment, seconds, Path(folder), status.update)
        result = run_async(measuring)
    finish(_bodies_table(result), result, json)
    return 0 if result.ok else 1


def _bodies_table(result: "BodiesResult") -> Table:
    brain = ", ".join(f"{name} {pid}" for name, pid in result.brain_pids.items())
    rows = {
        "driven [s]": "seconds",
        "contacts": "contacts",
        "distance [m]": "distance_m",
        "mean speed commanded [m/s]": "commanded",
        "mean speed measured [m/s]": "measured",
        "least clearance [m]": "min_clearance_m",
        "command to motion, median [ticks]": "latency_ticks",
        "... of this many motions": "motions",
        "CPU of the driver [% of a core]": "driver_cpu",
        "reconnects": "reconnects",
        "stops by the gate": "stops",
    }
    return side_by_side(
        f"link {result.link}, {result.world}, seed {result.seed}",
        f"one brain: {brain}; restarts {result.brain_restarts}",
        [body.body for body in result.bodies],
        {
            title: [_figure(getattr(body, field)) for body in result.bodies]
            for title, field in rows.items()
        },
    )


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"


def plan(
    *,
    size: tuple[int, ...] = (1000, 2000),
    queries: int = 20,
    seed: AnySeed = 0,
    json: JsonFile = None,
    png: Path | None = None,
) -> int:
    """Time global planning on an office and on a random map of 5 cm cells, and check the paths.

    Example: gigabrain bench plan --size 1000 --size 2000 --queries 20

    Exit code 1 if a path costs more than the cheapest one.

    Args:
        size: Cells per side of the map; may be given again.
        queries: Number of paths, each about three quarters of the map's side.
        seed: Random seed of the maps and the queries.
        png: Draw the last map and its paths to this PNG file.
    """
    from gigabrain_zenoh.qa.bench.plan import measure_plan

    check_positive(queries=queries)
    if any(one < MIN_CELLS for one in size):
        raise ConfigError(f"--size: expected at least {MIN_CELLS}, got {min(size)}")
    files.check_result_path(json)
    files.check_picture_path(png)
    result = measure_plan(size, queries, seed, png, print_progress)
    finish(_plan_table(result), result, json)
    return 0 if result.ok else 1


def _plan_table(result: "PlanResult") -> Table:
    from gigabrain_zenoh.qa.judging import table_of

    table = table_of("map", "what", "n", "p50 [ms]", "p95 [ms]", "CPU p50 [ms]", left=2)
    table.caption = "Published figures are of other maps on other machines."
    for map_ in result.sizes:
        for timing in map_.timings:
            times = (timing.p50_ms, timing.p95_ms, timing.cpu_p50_ms)
            what = timing.what.replace("office", f"office, {map_.path_m:.0f} m")
            table.add_row(f"{map_.size}²", what, str(timing.n), *(f"{ms:.1f}" for ms in times))
        table.add_row(
            f"{map_.size}²", "cost over Dijkstra's, worst", "", f"{map_.ratio:.6f}", "", ""
        )
        table.add_section()
    for what, ms in PUBLISHED_MS:
        table.add_row("published", what, "", f"{ms:g}", "", "")
    return table
