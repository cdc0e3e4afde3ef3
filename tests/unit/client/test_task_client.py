"""Tasks from a script's side: what it sends, waits for and is told."""

import asyncio
import math
import re
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from gigabrain_schemas.tasks import (
    GoalReply,
    GoalRequest,
    MissionReply,
    MissionRequest,
    Task,
    TaskReply,
    TaskRequest,
    TaskStatus,
)
from gigabrain_schemas.topics import GOAL, MISSION, TASK, TASK_CHANGE, Priority
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalTransport
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.decision.behaviours import StepOutcome
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.waiting import settle, until
from tests.unit.decision.sites import Site


@pytest.fixture
async def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


async def test_a_script_hears_how_its_goal_ended(site: Site) -> None:
    await site.step()
    tasks = Tasks(site.net.two)
    name = await tasks.go_to(3.0, 0.0)
    seen: list[TaskStatus] = []
    waiting = asyncio.ensure_future(tasks.result(name, seen.append))
    await site.step(10)
    assert site.command
    site.outcome = StepOutcome(number=site.command.number, state="failed", reason="a wall")
    await site.step(10)
    end = await waiting
    assert (end.id, end.state, end.reason) == ("goal-1", "failed", "a wall")
    assert seen[-1].current
    await site.end()


async def test_a_script_is_told_who_is_missing() -> None:
    net = Net()
    with pytest.raises(BodyLost, match="no process serves goals; run decision with behaviour: n"):
        await Tasks(net.two, starting_s=0.0).go_to(1.0, 0.0)


async def test_whoever_says_nothing_of_the_tasks_is_taken_for_gone_as_soon_as_was_agreed() -> None:
    patient = asyncio.ensure_future(Tasks(Net().two, silent_s=60.0).result("goal-1"))
    hasty = asyncio.ensure_future(Tasks(Net().two, silent_s=0.0).result("goal-1"))
    done, _ = await asyncio.wait((patient, hasty), return_when=asyncio.FIRST_COMPLETED)
    patient.cancel()
    assert done == {hasty}
    with pytest.raises(BodyLost, match="no process serves goals"):
        await hasty


async def test_a_status_of_a_robot_that_has_fallen_silent_is_not_given_again() -> None:
    net = Net()
    tasks = Tasks(net.two, silent_s=0.0)
    one = Task(id="goal-3", kind="goal", label="goal", source="ann", state="active")
    waiting = asyncio.ensure_future(Tasks(net.two, silent_s=60.0).status())
    with pytest.raises(BodyLost):
        await tasks.status()
    net.one.publish(TASK, TaskStatus(current=one))
    assert (await waiting).current == one
    await net.clock.advance(1_000_000_000)  # it misses some, as on a busy machine
    assert (await tasks.status()).current == one
    await net.clock.advance(9_000_000_000)
    with pytest.raises(BodyLost, match="no process serves goals"):
        await tasks.status()
    net.one.publish(TASK, TaskStatus())
    await settle()
    assert (await tasks.status()).current is None


async def test_a_task_that_the_robot_does_not_know_any_more_is_not_waited_for() -> None:
    net = Net()
    waiting = asyncio.ensure_future(Tasks(net.two, silent_s=60.0).result("goal-3"))
    one = Task(id="goal-3", kind="goal", label="goal", source="ann", state="queued")
    for status in (*[TaskStatus()] * 4, TaskStatus(queue=(one,)), *[TaskStatus()] * 5):
        await settle()
        assert not waiting.done()
        net.one.publish(TASK, status)
    await settle()
    assert waiting.done()
    with pytest.raises(BodyLost, match=r"no task goal-3, .*; see `gigabrain task list`"):
        await waiting


async def test_a_goal_that_comes_while_the_robot_starts_waits_for_who_serves_goals() -> None:
    net, said = Net(), list[str]()
    tasks = Tasks(net.two, on_wait=said.append, starting_s=60.0)
    sending = asyncio.ensure_future(tasks.go_to(1.0, 0.0))
    await until(lambda: said)
    assert said == ["waiting: no process serves goals yet; the robot may still be starting"]

    async def answer(request: GoalRequest) -> GoalReply:
        return GoalReply(ok=True, text="accepted", goal=f"goal to {request.x:g}")

    net.one.serve(GOAL, answer)
    assert await sending == "goal to 1"
    assert len(said) == 1


async def test_a_request_whose_link_was_lost_is_not_repeated() -> None:
    class Losing(LocalTransport):
        """Loses the link with the first request for a goal, which has arrived by then."""

        async def query(
            self, key: str, payload: bytes, encoding: str, timeout_s: float, priority: Priority
        ) -> list[bytes | str]:
            replies = await super().query(key, payload, encoding, timeout_s, priority)
            if key != GOAL.key or self.losses:
                return replies
            self.losses += 1
            return []

    async def answer(request: GoalRequest) -> GoalReply:
        received.append(request)
        return GoalReply(ok=True, text="accepted", goal=f"goal-{len(received)}")

    net, received = Net(), list[GoalRequest]()
    net.one.serve(GOAL, answer)
    tasks = Tasks(Bus(Losing(net.network), net.clock, "script"), starting_s=60.0)
    with pytest.raises(BodyLost, match="lost before the answer; `gigabrain task list` shows"):
        await tasks.go_to(1.0, 0.0, how="queue")
    assert len(received) == 1


async def test_a_goal_that_is_answered_late_may_have_been_accepted() -> None:
    async def answer(_: GoalRequest) -> GoalReply:
        await asyncio.Event().wait()
        raise AssertionError

    net = Net()
    net.one.serve(GOAL, answer)
    with pytest.raises(BodyLost, match=r"no answer within 0\.01 s; `gigabrain task list` shows"):
        await Tasks(net.two, plan_s=0.01).go_to(1.0, 0.0)


@pytest.mark.parametrize("x", [math.nan, math.inf, -1e300, 1.01e5])
async def test_a_script_is_told_of_a_goal_that_is_no_place(x: float) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"numbers up to 100000, got {x:g} 0 1")):
        await Tasks(Net().two).go_to(x, 0.0, 1.0)


async def test_a_refusal_reaches_the_script(site: Site) -> None:
    await site.step()
    site.wall = "the goal is outside the map"
    tasks = Tasks(site.net.two)
    with pytest.raises(Refused, match="the goal is outside the map"):
        await tasks.go_to(1.0, 0.0)
    with pytest.raises(Refused, match="there is no task"):
        await tasks.cancel()
    assert (await tasks.explore()) == "mission-1"
    assert await tasks.pause() == "mission-1 is paused"
    await site.step()
    assert (await tasks.status()).current
    await site.end()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, "expected x and y, the name of a place, an object or a tag"),
        ({"x": "door", "object": "can"}, "expected x and y, the name of a place, an object or a t"),
        ({"x": 1.0}, "expected x and y, or the name of a place"),
        (
            {"x": "door", "y": 1.57},
            "expected numbers x and y, or a place and yaw=; got 'door' and y=1.57",
        ),
        (
            {"x": "1.0", "y": "2.0"},
            "expected numbers x and y, or a place and yaw=; got '1.0' and y='2.0'",
        ),
        ({"object": "can", "yaw": 1.57}, "expected an object or a tag without y and yaw"),
        ({"y": 1.0, "tag": 7}, "expected an object or a tag without y and yaw"),
    ],
)
async def test_goto_leaves_out_nothing_that_a_script_gives(
    given: dict[str, Any], expected: str
) -> None:
    with pytest.raises(ConfigError, match=f"^goto: {re.escape(expected)}"):
        await Robot(Net().two).goto(**given)


async def test_a_file_may_be_named_by_a_text(tmp_path: Path) -> None:
    net, asked = Net(), list[MissionRequest]()

    async def read(request: MissionRequest) -> MissionReply:
        asked.append(request)
        return MissionReply(ok=True, text="accepted", task="mission-1")

    net.one.serve(MISSION, read)
    tasks, file, text = Tasks(net.two), tmp_path / "evening.yaml", "do: [{explore: {}}]"
    file.write_text(text)
    for given in (file, str(file), text, "do:\n- script:\n    run: beep.yaml"):
        await tasks.carry_out(given)
    sent = [(one.label, one.mission[:4]) for one in asked]
    assert sent == [("evening", "do: ")] * 2 + [("mission", "do: "), ("mission", "do:\n")]
    with pytest.raises(ConfigError, match=r"mornin\.yaml: no such file"):
        await tasks.carry_out("mornin.yaml")


@pytest.mark.parametrize(
    "start", [lambda robot: robot.goto(1.0, 0.0), lambda robot: robot.tasks.explore()]
)
async def test_a_task_is_cancelled_also_where_its_answer_comes_only_afterwards(
    start: Callable[[Robot], Coroutine[Any, Any, object]],
) -> None:
    net, planned, cancelled = Net(), asyncio.Event(), list[str]()

    async def plan(_: GoalRequest) -> GoalReply:
        await planned.wait()
        return GoalReply(ok=True, text="on the way", goal="goal-1")

    async def read(_: MissionRequest) -> MissionReply:
        await planned.wait()
        return MissionReply(ok=True, text="exploring", task="mission-1")

    async def change(request: TaskRequest) -> TaskReply:
        cancelled.append(request.task)
        return TaskReply(ok=True, text="is cancelled")

    net.one.serve(GOAL, plan)
    net.one.serve(MISSION, read)
    net.one.serve(TASK_CHANGE, change)
    starting = asyncio.create_task(start(Robot(net.two)))
    await settle()
    starting.cancel()
    await settle()
    planned.set()
    with pytest.raises(asyncio.CancelledError):
        await starting
    assert cancelled in (["goal-1"], ["mission-1"])


async def test_a_refusal_that_comes_after_a_cancellation_is_no_error() -> None:
    net, planned = Net(), asyncio.Event()

    async def plan(_: GoalRequest) -> GoalReply:
        await planned.wait()
        raise Refused("too many others ask")

    net.one.serve(GOAL, plan)
    going = asyncio.create_task(Robot(net.two).goto(1.0, 0.0))
    await settle()
    going.cancel()
    await settle()
    planned.set()
    with pytest.raises(asyncio.CancelledError):
        await going
