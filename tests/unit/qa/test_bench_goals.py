"""Results of `gigabrain bench goals`: goals, limits and the table."""

import asyncio
from pathlib import Path
from typing import cast

import pytest
from msgspec.structs import replace
from rich.console import Console

from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import GateStatus, Pose, RobotState, Velocity
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.topics import STATE
from gigabrain_zenoh.cli.bench_navigation import _goals_table
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.errors import BodyLost, GigabrainError
from gigabrain_zenoh.qa.bench import goals
from gigabrain_zenoh.qa.bench.goals import (
    CAPACITY_AH,
    GoalError,
    GoalFigures,
    GoalSender,
    GoalsResult,
    missed_by,
    with_capacity,
)
from gigabrain_zenoh.qa.bench.slam_world import MapGrowth
from gigabrain_zenoh.qa.robot_under_test import ProcessGroup
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.waiting import settle

AT = Pose(x=0.0, y=0.0, yaw=0.0)
STILL = RobotState(robot_type="mock", pose=AT, velocity=Velocity(), boot=7, tick=1)
GOOD = GoalFigures(
    body="alpha",
    world="house",
    speed=5.0,
    accepted_s=1.5,
    explored="succeeded: everything reachable is explored",
    explored_s=30.0,
    goals=100,
    reached=99,
    off=(GoalError(0.08, None), GoalError(0.11, 0.05), GoalError(0.02, 0.1)),
    contacts=0,
    min_clearance_m=0.09,
    met=3,
    distance_m=400.0,
    seconds=1030.0,
    alone=0,
    failures=(),
    growth=MapGrowth(memory_mb=(), mb_an_hour=0.0, walls=()),
)


def test_one_goal_in_a_hundred_may_be_missed_and_nothing_may_be_touched() -> None:
    assert GOOD.ok
    assert not replace(GOOD, reached=98).ok
    assert not replace(GOOD, contacts=1).ok
    assert not GoalsResult(seed=0, runs=(GOOD, replace(GOOD, contacts=1))).ok


def test_a_goal_that_is_wrongly_reported_as_reached_is_missed() -> None:
    assert missed_by(GoalError(9.8, None)) == "reported as reached, 9.80 m from the goal"
    assert missed_by(GoalError(0.1, 3.0)) == "reported as reached, 172 degrees from the heading"
    assert not missed_by(GoalError(0.3, None))
    assert not missed_by(GoalError(0.3, 0.2))


async def test_a_goal_is_sent_again_when_a_busy_host_does_not_reply(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[float] = []

    async def go_to(_: Tasks, x: float, _y: float, _yaw: float | None) -> str:
        asked.append(x)
        if len(asked) < 3:
            raise BodyLost("no process serves goals")
        return "goal-1"

    class Alive:
        async def poll(self) -> None:
            pass

    monkeypatch.setattr(Tasks, "go_to", go_to)
    sender = GoalSender(Net().two, cast("ProcessGroup", Alive()), seed=0)
    assert await sender._send_goal(Goal(x=2.0, y=1.0)) == "goal-1"
    assert asked == [2.0, 2.0, 2.0]


async def test_a_random_goal_is_drawn_again_while_a_person_blocks_the_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    places: list[GigabrainError | tuple[float, float]] = [
        GigabrainError("no place can be reached"),
        GigabrainError("none"),
        (1.0, 2.0),
    ]

    async def random_place(_: GoalSender) -> tuple[float, float]:
        found = places.pop(0)
        if isinstance(found, GigabrainError):
            raise found
        return found

    class Alive:
        async def poll(self) -> None:
            pass

    monkeypatch.setattr(GoalSender, "_random_place", random_place)
    sender = GoalSender(Net().two, cast("ProcessGroup", Alive()), seed=0)
    assert await sender._retry(GigabrainError, sender._random_place) == (1.0, 2.0)
    monkeypatch.setattr(goals, "MAX_SILENCE_S", 0.0)
    places.extend([GigabrainError("none")] * 100)
    with pytest.raises(GigabrainError, match="none"):
        await sender._retry(GigabrainError, sender._random_place)


async def test_a_robot_that_latches_ends_the_course() -> None:
    net = Net()

    class Alive:
        async def poll(self) -> None:
            await settle()

    sender = GoalSender(net.two, cast("ProcessGroup", Alive()), seed=0)
    low = Cause(code="battery_empty", text="battery at 5 %", latching=True)
    gate = GateStatus(mode="latched", causes=(low,))
    net.one.publish(STATE, replace(STILL, gate=gate))
    with pytest.raises(GigabrainError, match="the robot has latched: battery at 5 %"):
        await sender._while_running(asyncio.Event().wait())


def test_a_body_that_drives_for_hours_has_a_large_battery(tmp_path: Path) -> None:
    copy = with_capacity(robot_path("turtlebot3_waffle"), tmp_path / "body")
    before, after = load_robot("turtlebot3_waffle"), load_robot(str(copy))
    assert after.sim == {"driver": "mujoco", "battery_capacity": CAPACITY_AH}
    assert replace(after, sim=before.sim) == before
    assert (copy.parent / "model.xml").is_file()


def test_a_run_that_was_sent_to_no_goal_has_no_time_per_goal() -> None:
    none = replace(GOOD, goals=0, reached=0, off=())
    assert none.seconds_per_goal is None
    assert GOOD.seconds_per_goal == 10.0
    assert "0/0" in _text(GoalsResult(seed=7, runs=(none,)))


def test_the_table_shows_the_figures() -> None:
    lines = _text(GoalsResult(seed=7, runs=(replace(GOOD, body="turtlebot3_waffle"),)))
    for figure in ("seed 7", "x5", "99/100", "0.090", "10.0", "0.11", "5.7"):
        assert figure in lines
    assert "…" not in lines


def _text(result: GoalsResult) -> str:
    console = Console(width=80)
    with console.capture() as capture:
        console.print(_goals_table(result))
    return capture.get()
