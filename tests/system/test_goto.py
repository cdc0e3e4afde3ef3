"""`gigabrain goto` and similar commands, with all processes, on an exploring robot."""

import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import Home, robot_of
from gigabrain_zenoh.testing.waiting import until

COMPILE_TIMEOUT_S = 600.0  # the first start compiles


@pytest.fixture
async def home_of_robot(home: Home) -> AsyncIterator[Home]:
    """A robot that maps the arena, in lock-step."""
    demo = home.start("demo", "--headless", "--speed", "3", "--seconds", "3000")
    endpoint = await robot_of(home, demo)
    async with probing(endpoint) as robot:
        await until(lambda: robot.state.gate.mode == "enabled", "driving", COMPILE_TIMEOUT_S)
        yield home


@pytest.mark.slow
async def test_an_exploring_robot_is_sent_elsewhere_and_reports_the_result(
    home_of_robot: Home, tmp_path: Path
) -> None:
    home = home_of_robot
    there = await home.run("goto", "0", "0")
    last_line = there.out.splitlines()[-1]
    assert last_line.startswith("goal-2 has succeeded: at (0.00, 0.00) (position error 0.")
    assert there.err == ""
    assert await there.ended() == 0
    half = await home.run("goto", "0.5")
    assert await half.ended() == 2
    outside = await home.run("goto", "50", "-50")
    assert outside.err.startswith("gigabrain: the goal is outside the map; nearest reachable point")
    assert await outside.ended() == 1
    listed = await home.run("task", "list")
    lines = [line.split()[:2] for line in listed.out.splitlines()]
    assert lines == [["goal-2", "succeeded"], ["mission-1", "cancelled"]]
    exploring = await home.run("explore", "--no-wait")
    assert exploring.out == "mission-3: accepted\n"
    paused = await home.run("task", "pause")
    assert paused.out == "mission-3 is paused\n"
    file = tmp_path / "wait.yaml"
    file.write_text("do: [{wait: 3000}]")
    for name, number in (("mission-4", signal.SIGINT), ("mission-5", signal.SIGTERM)):
        waiting = home.start("mission", str(file))
        await until(lambda: "waiting 3000 s" in waiting.out, "the mission")  # noqa: B023
        waiting.send(number)
        assert await waiting.ended() == 128 + number
        assert waiting.out.endswith(f"{name}: cancelled\n")
    file.write_text("do:\n- gotoo: [1, 2]")
    bad = await home.run("mission", str(file))
    assert bad.err.startswith(f"gigabrain: {file}:2: unknown field 'gotoo'; did you mean 'goto'?")
    assert await bad.ended() == 2


async def test_goto_without_a_robot_fails_with_the_remedy(home: Home) -> None:
    no_robot = await home.run("goto", "1", "2")
    assert no_robot.err.startswith("gigabrain: no robot runs here; start one with `gigabrain demo`")
    assert await no_robot.ended() == 1
