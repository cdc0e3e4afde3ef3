"""`gigabrain goto` and its like, with all processes: a robot that explores is sent elsewhere."""

import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import Home, robot_of
from gigabrain_zenoh.testing.waiting import until

COMPILING_S = 600.0  # at the very first start


@pytest.fixture
async def home_of_robot(home: Home) -> AsyncIterator[Home]:
    """A robot that makes a map of the arena; in lock-step, on any machine."""
    demo = home.start("demo", "--headless", "--speed", "3", "--seconds", "3000")
    endpoint = await robot_of(home, demo)
    async with probing(endpoint) as robot:
        await until(lambda: robot.state.gate.mode == "enabled", "driving", COMPILING_S)
        yield home


@pytest.mark.slow
async def test_a_robot_that_explores_is_sent_elsewhere_and_says_what_became_of_it(
    home_of_robot: Home, tmp_path: Path
) -> None:
    home = home_of_robot
    there = await home.run("goto", "0", "0")
    said = there.out.splitlines()[-1]
    assert said.startswith("goal-2 has succeeded: at (0.00, 0.00) (position error 0.")
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


async def test_nobody_who_serves_goals_is_told_apart_from_no_robot(home: Home) -> None:
    nobody = await home.run("goto", "1", "2")
    assert nobody.err.startswith("gigabrain: no robot runs here; start one with `gigabrain demo`")
    assert await nobody.ended() == 1
