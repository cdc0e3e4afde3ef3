"""Tasks on the bus and on disk: what is asked, answered, told and remembered."""

import asyncio
import math
import re
import sys
from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas.tasks import (
    Goal,
    GoalReply,
    GoalRequest,
    Granted,
    MissionReply,
    MissionRequest,
    TaskReply,
    TaskRequest,
    TaskStatus,
)
from gigabrain_schemas.topics import GOAL, GRANTED, MISSION, TASK, TASK_CHANGE
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused
from gigabrain_zenoh.task_client import Tasks
from gigabrain_zenoh.tasks.executive import Saved
from gigabrain_zenoh.tasks.mission import Script
from gigabrain_zenoh.tasks.orders import GoTo, Order, Outcome
from gigabrain_zenoh.tasks.scripts import Run, Scripts
from gigabrain_zenoh.tasks.service import TaskService
from gigabrain_zenoh.tasks.store import TaskFile
from tests.brain_rig import BOOT, state
from tests.bus_rig import Net, settle, until


class Site:
    """A service of tasks, somebody who drives, and somebody who asks."""

    def __init__(self, folder: Path, *, scripts: str = "") -> None:
        self.net = Net()
        self.wall, self.lost = "", ""
        self.service = TaskService(self.net.one, self, folder=str(folder), scripts=scripts)
        self.told: list[TaskStatus] = []
        self.net.two.subscribe(TASK, lambda _key, status: self.told.append(status))
        self.tick, self.order, self.outcome = 0, None, None
        self.order: Order | None
        self.outcome: Outcome | None

    async def can_reach(self, goal: Goal) -> str:
        await self.can_drive()
        if self.wall:
            raise Refused(self.wall)
        return "on the way, 4.2 m"

    async def can_drive(self) -> None:
        if self.lost:
            raise Refused(self.lost)

    async def go(self, x: float, **how: str) -> GoalReply:
        request = msgspec.convert({"x": x, "y": 0.0, "source": "ann"} | how, GoalRequest)
        return (await self.net.two.ask(GOAL, request))[0]

    async def carry_out(self, text: str) -> MissionReply:
        request = MissionRequest(mission=text, source="ann", label="tea")
        return (await self.net.two.ask(MISSION, request))[0]

    async def change(self, do: str, task: str = "") -> TaskReply:
        request = msgspec.convert({"do": do, "task": task, "source": "bob"}, TaskRequest)
        return (await self.net.two.ask(TASK_CHANGE, request))[0]

    async def step(self, ticks: int = 5, boot: int = BOOT) -> None:
        self.tick += ticks
        self.net.one.time.see(state(self.tick, boot=boot))
        self.order = self.service.step(state(self.tick, boot=boot), self.outcome)
        self.outcome = None
        await settle()

    async def end(self) -> None:
        await self.service.close()


@pytest.fixture
async def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


async def test_a_goal_is_accepted_with_its_way_and_told_from_then_on(site: Site) -> None:
    await site.step()
    reply = await site.go(3.0)
    assert reply == GoalReply(ok=True, text="goal-1: on the way, 4.2 m", goal="goal-1")
    await site.step()
    assert isinstance(site.order, GoTo)
    assert site.order.goal == Goal(x=3.0, y=0.0)
    site.outcome = Outcome(number=site.order.number, progress=0.5, distance=2.1, eta=8.0)
    await site.step(10)
    now = site.told[-1]
    assert (now.doing, now.progress, now.distance_remaining) == ("going to (3.00, 0.00)", 0.5, 2.1)
    site.outcome = Outcome(number=site.order.number, state="done", reason="at (3.00, 0.00)")
    await site.step()
    assert [(task.id, task.state) for task in site.told[-1].done] == [("goal-1", "succeeded")]
    assert site.told[-1].current is None
    await site.end()


async def test_it_is_told_five_times_a_second_of_the_robots_time(site: Site) -> None:
    await site.step()
    before = len(site.told)
    for _ in range(20):
        await site.step(5)
    assert len(site.told) - before == 10
    await site.end()


async def test_a_goal_that_cannot_be_reached_is_refused_and_changes_nothing(site: Site) -> None:
    await site.step()
    await site.go(3.0)
    site.wall = "the goal is inside something; nearest reachable point is 0.4 m away at (1.2, 0.3)"
    assert await site.go(4.0) == GoalReply(ok=False, text=site.wall)
    await site.step()
    assert isinstance(site.order, GoTo)
    assert site.order.goal.x == 3.0
    await site.end()


@pytest.mark.parametrize("body", [b'{"x": NaN, "y": 0}', b'{"x": 1e999, "y": 0}', b'{"x": 1}'])
async def test_a_goal_that_is_no_place_is_refused(site: Site, body: bytes) -> None:
    replies = await site.net.network.transport().query("robot/goal", body, "", 1.0, "data")
    assert len(replies) == 1
    assert isinstance(replies[0], str)
    assert replies[0].startswith("not a valid GoalRequest: ")
    await site.end()


async def test_missions_are_checked_before_they_are_accepted(site: Site, tmp_path: Path) -> None:
    await site.step()
    for text, why in (
        ("do:\n- gotoo: a", "tea:2: unknown field 'gotoo'; did you mean 'goto'?"),
        ("trees: {a: [{tree: a}]}\ndo: [{tree: a}]", "goes round in a circle: a → a"),
        ("do: [{script: {run: beep}}]", "script 'beep': this robot runs none; name their folder"),
    ):
        reply = await site.carry_out(text)
        assert not reply.ok
        assert why in reply.text
    site.lost = "nobody says yet where in a map the robot is"
    assert (await site.carry_out("do: [{explore: {}}]")).text == site.lost
    assert (await site.carry_out("do: [{wait: 5}]")).ok
    await site.end()


async def test_pausing_resuming_and_cancelling(site: Site) -> None:
    await site.step()
    await site.go(3.0)
    await site.go(4.0, how="queue")
    assert (await site.change("pause")).text == "goal-1 is paused"
    await site.step()
    assert site.order is None
    assert site.told[-1].current
    assert site.told[-1].current.reason == "paused by bob"
    assert (await site.change("resume")).text == "goal-1 goes on"
    assert (await site.change("cancel")).text == "goal-1 is cancelled"
    await site.step()
    assert isinstance(site.order, GoTo)
    assert site.order.goal.x == 4.0
    refused = await site.change("cancel", "goal-1")
    assert (refused.ok, refused.text) == (
        False,
        "there is no task 'goal-1' any more; there is: goal-2",
    )
    await site.end()


async def test_tasks_survive_a_restart_of_decision(site: Site, tmp_path: Path) -> None:
    await site.step()
    await site.go(3.0)
    await site.go(4.0, how="queue")
    await site.step()
    await site.end()
    again = Site(tmp_path)
    await again.step(site.tick + 50)
    assert isinstance(again.order, GoTo)
    assert again.order.goal.x == 3.0
    assert [task.id for task in again.told[-1].queue] == ["goal-2"]
    assert (await again.go(5.0, how="queue")).goal == "goal-3"
    await again.end()


async def test_tasks_of_another_start_of_the_robot_wait_for_a_person(
    site: Site, tmp_path: Path
) -> None:
    await site.step()
    await site.go(3.0)
    await site.step()
    await site.end()
    again = Site(tmp_path)
    await again.step(boot=BOOT + 1)
    assert again.order is None
    assert (await again.change("resume")).ok
    await again.step(boot=BOOT + 1)
    assert isinstance(again.order, GoTo)
    await again.end()


@pytest.mark.parametrize(
    "content", [b'{"type":"gigabrain tasks","co', b'{"jobs": 3}', b"", b"\xff"]
)
async def test_a_file_that_is_cut_or_foreign_is_set_aside_and_told(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "tasks.json").write_bytes(content)
    site = Site(tmp_path)
    await site.step()
    assert site.order is None
    assert "tasks.bad now, and nothing is to be done" in caplog.text
    assert (tmp_path / "tasks.bad").read_bytes() == content
    await site.go(3.0)
    await site.end()
    assert len(TaskFile(str(tmp_path)).read()[0].jobs) == 1


async def test_a_disk_that_cannot_be_written_is_told_and_the_robot_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    site = Site(tmp_path / "file" / "folder")
    await site.step()
    await site.go(3.0)
    await site.step()
    await site.end()
    await settle()
    assert isinstance(site.order, GoTo)
    assert "tasks will not survive a restart" in caplog.text


def test_nothing_is_written_where_there_is_no_folder() -> None:
    file = TaskFile("")
    assert file.read() == (Saved(), "")
    assert file.write((Saved(count=3),)) == ""


def program(folder: Path, text: str) -> str:
    path = folder / "beep"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(folder)


async def ended(run: Run) -> tuple[bool, str]:
    await until(lambda: run.result)
    assert run.result
    return run.result


async def test_a_program_of_the_folder_is_run_there_with_its_arguments(tmp_path: Path) -> None:
    folder = program(tmp_path, 'echo "$1 in $(pwd)"')
    run = Scripts(folder).start(Script(run="beep", arguments=("twice",)))
    assert await ended(run) == (True, f"ended well: twice in {tmp_path}")


async def test_a_program_that_fails_says_why(tmp_path: Path) -> None:
    run = Scripts(program(tmp_path, "echo no sound >&2; exit 3")).start(Script(run="beep"))
    assert await ended(run) == (False, "ended with exit code 3: no sound")


def test_a_program_ends_on_uvloop_too(tmp_path: Path) -> None:
    uvloop = pytest.importorskip("uvloop")
    scripts = Scripts(program(tmp_path, "echo no sound; exit 3"))

    async def run() -> tuple[bool, str]:
        return await ended(scripts.start(Script(run="beep")))

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        assert runner.run(run()) == (False, "ended with exit code 3: no sound")


async def test_a_program_that_takes_too_long_is_ended_with_all_it_has_started(
    tmp_path: Path,
) -> None:
    text = f"sleep 600 & echo $! > {tmp_path}/child; wait"
    scripts = Scripts(program(tmp_path, text))
    run = scripts.start(Script(run="beep", seconds=0.5))
    assert await ended(run) == (False, "did not end within 0.5 s and was ended")
    child = int((tmp_path / "child").read_text())
    await until(lambda: _gone(child))


async def test_a_program_does_not_outlive_a_decision_that_is_killed(tmp_path: Path) -> None:
    folder = program(tmp_path, f"sleep 600 & echo $! > {tmp_path}/child; wait")
    text = (
        "import asyncio\n"
        "from gigabrain_zenoh.tasks.mission import Script\n"
        "from gigabrain_zenoh.tasks.scripts import Scripts\n"
        "async def main():\n"
        f"    Scripts({folder!r}).start(Script(run='beep'))\n"
        "    await asyncio.sleep(600)\n"
        "asyncio.run(main())\n"
    )
    decision = await asyncio.create_subprocess_exec(sys.executable, "-c", text)
    file = tmp_path / "child"
    await until(lambda: file.exists() and file.read_text().strip())
    child = int(file.read_text())
    assert not _gone(child)
    decision.kill()
    await decision.wait()
    await until(lambda: _gone(child))


def _gone(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status")
    return not status.exists() or "State:\tZ" in status.read_text()


@pytest.mark.parametrize("name", ["../beep", "/bin/sh", "boop"])
def test_no_program_of_elsewhere_is_run(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="no script"):
        Scripts(program(tmp_path, "exit 0")).path(name)


def test_a_program_that_may_not_be_run_is_refused(tmp_path: Path) -> None:
    folder = program(tmp_path, "exit 0")
    (tmp_path / "beep").chmod(0o644)
    with pytest.raises(Refused, match="script 'beep' may not be run; chmod \\+x "):
        Scripts(folder).path("beep")


async def test_a_script_hears_how_its_goal_ended(site: Site) -> None:
    await site.step()
    tasks = Tasks(site.net.two)
    name = await tasks.go_to(3.0, 0.0)
    seen: list[TaskStatus] = []
    waiting = asyncio.ensure_future(tasks.result(name, seen.append))
    await site.step(10)
    assert isinstance(site.order, GoTo)
    site.outcome = Outcome(number=site.order.number, state="failed", reason="a wall")
    await site.step(10)
    end = await waiting
    assert (end.id, end.state, end.reason) == ("goal-1", "failed", "a wall")
    assert seen[-1].current
    await site.end()


async def test_a_script_is_told_who_is_missing() -> None:
    net = Net()
    with pytest.raises(BodyLost, match="nobody serves goals; does decision run with behaviour: n"):
        await Tasks(net.two, starting_s=0.0).go_to(1.0, 0.0)


async def test_a_goal_that_comes_while_the_robot_starts_waits_for_who_serves_goals() -> None:
    net, said = Net(), list[str]()
    tasks = Tasks(net.two, on_wait=said.append, starting_s=60.0)
    sending = asyncio.ensure_future(tasks.go_to(1.0, 0.0))
    await until(lambda: said)
    assert said == ["waiting: nobody serves goals yet; is the robot just starting?"]

    async def answer(request: GoalRequest) -> GoalReply:
        return GoalReply(ok=True, text="accepted", goal=f"goal to {request.x:g}")

    net.one.serve(GOAL, answer)
    assert await sending == "goal to 1"
    assert len(said) == 1


@pytest.mark.parametrize("x", [math.nan, math.inf, -1e300])
async def test_a_script_is_told_of_a_goal_that_is_no_place(x: float) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"numbers up to 1e+09, got {x:g} 0 1")):
        await Tasks(Net().two).go_to(x, 0.0, 1.0)


async def test_a_refusal_reaches_the_script(site: Site) -> None:
    await site.step()
    site.wall = "the goal is outside the map"
    tasks = Tasks(site.net.two)
    with pytest.raises(Refused, match="the goal is outside the map"):
        await tasks.go_to(1.0, 0.0)
    with pytest.raises(Refused, match="there is nothing to do"):
        await tasks.cancel()
    assert (await tasks.explore()) == "mission-1"
    assert await tasks.pause() == "mission-1 is paused"
    await site.step()
    assert (await tasks.status()).current
    await site.end()


async def test_what_was_granted_is_told_with_the_tick_and_the_world_from_which_it_counts(
    site: Site,
) -> None:
    told: list[Granted] = []
    site.net.two.subscribe(GRANTED, lambda _key, granted: told.append(granted))
    await site.step()
    site.service.step(state(7), None, basis=5)
    site.net.one.time.see(state(7))
    await site.go(3.0)
    await site.change("pause")
    site.wall = "the goal is inside a wall"
    await site.go(4.0)
    assert [(one.service, one.tick, one.basis) for one in told] == [
        ("robot/goal", 7, 5),
        ("robot/task_change", 7, 5),
    ]
    asked = msgspec.json.decode(told[0].request, type=GoalRequest)
    assert (asked.x, asked.source) == (3.0, "ann")
    await site.end()
