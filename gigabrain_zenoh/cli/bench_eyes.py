"""`gigabrain bench eyes`: contours of cameras against the truth of the simulator."""

from typing import TYPE_CHECKING

from rich.table import Table

from gigabrain_zenoh.cli.bench import finish, side_by_side
from gigabrain_zenoh.cli.options import JsonFile, check_positive, print_progress
from gigabrain_zenoh.host import files

if TYPE_CHECKING:
    from gigabrain_zenoh.qa.bench.eyes import EyesResult


def eyes(
    *,
    worlds: int = 40,
    seconds: float = 8.0,
    ghosts: int = 30,
    seed: int = 0,
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
        worlds: Cluttered worlds.
        seconds: Time on each of 15 empty floors: 5 textures, 3 lights [s].
        ghosts: Things that go away.
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
    all_ = result.figures
    return side_by_side(
        "Contours against the truth",
        f"{all_[0].worlds} worlds from seed {result.seed}. CPU time is of one picture, unpacking "
        "and contours included. By colour: of a camera without depth.",
        [f"{one.camera}\n{one.sensor}" for one in all_],
        {
            "error p50, p95 [cm]": [_cm(one.error_p50_m, one.error_p95_m) for one in all_],
            "beyond the truth p95 [cm]": [_cm(one.beyond_p95_m) for one in all_],
            "not covered p95 [cm]": [_cm(one.missed_p95_m) for one in all_],
            "pits p50, p95 [cm]": [_cm(one.pit_p50_m, one.pit_p95_m) for one in all_],
            "pits, found": [f"{one.pits}, {one.pits_found:.3f}" for one in all_],
            "things within 2 m": [str(one.things) for one in all_],
            "recall": [f"{one.recall:.3f}" for one in all_],
            "... in the first picture": [f"{one.recall_first:.3f}" for one in all_],
            "false contours in clutter": [str(one.false_in_clutter) for one in all_],
            "false on empty floors [1/min]": [f"{one.false_per_min:g}" for one in all_],
            "... by colour [1/min]": [f"{one.colour_per_min:.3g}" for one in all_],
            "... pictures": [str(one.empty_pictures) for one in all_],
            "ghosts p50, max [s]": [f"{one.ghost_p50_s:g}, {one.ghost_max_s:g}" for one in all_],
            "... things gone": [str(one.ghosts) for one in all_],
            "CPU p50, p99 [ms]": [f"{one.cpu_p50_ms:.1f}, {one.cpu_p99_ms:.1f}" for one in all_],
        },
    )


def _cm(*metres: float) -> str:
    return ", ".join(f"{100 * one:.1f}" for one in metres)
