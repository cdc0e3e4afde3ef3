"""Benchmarks: figures, limits and printed pages."""

import io

import msgspec
import pytest
from rich.console import Console, RenderableType

from gigabrain_zenoh.qa.bench.chain import ChainResult, Hop, chain_page
from gigabrain_zenoh.qa.bench.estop import EstopResult, PressTimes, estop_page
from gigabrain_zenoh.qa.bench.stack import (
    FirstGoal,
    ProcessCost,
    StackResult,
    physics_share,
    stack_page,
    targets,
)
from gigabrain_zenoh.qa.judging import table_of
from tests.unit.qa.figures import compared, one


def stack(**changes: object) -> StackResult:
    values = {
        "body": "turtlebot3_waffle",
        "link": "sim",
        "world": "arena",
        "seconds": 20.0,
        "ready_s": 1.2,
        "physics_cpu": 0.04,
        "processes": (
            ProcessCost(name="driver", cpu=0.125, rss_bytes=95_000_000),
            ProcessCost(name="perception", cpu=0.025, rss_bytes=56_000_000),
            ProcessCost(name="safety", cpu=0.0625, rss_bytes=58_500_000),
        ),
    }
    return msgspec.convert(values | changes, StackResult)


def shown(page: RenderableType) -> str:
    console = Console(width=100, no_color=True)
    with console.capture() as capture:
        console.print(page)
    return capture.get()


def test_a_wide_table_breaks_headers_and_cuts_nothing() -> None:
    table = table_of("joint", "swing", "off rms", "off at most", "late", "overshoot", "off at rest")
    table.add_row("shoulder_pan", "±27°", "0.54°", "0.90°", "-1 ms", "0.2%", "0.12°")
    console = Console(width=80, no_color=True)
    with console.capture() as capture:
        console.print(table)
    assert "…" not in capture.get()


def test_the_cost_of_a_robot_excludes_its_physics() -> None:
    assert stack().cpu_without_physics == pytest.approx(0.1725)
    assert stack(physics_cpu=None).cpu_without_physics == pytest.approx(0.2125)
    assert physics_share({"physics_cpu_s": 1.5}, {"physics_cpu_s": 2.5}, 20.0) == 0.05
    assert physics_share({}, {"physics_cpu_s": 2.5}, 20.0) is None


def test_the_emulator_of_an_arm_does_not_count_and_the_limit_is_higher() -> None:
    emulator = ProcessCost(name="emulator", cpu=0.25, rss_bytes=95_000_000)
    arm = stack(link="emulated", physics_cpu=None, arm_hz=100.0, processes=(
        emulator, ProcessCost(name="safety", cpu=0.36, rss_bytes=90_000_000),
    ))  # fmt: skip
    judged = {
        limit.figure.name: (value, limit.allows(value)) for limit, value in targets(arm).items()
    }
    assert judged == {
        "all ready after": (1.2, True),
        "CPU without physics": (pytest.approx(36.0), False),
    }
    assert "100 commands a second to its arm" in shown(stack_page(arm))


def test_figures_are_compared_with_their_limits() -> None:
    judged = [
        (limit.figure.name, round(value, 2), limit.at_most, limit.allows(value))
        for limit, value in targets(stack()).items()
    ]
    assert judged == [
        ("all ready after", 1.2, 1.5, True),
        ("CPU without physics", 17.25, 30.0, True),
        ("physics and lidar", 4.0, 5.0, True),
        ("largest without MuJoCo (safety)", 58.5, 70.0, True),
    ]
    slow = targets(stack(ready_s=1.6, physics_cpu=0.06))
    assert [limit.allows(value) for limit, value in slow.items()] == [False, True, False, True]
    goal = FirstGoal(
        accepted_s=1.9,
        accepted_cpu_s=1.7,
        answer="goal-1: accepted",
        drives_s=4.0,
        drives_cpu_s=5.1,
    )
    limits = {limit.figure.name: limit for limit in targets(stack(first_goal=goal))}
    assert limits["first goal accepted after"].allows(1.9)
    assert not limits["first goal accepted after"].allows(2.1)
    without_mujoco = targets(stack(physics_cpu=None))
    assert [limit.figure.name for limit in without_mujoco][1:] == [
        "CPU without physics",
        "largest without MuJoCo (driver)",
    ]
    memory, value = list(without_mujoco.items())[-1]
    assert not memory.allows(value)


def test_the_pages_show_all_figures() -> None:
    hop = Hop(name="scan → world", took=1.0, put=0.1, bridge=0.05, decode=0.02, step=0.23)
    result = ChainResult(
        seconds=10.0,
        payload_bytes=(1604, 236, 490, 124),
        rates=(compared(),),
        overheard=one(40, 1.25, 2.0),
        hops=(hop,),
    )
    page = shown(chain_page(result))
    for text in ("10 Hz", "0.70", "1.40 (≤ 1.5)", "1.67 (≤ 2)", "Safety", "scan → world", "0.600"):
        assert text in page
    page = shown(stack_page(stack(ready_s=1.6)))
    for text in ("perception", "2.5%", "56 MB", "1.60 s", "over", "17.25 %"):
        assert text in page
    assert "first goal" not in page
    goal = FirstGoal(
        accepted_s=1.95, accepted_cpu_s=1.7, answer="goal-1: ok", drives_s=4.0, drives_cpu_s=5.1
    )
    page = shown(stack_page(stack(first_goal=goal)))
    for text in ("1.95 s", "after 1.70 s of CPU (goal-1: ok)", "4.00 s with 5.10 s of CPU"):
        assert text in " ".join(page.split())


def test_the_page_of_the_e_stop_shows_each_figure_beside_its_target() -> None:
    idle = PressTimes(name="idle", ms=(1.0, 2.0, 3.0, 49.0), travel_m=(0.031, 0.042))
    flooded = PressTimes(name="flooded", ms=(60.0, 101.0), travel_m=())
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(estop_page(EstopResult(body="mock", rounds=(idle, flooded))))
    rows = [line for line in console.export_text().splitlines() if "│" in line]
    assert [cell.strip() for cell in rows[0].split("│")[1:-1]] == [
        "idle", "4", "2.0", "49.0 (≤ 50)", "49.0 (≤ 100)", "0.042 (≤ 0.06)",
    ]  # fmt: skip
    assert [cell.strip() for cell in rows[1].split("│")[1:-1]] == [
        "flooded", "2", "60.0", "101.0 (≤ 50)", "101.0 (≤ 100)", "0.000 (≤ 0.06)",
    ]  # fmt: skip
