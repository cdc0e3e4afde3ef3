"""The decision node carries out tasks: pauses, exploration, roaming, restarts."""

import asyncio
import math
from pathlib import Path

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.tasks import GoalRequest, MissionRequest, TaskRequest
from gigabrain_schemas.topics import GOAL, MISSION, TASK_CHANGE
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.tasks.task_queue import NO_GOAL
from tests.node.plane import ROOM, Plane, drawn

CELLS = drawn(ROOM)
START_EXPLORING = {"start": "explore"}
ZERO_VELOCITY = Velocity()


async def test_a_restart_of_the_driver_does_not_end_a_task() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(2.0)
        plane.restart_driver()
        await plane.go(3.0)
        assert plane.intent.reason.startswith("going to (4.00, 0.80): ")


async def test_a_goal_may_preempt_a_paused_task() -> None:
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(1.0)
        await plane.ask(TASK_CHANGE, TaskRequest(do="pause", source="bob"))
        await plane.go(0.3)
        assert plane.intent.twist == ZERO_VELOCITY
        await plane.ask(GOAL, GoalRequest(x=1.6, y=1.4, how="preempt"))
        await plane.go(0.5)
        assert plane.status.current
        assert plane.status.current.id == "goal-2"
        assert [task.id for task in plane.status.queue] == ["goal-1"]


async def test_exploring_ends_once_all_reachable_space_is_known() -> None:
    plane = Plane(CELLS, at=(2.0, 1.0, 0.3))
    plane.known[:] = -1
    async with plane:
        await plane.go(0.2)
        reply = await plane.ask(MISSION, MissionRequest(mission="do: [{explore: {}}]"))
        assert reply.ok
        await plane.until("succeeded", seconds=120)
        assert plane.status.done[0].reason == "everything reachable is explored"
        inside = CELLS[5:-5, 5:-5] == 0
        assert (plane.known[5:-5, 5:-5][inside] == 0).mean() > 0.98
        assert plane.travelled > 0.5


async def test_a_task_continues_after_a_restart_of_decision(tmp_path: Path) -> None:
    config = DecisionConfig(behaviour="navigate", state_dir=str(tmp_path))
    async with Plane(CELLS, config=config) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(2.0)
        while not (tmp_path / "tasks.json").exists():  # noqa: ASYNC110 - a thread writes it
            await asyncio.sleep(0.01)
        await plane.restart()
        await plane.until("succeeded", seconds=60)
        assert plane.status.done[0].id == "goal-1"
        assert math.hypot(plane.x - 4.0, plane.y - 0.8) < 0.15


async def test_a_roaming_robot_explores_and_then_visits_places_until_it_gets_a_goal() -> None:
    plane = Plane(
        CELLS,
        at=(2.0, 1.0, 0.3),
        config=DecisionConfig(behaviour="navigate", settings=START_EXPLORING),
    )
    plane.known[:] = -1
    async with plane:
        first_words = []
        for _ in range(40):
            await plane.go(0.5)
            first_words.append(plane.intent.reason.partition(" ")[0])
            if first_words[-1] == "going":
                break
        assert "exploring:" in first_words
        assert first_words[-1] == "going"
        current = plane.status.current
        assert current
        assert (current.label, current.source) == ("roaming", "itself")
        await plane.ask_at_once(GOAL, GoalRequest(x=1.5, y=1.2))
        await plane.go(0.5)
        assert plane.status.done[0].reason == "replaced by goal-2"


async def test_a_robot_whose_tasks_were_cancelled_does_not_roam_after_a_restart(
    tmp_path: Path,
) -> None:
    config = DecisionConfig(behaviour="navigate", settings=START_EXPLORING, state_dir=str(tmp_path))
    async with Plane(CELLS, config=config) as plane:
        await plane.go(0.5)
        await plane.ask(TASK_CHANGE, TaskRequest(do="cancel", task="all", source="ann"))
        await plane.go(0.5)
        assert plane.intent.reason == NO_GOAL.reason
        saved = tmp_path / "tasks.json"
        while not saved.exists() or b'"jobs":[]' not in saved.read_bytes():  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        await plane.restart()
        await plane.go(1.0)
        assert plane.intent.reason == NO_GOAL.reason
        plane.restart_driver()
        await plane.restart()
        await plane.go(1.0)
        assert plane.status.current
        assert plane.status.current.label == "roaming"


async def test_intent_and_task_status_give_the_same_reason_while_a_mission_waits() -> None:
    mission = "do: [{wait: 5}, {goto: [2, 1]}]"
    async with Plane(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask(MISSION, MissionRequest(mission=mission, source="ann"))
        await plane.go(1.0)
        assert (plane.intent.reason, plane.status.doing) == ("waiting 5 s", "waiting 5 s")
        assert not plane.status.drives
        await plane.ask(TASK_CHANGE, TaskRequest(do="pause", source="ann"))
        await plane.go(0.5)
        assert plane.intent.reason == "mission-1 is paused: paused by ann"
        await plane.ask(TASK_CHANGE, TaskRequest(do="resume", source="ann"))
        await plane.go(5.5)
        assert plane.status.drives
        assert plane.intent.reason.startswith("going to (2.00, 1.00): ")
