"""The start mission of a robot: it waits for the places of the map, or is refused."""

import math
from pathlib import Path

import pytest

from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import GOAL, ZONES
from gigabrain_schemas.zones import Place, Zones
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.tasks.task_queue import NO_GOAL
from tests.node.plane import ROOM, Plane, drawn

CELLS = drawn(ROOM)


def plane_with_mission(folder: Path, text: str) -> Plane:
    """Return a robot with a start mission."""
    file = folder / "first.yaml"
    file.write_text(text)
    settings = {"mission": str(file)}
    return Plane(CELLS, config=DecisionConfig(behaviour="navigate", settings=settings))


def send_places(plane: Plane, *names: str) -> None:
    places = tuple(Place(name=name, x=1.5, y=1.2) for name in names)
    plane.bench.send(ZONES, Zones(places=places, boot=plane.boot, tick=plane.tick))


async def test_a_start_mission_waits_for_the_places_of_the_map(tmp_path: Path) -> None:
    async with plane_with_mission(tmp_path, "do: [{goto: kitchen}]") as plane:
        await plane.go(0.5)
        assert plane.intent.reason == (
            "waiting: the mission needs the body and the map's places first"
        )
        send_places(plane, "kitchen")
        await plane.until("succeeded", seconds=60)
        assert math.dist((plane.x, plane.y), (1.5, 1.2)) < 0.15
        task = plane.status.done[0]
        assert (task.label, task.source) == ("first", "itself")


async def test_another_task_cancels_a_waiting_start_mission(tmp_path: Path) -> None:
    async with plane_with_mission(tmp_path, "do: [{goto: kitchen}]") as plane:
        await plane.go(0.5)
        assert (await plane.ask(GOAL, GoalRequest(x=1.5, y=1.2))).goal == "goal-1"
        await plane.until("succeeded", seconds=60)
        send_places(plane, "kitchen")
        await plane.go(0.5)
        assert plane.intent.reason == NO_GOAL.reason


@pytest.mark.parametrize(
    ("step", "why"),
    [
        ("goto: kichen", "first.yaml:2: do[0].goto: no place 'kichen'; known: none"),
        ("script: {run: beep}", "script 'beep': this robot runs no scripts; name their folder"),
        ("find: can", "the robot has no cameras; start it with --cameras"),
        ("posture: home", "waffle has no arm"),
    ],
)
async def test_an_impossible_start_mission_is_refused_in_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, step: str, why: str
) -> None:
    async with plane_with_mission(tmp_path, f"do:\n- {step}") as plane:
        send_places(plane, "kitchen")
        await plane.go(0.5)
        assert plane.intent.reason == NO_GOAL.reason
        assert plane.status.current is None
        assert (await plane.ask(GOAL, GoalRequest(x=1.5, y=1.2))).ok
    refusals = [text for text in caplog.messages if "refused" in text]
    assert len(refusals) == 1
    assert refusals[0].startswith("refused a mission from itself: ")
    assert why in refusals[0]
