"""The task queue: order, cancellation and restarts."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_schemas.tasks import MAX_REQUEST_BYTES, Goal
from gigabrain_zenoh.decision.behaviours import describe_end
from gigabrain_zenoh.decision.tasks import task_queue
from gigabrain_zenoh.decision.tasks.arm_steps import HeldThing, Solid
from gigabrain_zenoh.decision.tasks.mission import Mission, Step
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskFile
from gigabrain_zenoh.errors import Refused
from tests.unit.decision.sites import Robot, one_robot


@pytest.fixture
def robot() -> Iterator[Robot]:
    with one_robot() as made:
        yield made


def test_goals_are_queued_or_go_first_or_replace_all(robot: Robot) -> None:
    tasks = robot.tasks
    tasks.add_goal(Goal(x=1.0, y=0.0), "replace", "ann")
    tasks.add_goal(Goal(x=2.0, y=0.0), "queue", "ann")
    assert robot.step() == 1.0
    tasks.add_goal(Goal(x=3.0, y=0.0), "preempt", "bob")
    assert robot.step() == 3.0
    waiting = [(task.id, task.state, task.reason) for task in robot.status.queue]
    assert waiting == [("goal-1", "paused", "preempted by goal-3"), ("goal-2", "queued", "")]
    assert robot.reached() == 1.0
    assert robot.reached() == 2.0
    tasks.add_goal(Goal(x=4.0, y=0.0), "replace", "bob")
    assert robot.step() == 4.0
    assert robot.last == ("cancelled", "replaced by goal-4")


def test_the_end_of_a_task_is_described_as_text(robot: Robot) -> None:
    robot.carry_out("do: [{goto: a}]")
    robot.carry_out("do: [{goto: b}]")
    robot.step()
    robot.failed()
    assert [describe_end(task) for task in robot.status.done] == [
        "mission-2 has failed: b: no way",
        "mission-1 was replaced by mission-2",
    ]
    robot.carry_out("do: [{goto: a}]")
    robot.tasks.cancel("", "bob")
    assert describe_end(robot.status.done[0]) == "mission-3 was cancelled by bob"


def test_resuming_a_task_that_waits_names_the_active_one(robot: Robot) -> None:
    robot.tasks.add_goal(Goal(x=1.0, y=0.0), "replace", "ann")
    robot.step()
    robot.tasks.add_goal(Goal(x=2.0, y=0.0), "preempt", "bob")
    robot.tasks.add_goal(Goal(x=3.0, y=0.0), "queue", "bob")
    assert [one.state for one in robot.status.queue] == ["paused", "queued"]
    for name in ("goal-1", "goal-3"):
        with pytest.raises(Refused, match=f"{name} waits for goal-2; it continues after that"):
            robot.tasks.resume(name)
    with pytest.raises(Refused, match="goal-2 is not paused"):
        robot.tasks.resume("")


def test_tasks_are_cancelled_by_name_or_all_at_once(robot: Robot) -> None:
    for x in (1.0, 2.0, 3.0):
        robot.tasks.add_goal(Goal(x=x, y=0.0), "queue", "ann")
    assert robot.tasks.cancel("goal-2", "bob") == "goal-2 is cancelled"
    assert robot.tasks.cancel("", "bob") == "goal-1 is cancelled"
    assert robot.last == ("cancelled", "cancelled by bob")
    assert robot.step() == 3.0
    assert robot.tasks.cancel("all", "bob") == "1 task is cancelled"
    assert robot.step() is None
    with pytest.raises(Refused, match="there is no task"):
        robot.tasks.cancel("", "bob")


def test_an_unknown_task_is_refused_with_the_known_ones(robot: Robot) -> None:
    robot.tasks.add_goal(Goal(x=1.0, y=0.0), "queue", "ann")
    with pytest.raises(Refused, match="no task 'goal-7'; tasks: goal-1"):
        robot.tasks.cancel("goal-7", "bob")
    with pytest.raises(Refused, match="goal-1 is not paused"):
        robot.tasks.resume("goal-1")


def test_at_most_32_tasks_are_queued(robot: Robot) -> None:
    for _ in range(33):
        robot.tasks.add_goal(Goal(x=1.0, y=0.0), "queue", "ann")
    with pytest.raises(Refused, match="32 tasks wait already; cancel some first"):
        robot.tasks.add_goal(Goal(x=1.0, y=0.0), "queue", "ann")
    assert len(robot.status.queue) == 32


ROUND = (
    "do:\n- goto: c\n- retry:\n    times: 3\n    do:\n"
    "    - repeat: {times: 3, do: [{goto: a}, {goto: b}]}\n"
)


def test_after_a_restart_a_mission_continues_with_its_step(robot: Robot) -> None:
    robot.tasks.restart(7)
    robot.carry_out(ROUND)
    robot.tasks.add_goal(Goal(x=9.0, y=0.0), "queue", "ann")
    assert robot.step() == 3.0
    robot.reached()
    robot.failed()  # a, in the first of three attempts
    assert robot.step() == 1.0
    assert robot.reached() == 2.0  # b, in the first of three rounds
    robot.reached()
    assert robot.step() == 1.0
    assert robot.reached() == 2.0  # b, in the second
    again = Robot(robot.tasks.saved)
    again.tasks.restart(7)
    assert again.step() == 2.0
    again.reached()
    seen = [again.step(), again.reached(), again.reached()]
    assert seen == [1.0, 2.0, 9.0]  # the third round, and the queued task
    assert again.tasks.add_goal(Goal(x=1.0, y=0.0), "queue", "ann") == "goal-3"


@pytest.mark.parametrize(
    "name", ["\x01", "\x7f", "\x9b", "\x85", "\u2028", "\ufeff", "\uffff", "🤖"]
)
def test_after_a_restart_a_name_may_contain_the_same_characters(robot: Robot, name: str) -> None:
    escaped = f'"a\\U{ord(name):08x}b"'
    robot.carry_out(f"trees: {{{escaped}: [{{goto: a}}]}}\ndo: [{{tree: {escaped}}}]")
    robot.tasks.add_find(f"a{name}b", "queue", "ann")
    again = Robot(robot.tasks.saved)
    assert [task.reason for task in again.status.done] == []
    assert [job.mission for job in again.tasks.saved.jobs] == [
        job.mission for job in robot.tasks.saved.jobs
    ]
    assert again.step() == 1.0


def test_after_a_restart_an_invalid_mission_fails_with_the_reason(robot: Robot) -> None:
    robot.carry_out("do: [{check: pose.x > 1}, {wait: 1}]")
    (job,) = robot.tasks.saved.jobs
    other = replace(job, mission=job.mission.replace("pose.x", "pose.q"))
    damaged = replace(job, mission=job.mission[:-1])
    reasons = [task.reason for task in Robot(Saved(jobs=(other, damaged))).status.done]
    assert reasons[0].startswith("the saved mission is invalid: m:2: not YAML: ")
    assert reasons[1].startswith("the saved mission is invalid: m:1: do[0].check: no field 'q'")


def test_after_a_restart_failures_are_still_counted(robot: Robot) -> None:
    robot.carry_out("do: [{retry: {times: 3, do: [{goto: a}]}}]")
    robot.step()
    robot.failed()
    robot.step()
    robot.failed()
    robot.step()
    again = Robot(robot.tasks.saved)
    again.step()
    again.failed()
    assert again.last == ("failed", "a: no way")


def test_after_a_restart_a_paused_task_stays_paused_with_its_reason(robot: Robot) -> None:
    robot.carry_out("do: [{script: {run: beep}}]")
    robot.step()
    robot.tasks.pause("", "ann")
    again = Robot(robot.tasks.saved)
    again.step()
    current = again.status.current
    assert current
    assert (current.state, current.reason) == ("paused", "paused by ann")
    assert again.programs == []
    again.tasks.resume("")
    again.step()
    assert len(again.programs) == 1
    robot.tasks.cancel("", "ann")


def test_after_a_start_of_the_whole_robot_tasks_wait_for_a_person(robot: Robot) -> None:
    robot.tasks.restart(7)
    robot.carry_out("do: [{goto: a}]")
    robot.step()
    again = Robot(robot.tasks.saved)
    again.tasks.restart(8)
    assert again.step() is None
    current = again.status.current
    assert current
    assert (current.state, current.reason) == (
        "paused",
        "the robot was restarted; resume the task, or cancel it",
    )
    assert again.tasks.resume("") == "mission-1 is resumed"
    assert again.step() == 1.0
    again.tasks.restart(9)  # only the driver restarted: the gate waits for a person already
    assert again.step() == 1.0


LEVEL = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
HOLDS = HeldThing(name="cup", solid=Solid(sphere=0.03), axes=LEVEL, grip=0.5, opening=1.0)


@pytest.mark.long
def test_a_file_of_the_longest_missions_can_be_read(robot: Robot, tmp_path: Path) -> None:
    names = [f"c{k}" for k in range(10_000, 14_800)]
    text = f"things: {{{','.join(f'{name}: {{sphere: 1}}' for name in names)}}}\ndo: [{{goto: a}}]"
    assert 0.9 * MAX_REQUEST_BYTES < len(text) < MAX_REQUEST_BYTES
    things = dict.fromkeys(names, Solid(sphere=1.0))
    mission = Mission(things=things, do=(Step(goto=(1.0, 0.0)),))
    robot.tasks.add_mission(mission, "m", "queue", "ann")
    (longest,) = robot.tasks.saved.jobs
    moved = Solid(sphere=1.0, at=(-1 / 3, -1 / 3, -1 / 3), yaw=-1 / 3)
    longest = replace(longest, things=dict.fromkeys(names, moved))
    file, saved = TaskFile(str(tmp_path)), Saved(jobs=(longest,) * 33, held=HOLDS)
    assert file.write([saved]) == ""
    assert file.read() == (saved, "")


def test_a_file_too_large_to_be_read_is_not_written(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, before = TaskFile(str(tmp_path)), Saved(held=HOLDS)
    file.write([before])
    size = (tmp_path / "tasks.json").stat().st_size
    monkeypatch.setattr(task_queue, "MAX_FILE_BYTES", size)
    robot.carry_out(ROUND)
    problem = file.write([replace(before, jobs=robot.tasks.saved.jobs)])
    assert problem.startswith("not saved: ")
    assert problem.endswith("; tasks will not survive a restart")
    assert file.read() == (before, "")
