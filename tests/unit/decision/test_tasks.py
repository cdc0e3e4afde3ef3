"""Tasks on the bus and on disk: requests, replies, status and restarts."""

import errno
import os
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.logs import AcceptedRequest
from gigabrain_schemas.tasks import Goal, GoalReply, GoalRequest
from gigabrain_schemas.topics import POSE, REQUEST_LOG, ZONES
from gigabrain_schemas.zones import Place, Zones
from gigabrain_zenoh.decision import task_server
from gigabrain_zenoh.decision.behaviours import StepOutcome
from gigabrain_zenoh.decision.tasks import mission_files, task_queue
from gigabrain_zenoh.decision.tasks.mission import Mission
from gigabrain_zenoh.decision.tasks.task_queue import TaskFile
from gigabrain_zenoh.testing.samples import BOOT, state
from gigabrain_zenoh.testing.waiting import settle
from tests.unit.decision.sites import Site


@pytest.fixture
async def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


async def test_a_goal_is_accepted_with_its_path_and_then_published(site: Site) -> None:
    await site.step()
    reply = await site.go(3.0)
    assert reply == GoalReply(ok=True, text="goal-1: on the way, 4.2 m", goal="goal-1")
    await site.step()
    assert site.command
    assert site.command.goal
    assert site.command.goal == Goal(x=3.0, y=0.0)
    site.outcome = StepOutcome(number=site.command.number, progress=0.5, distance=2.1, eta=8.0)
    await site.step(10)
    now = site.told[-1]
    assert (now.doing, now.progress, now.distance_remaining) == ("going to (3.00, 0.00)", 0.5, 2.1)
    site.outcome = StepOutcome(number=site.command.number, state="done", reason="at (3.00, 0.00)")
    await site.step()
    assert [(task.id, task.state) for task in site.told[-1].done] == [("goal-1", "succeeded")]
    assert site.told[-1].current is None
    await site.end()


async def test_the_event_loop_runs_while_a_mission_is_parsed(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    readers: list[bool] = []

    def loads(text: str, source: str, places: tuple[Place, ...]) -> Mission:
        readers.append(threading.current_thread() is threading.main_thread())
        return mission_files.loads(text, source, places)

    monkeypatch.setattr(task_server, "mission_files", SimpleNamespace(loads=loads))
    await site.step()
    assert (await site.carry_out("do: [{wait: 5}]")).ok
    assert readers == [False]
    await site.end()


async def test_the_status_is_published_at_5_hz_of_the_robots_time(site: Site) -> None:
    await site.step()
    before = len(site.told)
    for _ in range(20):
        await site.step(5)
    assert len(site.told) - before == 10
    await site.end()


async def test_a_goal_that_cannot_be_reached_is_refused_and_changes_nothing(site: Site) -> None:
    await site.step()
    await site.go(3.0)
    site.wall = (
        "the goal is inside an obstacle; nearest reachable point is 0.4 m away at (1.2, 0.3)"
    )
    assert await site.go(4.0) == GoalReply(ok=False, text=site.wall)
    await site.step()
    assert site.command
    assert site.command.goal
    assert site.command.goal.x == 3.0
    await site.end()


@pytest.mark.parametrize("body", [b'{"x": NaN, "y": 0}', b'{"x": 1e999, "y": 0}', b'{"x": 1}'])
async def test_a_goal_without_valid_coordinates_is_refused(site: Site, body: bytes) -> None:
    replies = await site.net.network.transport().query("robot/goal", body, "", 1.0, "data")
    assert len(replies) == 1
    assert isinstance(replies[0], str)
    assert replies[0].startswith("not a valid GoalRequest: ")
    await site.end()


async def test_missions_are_checked_before_they_are_accepted(site: Site, tmp_path: Path) -> None:
    await site.step()
    for text, why in (
        ("do:\n- gotoo: a", "tea:2: unknown field 'gotoo'; did you mean 'goto'?"),
        ("trees: {a: [{tree: a}]}\ndo: [{tree: a}]", "is a cycle: a → a; remove a step"),
        (
            "do: [{script: {run: beep}}]",
            "script 'beep': this robot runs no scripts; name their folder",
        ),
    ):
        reply = await site.carry_out(text)
        assert not reply.ok
        assert why in reply.text
    site.lost = "no localization"
    assert (await site.carry_out("do: [{explore: {}}]")).text == site.lost
    assert (await site.carry_out("do: [{wait: 5}]")).ok
    await site.end()


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text there")
async def test_an_unknown_script_beside_one_with_an_undecodable_name_is_refused(
    tmp_path: Path,
) -> None:
    (tmp_path / os.fsdecode(b"caf\xe9")).touch()
    site = Site(tmp_path / "state", scripts=str(tmp_path))
    await site.step()
    reply = await site.carry_out("do: [{script: {run: beep}}]")
    assert (reply.ok, reply.text) == (False, "no script 'beep'; known: caf?")
    assert not site.net.one.failed.done()
    await site.end()


async def test_a_folder_of_scripts_that_cannot_be_read_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(_: Path) -> bool:
        raise PermissionError(errno.EACCES, "Permission denied")

    (tmp_path / "beep").touch()
    site = Site(tmp_path / "state", scripts=str(tmp_path))
    await site.step()
    monkeypatch.setattr(Path, "is_file", closed)
    reply = await site.carry_out("do: [{script: {run: beep}}]")
    assert reply.text == f"script 'beep': {tmp_path} cannot be read: Permission denied"
    monkeypatch.undo()
    await site.end()


async def test_the_first_check_of_a_topic_waits_for_its_message(
    site: Site,
) -> None:
    await site.step()
    assert (await site.carry_out("do: [{check: pose.x > 1}, {wait: 5}]")).ok
    for _ in range(4):
        await site.step()
        site.net.two.time.boot, site.net.two.time.tick = BOOT, site.tick
        site.net.two.publish(POSE, PoseInMap(x=2.0, y=0.0, yaw=0.0, covariance=(0.0,) * 9))
    await site.step(10)
    assert [one.reason for one in site.told[-1].done] == []
    assert site.told[-1].doing == "waiting 5 s"
    await site.end()


async def test_pausing_resuming_and_cancelling(site: Site) -> None:
    await site.step()
    await site.go(3.0)
    await site.go(4.0, how="queue")
    assert (await site.change("pause")).text == "goal-1 is paused"
    await site.step()
    assert site.command is None
    assert site.told[-1].current
    assert site.told[-1].current.reason == "paused by bob"
    assert (await site.change("resume")).text == "goal-1 is resumed"
    assert (await site.change("cancel")).text == "goal-1 is cancelled"
    await site.step()
    assert site.command
    assert site.command.goal
    assert site.command.goal.x == 4.0
    refused = await site.change("cancel", "goal-1")
    assert (refused.ok, refused.text) == (
        False,
        "there is no task 'goal-1'; tasks: goal-2",
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
    assert again.command
    assert again.command.goal
    assert again.command.goal.x == 3.0
    assert [task.id for task in again.told[-1].queue] == ["goal-2"]
    assert (await again.go(5.0, how="queue")).goal == "goal-3"
    await again.end()


@pytest.mark.parametrize(
    ("map", "loaded", "goes_on"), [("hall", 1, True), ("yard", 1, False), ("hall", 2, False)]
)
async def test_tasks_continue_only_in_their_map_after_a_restart_of_decision(
    site: Site, tmp_path: Path, map: str, loaded: int, goes_on: bool
) -> None:
    site.net.two.publish(ZONES, Zones(boot=BOOT, map="", maps_loaded=1))
    await site.step()
    await site.go(3.0)
    await site.step()
    site.net.two.publish(ZONES, Zones(boot=BOOT, map="hall", maps_loaded=1))  # the map is saved
    await site.step()
    assert site.command
    await site.end()
    again = Site(tmp_path)
    again.net.two.publish(ZONES, Zones(boot=BOOT, map=map, maps_loaded=loaded))
    await again.step(site.tick + 50)
    await again.step()
    assert bool(again.command) == goes_on
    if not goes_on:
        assert again.told[-1].done[0].state == "cancelled"
    await again.end()


@pytest.mark.parametrize(("known", "ok"), [(True, False), (False, True)])
async def test_a_request_is_refused_if_another_map_is_loaded_meanwhile(
    site: Site, monkeypatch: pytest.MonkeyPatch, known: bool, ok: bool
) -> None:
    loaded = 0

    async def check(_: Goal | None) -> str:
        nonlocal loaded
        loaded += 1
        site.net.two.publish(ZONES, Zones(boot=BOOT, map="yard", maps_loaded=loaded))
        await settle()
        return "on the way, 4.2 m"

    monkeypatch.setattr(site.service, "_check", check)
    if known:  # else the first message arrives during the check
        site.net.two.publish(ZONES, Zones(boot=BOOT, map="house", maps_loaded=0))
    await site.step()
    goal = await site.go(3.0)
    assert goal.ok == ok
    if not ok:
        assert goal.text == "another map was loaded meanwhile; send the goal again for this map"
        assert not (await site.carry_out("do: [{goto: [3, 0]}]")).ok
        await site.step()
        assert site.command is None
    await site.end()


async def test_tasks_of_another_start_of_the_robot_wait_for_a_person(
    site: Site, tmp_path: Path
) -> None:
    await site.step()
    await site.go(3.0)
    await site.step()
    await site.end()
    again = Site(tmp_path)
    await again.step(boot=BOOT + 1)
    assert again.command is None
    assert (await again.change("resume")).ok
    await again.step(boot=BOOT + 1)
    assert again.command
    await again.end()


@pytest.mark.parametrize(
    "content", [b'{"type":"gigabrain tasks","co', b'{"jobs": 3}', b"", b"\xff"]
)
async def test_a_damaged_file_is_renamed_and_reported(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "tasks.json").write_bytes(content)
    site = Site(tmp_path)
    await site.step()
    assert site.command is None
    assert "tasks.bad, no tasks restored" in caplog.text
    assert (tmp_path / "tasks.bad").read_bytes() == content
    await site.go(3.0)
    await site.end()
    assert len(TaskFile(str(tmp_path)).read()[0].jobs) == 1


async def test_a_disk_that_cannot_be_written_is_reported_and_the_robot_continues(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    site = Site(tmp_path / "file" / "folder")
    await site.step()
    await site.go(3.0)
    await site.step()
    await site.end()
    await settle()
    assert site.command
    assert "tasks will not survive a restart" in caplog.text


async def test_a_task_cancelled_while_the_disk_is_full_does_not_return(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    caplog.set_level("INFO")
    site = Site(tmp_path)
    await site.step()
    await site.go(3.0)
    await site.end()
    assert len(TaskFile(str(tmp_path)).read()[0].jobs) == 1
    with monkeypatch.context() as patch:
        patch.setattr(task_queue, "replace_file", full)
        await site.change("cancel")
        await site.end()
    assert len(TaskFile(str(tmp_path)).read()[0].jobs) == 1
    await settle()
    await site.step(10)
    await site.end()
    await settle()
    assert TaskFile(str(tmp_path)).read()[0].jobs == ()
    assert [one for one in caplog.messages if "survive" in one or "saved" in one] == [
        f"cannot write {tmp_path}/tasks.json: No space left on device; "
        "tasks will not survive a restart",
        "tasks are saved again",
    ]


async def test_accepted_requests_are_published_with_the_tick_and_world_model_of_their_effect(
    site: Site,
) -> None:
    told: list[AcceptedRequest] = []
    site.net.two.subscribe(REQUEST_LOG, lambda _key, granted: told.append(granted))
    await site.step()
    site.service.step(state(7), None, basis=5)
    site.net.one.time.observe(state(7))
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
