"""`gigabrain bench hands`, `fetch`, `reach` and `joints`: measures arms, in simulation."""

from collections import Counter
from typing import TYPE_CHECKING

from rich.table import Table

from gigabrain_zenoh.cli.bench import finish
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
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.qa.judging import table_of

if TYPE_CHECKING:
    from gigabrain_zenoh.qa.bench.fetch import FetchResult
    from gigabrain_zenoh.qa.bench.hands import HandsResult, HandsRun
    from gigabrain_zenoh.qa.bench.joints import TrackingResult
    from gigabrain_zenoh.qa.bench.reach import ReachResult

MAX_BACKLASH_DEG, MAX_LOAD_KG = 10.0, 10.0


def hands(
    *,
    seeds: str = "0-99",
    body: Body = "so101",
    camera: bool = False,
    backlash: float = 0.0,
    json: JsonFile = None,
) -> int:
    """Have an arm pick things up and put them down elsewhere, judged by the physics.

    Example: gigabrain bench hands --seeds 0-99

    Cubes, cylinders and balls of 2 to 4 cm and 20 to 200 g lie on the table, 10 to 26 cm from the
    axis of the first joint and 90° to both sides, with frictions of 0.4 and 1. Pose and size are
    given, or measured by the arm's simulated depth camera. Planner, control and gate
    are those of a robot. It needs the extra `arm`.

    Args:
        seeds: Seeds of the things, such as 0-9 or 3,5,20-22.
        camera: Use only what the camera sees of the things.
        backlash: Play of each joint that turns, between motor and joint [degrees], 0 to 10.
    """
    from gigabrain_zenoh.qa.bench.clutter import seeds_of
    from gigabrain_zenoh.qa.bench.hands import measure_hands

    check_names([body])
    if not 0.0 <= backlash <= MAX_BACKLASH_DEG:
        raise ConfigError(f"--backlash: expected 0 to {MAX_BACKLASH_DEG:g} degrees")
    files.check_result_path(json)
    result = measure_hands(
        seeds_of(seeds), body, print_progress, backlash_deg=backlash, camera=camera
    )
    finish(_hands_table(result), result, json)
    return 0


def fetch(
    *,
    seeds: str = "0-19",
    body: Body = "lekiwi",
    speed: float = 2.0,
    seconds: float = 400.0,
    people: bool = False,
    json: JsonFile = None,
) -> int:
    """Have a robot with a base and an arm fetch a can from another room, judged by the physics.

    Example: gigabrain bench fetch --seeds 0-19 --people

    Two rooms, cartons, the can, and where the robot begins are drawn at random. The robot knows
    neither room: it looks for the can with its camera, picks it up, carries it to a place in the
    other room, and puts it down there. It needs the extras `arm` and `eyes`, and EGL or OSMesa: set
    MUJOCO_GL=egl.

    Args:
        seeds: Seeds of the worlds, such as 0-9 or 3,5,20-22.
        speed: Real-time factor, at most.
        seconds: Time in each world [s of robot time].
        people: A person walks through the door and back, all the time.
    """
    from gigabrain_zenoh.qa.bench.clutter import seeds_of
    from gigabrain_zenoh.qa.bench.fetch import measure_fetch

    check_positive(speed=speed, seconds=seconds)
    check_names([body])
    files.check_result_path(json)
    work = measure_fetch(seeds_of(seeds), body, speed, seconds, print_progress, people=people)
    result = run_async(work)
    finish(_fetch_table(result), result, json)
    return 0


def reach(
    *,
    body: Body = "so101",
    goals: int = 1000,
    seed: AnySeed = 0,
    json: JsonFile = None,
) -> int:
    """Have an arm go to random goals near its body, judged by the physics.

    Example: gigabrain bench reach --goals 1000

    Goals are drawn all around the arm, over and under a shelf, and beyond its reach; every other
    one with a pitch of the tool. It times inverse kinematics and planning, and counts the
    paths on which the arm touched anything. Planner, control, safety and gate are those of a
    robot. It needs the extra `arm`.

    Args:
        goals: Number of goals.
        seed: Seed of the goals.
    """
    from gigabrain_zenoh.qa.bench.reach import measure_reach

    check_names([body])
    check_positive(goals=goals)
    files.check_result_path(json)
    result = measure_reach(body, goals, seed, print_progress)
    finish(_reach_table(result), result, json)
    return 1 if result.touched else 0


def _reach_table(result: "ReachResult") -> Table:
    table = table_of("what", "n", "p50 [ms]", "p95 [ms]", "p99 [ms]", title="Reached")
    for what, times in (
        ("a posture, found", result.solved),
        ("no posture, and why", result.unsolved),
        ("a plan", result.planned),
    ):
        figures = (f"{one:.1f}" for one in (times.p50_ms, times.p95_ms, times.p99_ms))
        table.add_row(what, str(times.n), *figures)
    refused = ", ".join(f"{n} {cause}" for cause, n in sorted(result.refused.items()))
    table.caption = "\n".join((
        f"{result.body}, {result.goals} goals: {result.reached} reached, off p95 "
        f"{result.off_p95_m * 100:.1f} cm; no posture: {refused or 'none'}; no path: "
        f"{sum(result.no_way.values())}; held back by safety: {result.held}. "
        f"On {len(result.touched)} ways it touched something.",
        *(f"{n} times no path: {why}" for why, n in sorted(result.no_way.items())),
        *result.touched[:10],
    ))  # fmt: skip
    return table


def joints(
    *,
    body: Body = "so101",
    load: float = 0.1,
    backlash: float = 1.0,
    json: JsonFile = None,
) -> int:
    """Have each joint of an arm follow a sine and a step, judged by the physics.

    Example: gigabrain bench joints --body so101

    The arm is stretched out, and carries a load. Each joint in turn follows a sine of 0.5 Hz, up to
    half its maximum speed, then a step over the same range. Control and gate are those of a robot.
    It needs the extra `arm`.

    Args:
        load: Mass that it carries at its tool [kg], 0 to 10.
        backlash: Play of each joint, between motor and joint [degrees], 0 to 10.
    """
    from gigabrain_zenoh.qa.bench.joints import measure_joints

    check_names([body])
    if not 0.0 <= backlash <= MAX_BACKLASH_DEG:
        raise ConfigError(f"--backlash: expected 0 to {MAX_BACKLASH_DEG:g} degrees")
    if not 0.0 <= load <= MAX_LOAD_KG:
        raise ConfigError(f"--load: expected 0 to {MAX_LOAD_KG:g} kg")
    files.check_result_path(json)
    result = measure_joints(body, load, backlash, print_progress)
    finish(_joints_table(result), result, json)
    return 0


def _joints_table(result: "TrackingResult") -> Table:
    table = table_of(
        "joint", "swing", "off rms", "off at most", "late", "overshoot", "off at rest",
        title="Followed",
    )  # fmt: skip
    for one in result.joints:
        table.add_row(
            one.joint, f"±{one.amplitude_deg:.0f}°", f"{one.rms_deg:.2f}°",
            f"{one.worst_deg:.2f}°", f"{one.lag_ms:.0f} ms", f"{one.overshoot:.1%}",
            f"{one.rest_deg:.2f}°",
        )  # fmt: skip
    table.caption = (
        f"{result.body}, stretched out, with {result.load_kg * 1000:.0f} g at its tool and "
        f"{result.backlash_deg:g}° of backlash."
    )
    return table


def _fetch_table(result: "FetchResult") -> Table:
    runs = result.runs
    brought = [run for run in runs if run.outcome == "brought"]
    table = table_of("worlds", "brought", "contacts", "off p95", "time p50", title="Fetched")
    off = percentile(sorted(run.off_m or 0.0 for run in brought), 0.95)
    time = percentile(sorted(run.seconds for run in brought), 0.5)
    table.add_row(
        str(len(runs)), str(len(brought)), str(sum(run.contacts for run in runs)),
        "-" if off is None else f"{off * 100:.0f} cm", "-" if time is None else f"{time:.0f} s",
    )  # fmt: skip
    people = "with a person walking" if result.people else "without people"
    table.caption = f"{result.body}, x{result.speed:g} real time at most; {people}."
    return table


def _hands_table(result: "HandsResult") -> Table:
    runs = result.runs
    table = table_of(
        "things", "n", "placed", "unreachable", "otherwise", "off p95", title="Picked and placed"
    )
    for kind in sorted({run.kind for run in runs}):
        _add_row(table, kind, [run for run in runs if run.kind == kind])
    _add_row(table, "all", list(runs))
    wrong = Counter(run.outcome for run in runs if run.outcome not in ("placed", "unreachable"))
    seconds = percentile(sorted(run.seconds for run in runs), 0.5) or 0.0
    planning = sorted(run.planning_s for run in runs)
    p50, p95 = (percentile(planning, share) or 0.0 for share in (0.5, 0.95))
    play = f" with {result.backlash_deg:g}° of backlash" if result.backlash_deg else ""
    seen = percentile(sorted(run.seen_off_m for run in runs if run.seen_off_m is not None), 0.95)
    by_camera = f"By the camera, off p95 {seen * 100:.1f} cm. " if result.camera and seen else ""
    failed = "; ".join(f"{n} {what}" for what, n in wrong.items()) or "None failed"
    table.caption = (
        f"{result.body}{play}. {by_camera}{failed}. "
        f"Joints beyond their limits, by the physics: {sum(run.broken_limits for run in runs)} "
        f"ticks; fastest {max(run.fastest for run in runs):.0%} of the greatest speed. "
        f"A thing takes {seconds:.1f} s (p50); planning {p50:.2f} s, p95 {p95:.2f} s."
    )
    return table


def _add_row(table: Table, name: str, runs: "list[HandsRun]") -> None:
    outcomes = Counter(run.outcome for run in runs)
    off = percentile(sorted(run.off_m for run in runs if run.off_m is not None), 0.95)
    placed, unreachable = outcomes["placed"], outcomes["unreachable"]
    rest = len(runs) - placed - unreachable
    counts = (str(one) for one in (len(runs), placed, unreachable, rest))
    table.add_row(name, *counts, "-" if off is None else f"{off * 100:.1f} cm")
