"""Missions: what a file may say, and what becomes of it when it is carried out."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.tasks import Goal, TaskStatus
from gigabrain_schemas.topics import STATE, Topic
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.tasks import checks
from gigabrain_zenoh.tasks.executive import Executive, Saved
from gigabrain_zenoh.tasks.mission import Script
from gigabrain_zenoh.tasks.orders import Explore, GoTo, Order, Outcome
from tests.brain_rig import state

PLACES = "places: {dock: [0, 0, 1.5], a: [1, 0], b: [2, 0], c: [3, 0]}\n"


class Program:
    """A program of the host that ends when the test says so."""

    def __init__(self, script: Script) -> None:
        self.script, self.stopped = script, False
        self.result: tuple[bool, str] | None = None

    def stop(self) -> None:
        self.stopped = True


class Robot:
    """An executive, on time that the test counts, and somebody who drives."""

    def __init__(self, saved: Saved | None = None) -> None:
        self.charge, self.programs = 100.0, list[Program]()
        self.pose: PoseInMap | None = None
        self.tasks = Executive(self._read, self._start, saved or Saved())
        self.order: Order | None = None
        self.outcome: Outcome | None = None

    def carry_out(self, text: str, how: Any = "replace") -> str:
        return self.tasks.carry_out(checks.loads(PLACES + text, "m"), "m", how, "ann")

    def step(self, seconds: float = 0.1) -> float | str | None:
        """One step; where the robot is wanted: x of a goal, `explore`, or nowhere."""
        self.order = self.tasks.step(seconds, self.outcome)
        self.outcome = None
        return _short(self.order)

    def reached(self) -> float | str | None:
        """What comes once it has got there."""
        return self._became("done", "it is there")

    def failed(self, why: str = "no way") -> float | str | None:
        """What comes when it cannot get there."""
        return self._became("failed", why)

    @property
    def status(self) -> TaskStatus:
        return self.tasks.status

    @property
    def last(self) -> tuple[str, str]:
        """How the last task ended."""
        return self.status.done[0].state, self.status.done[0].reason

    def _became(self, state: Any, reason: str) -> float | str | None:
        assert self.order
        self.outcome = Outcome(number=self.order.number, state=state, reason=reason)
        return self.step()

    def _read(self, topic: Topic[Any]) -> Message | None:
        return state(1, battery=self.charge) if topic is STATE else self.pose

    def _start(self, script: Script) -> Program:
        self.programs.append(Program(script))
        return self.programs[-1]


def _short(order: Order | None) -> float | str | None:
    if isinstance(order, GoTo):
        return order.goal.x
    return "explore" if isinstance(order, Explore) else None


@pytest.fixture
def robot() -> Iterator[Robot]:
    made = Robot()
    yield made
    assert all(program.stopped for program in made.programs)


def test_a_goal_is_an_order_until_it_is_reached(robot: Robot) -> None:
    name = robot.tasks.go_to(Goal(x=4.0, y=1.0), "replace", "ann")
    assert name == "goal-1"
    assert [robot.step(), robot.step()] == [4.0, 4.0]
    current = robot.status.current
    assert current
    assert (current.state, current.label, current.source) == ("active", "(4.00, 1.00)", "ann")
    assert robot.reached() is None
    assert robot.last == ("succeeded", "it is there")
    assert robot.status.current is None


def test_a_goal_that_cannot_be_reached_fails_with_the_reason(robot: Robot) -> None:
    robot.tasks.go_to(Goal(x=4.0, y=1.0), "replace", "ann")
    robot.step()
    assert robot.failed("a wall") is None
    assert robot.last == ("failed", "a wall")


def test_a_sequence_goes_on_to_the_next_place_at_once(robot: Robot) -> None:
    robot.carry_out("do: [{goto: a}, {goto: b}, {wait: 5}]")
    assert robot.step() == 1.0
    assert robot.reached() == 2.0
    assert robot.reached() is None
    assert robot.status.doing == "waiting 5 s"
    robot.step(2.0)
    assert (robot.status.progress, robot.status.eta) == (pytest.approx(0.4), pytest.approx(3.0))
    robot.step(3.0)
    assert robot.last[0] == "succeeded"


def test_a_sequence_ends_with_what_fails(robot: Robot) -> None:
    robot.carry_out("do: [{goto: a}, {goto: b}]")
    robot.step()
    assert robot.failed() is None
    assert robot.last == ("failed", "no way")


def test_a_fallback_takes_the_first_that_succeeds(robot: Robot) -> None:
    robot.carry_out("do: [{fallback: [{goto: a}, {goto: b}, {goto: c}]}]")
    assert robot.step() == 1.0
    assert robot.failed() == 2.0
    assert robot.reached() is None
    assert robot.last[0] == "succeeded"


def test_a_retry_gives_a_new_order_each_time_and_gives_up_after_so_many(robot: Robot) -> None:
    robot.carry_out("do: [{retry: {times: 3, do: [{goto: a}]}}]")
    robot.step()
    numbers = []
    for _ in range(3):
        assert robot.order
        numbers.append(robot.order.number)
        robot.failed()
        robot.step()
    assert len(set(numbers)) == 3
    assert robot.last == ("failed", "no way")


def test_a_timeout_fails_by_the_robots_time_and_withdraws_the_order(robot: Robot) -> None:
    robot.carry_out("do: [{timeout: {seconds: 10, do: [{goto: a}]}}]")
    assert [robot.step(5.0) for _ in range(3)] == [1.0, 1.0, 1.0]  # begun in the first step
    assert robot.step(0.1) is None
    assert robot.last == ("failed", "going to a: not done within 10 s")


def test_a_pause_holds_the_time_of_a_timeout(robot: Robot) -> None:
    robot.carry_out("do: [{timeout: {seconds: 10, do: [{goto: a}]}}]")
    robot.step()
    robot.tasks.pause("", "ann")
    assert [robot.step(60.0), robot.step(60.0)] == [None, None]
    robot.tasks.resume("")
    assert robot.step(1.0) == 1.0


def test_a_patrol_goes_round_as_often_as_it_is_told(robot: Robot) -> None:
    robot.carry_out("do: [{patrol: {points: [a, [7, 7]], loops: 2}}]")
    seen = [robot.step()]
    while robot.status.current:
        seen.append(robot.reached() or robot.step())
    assert seen == [1.0, 7.0, 1.0, 7.0, None]
    assert robot.last[0] == "succeeded"


def test_exploring_is_an_order_of_its_own(robot: Robot) -> None:
    robot.carry_out("do: [{explore: {}}, {goto: dock}]")
    assert robot.step() == "explore"
    assert robot.reached() == 0.0
    assert robot.status.doing == "going to dock"


def test_a_low_battery_sends_it_to_the_dock_and_then_on_where_it_was(robot: Robot) -> None:
    robot.carry_out(
        "do: [{battery_below: {percentage: 20, goto: dock, until: 80, do: [{goto: a}, {goto: b}]}}]"
    )
    robot.step()
    assert robot.reached() == 2.0
    robot.charge = 19.0
    assert robot.step() == 0.0
    assert robot.reached() is None
    assert robot.status.doing == "waiting until battery.percentage >= 80"
    robot.charge = 79.0
    assert robot.step() is None
    robot.charge = 80.0
    robot.step()
    assert robot.step() == 2.0  # and not to a again


def test_a_dock_that_does_not_charge_ends_the_mission(robot: Robot) -> None:
    robot.carry_out("do: [{battery_below: {percentage: 20, goto: dock, do: [{goto: a}]}}]")
    robot.step()
    robot.charge = 19.0
    assert robot.step() == 0.0
    robot.reached()
    assert robot.last == (
        "failed",
        "battery.percentage < 20 still holds after what is done about it",
    )


def test_waiting_until_a_field_is_as_wanted(robot: Robot) -> None:
    robot.carry_out("do: [{wait_until: pose.x > 2.5}]")
    robot.step()
    assert robot.status.doing == "waiting until pose.x > 2.5"
    covariance = (0.0,) * 9
    robot.pose = PoseInMap(x=2.0, y=0.0, yaw=0.0, covariance=covariance)
    robot.step()
    assert robot.status.current
    robot.pose = PoseInMap(x=2.6, y=0.0, yaw=0.0, covariance=covariance)
    robot.step()
    assert robot.last[0] == "succeeded"


@pytest.mark.parametrize(
    ("condition", "ended"),
    [
        ("battery.percentage >= 50", ("succeeded", "")),
        ("battery.percentage < 50", ("failed", "battery.percentage < 50 does not hold")),
        ("pose.x > 0", ("failed", "pose.x > 0 is not known")),
        ("gate.mode == enabled", ("succeeded", "")),
        ("state.gate.mode != enabled", ("failed", "state.gate.mode != enabled does not hold")),
        ("joints.0.temperature < 31", ("succeeded", "")),
        ("joints.7.temperature < 31", ("failed", "joints.7.temperature < 31 is not known")),
    ],
)
def test_a_check(robot: Robot, condition: str, ended: tuple[str, str]) -> None:
    robot.carry_out(f"do: [{{check: {condition}}}]")
    robot.step()
    assert robot.last == ended


def test_a_script_is_run_and_what_it_comes_to_counts(robot: Robot) -> None:
    robot.carry_out("do: [{script: {run: beep, arguments: [twice]}}, {goto: a}]")
    robot.step()
    program = robot.programs[0]
    assert program.script == Script(run="beep", arguments=("twice",))
    program.result = True, "ended well"
    assert robot.step() == 1.0


def test_a_script_that_fails_says_why_and_one_that_is_cancelled_is_ended(robot: Robot) -> None:
    robot.carry_out("do: [{script: {run: beep}}]")
    robot.step()
    robot.programs[0].result = False, "ended with exit code 3: no sound"
    robot.step()
    assert robot.last == ("failed", "beep ended with exit code 3: no sound")
    robot.carry_out("do: [{script: {run: beep}}]")
    robot.step()
    assert not robot.programs[1].stopped
    robot.tasks.cancel("", "ann")
    assert robot.programs[1].stopped


def test_goals_wait_in_a_queue_or_go_first_or_stand_in_for_all(robot: Robot) -> None:
    tasks = robot.tasks
    tasks.go_to(Goal(x=1.0, y=0.0), "replace", "ann")
    tasks.go_to(Goal(x=2.0, y=0.0), "queue", "ann")
    assert robot.step() == 1.0
    tasks.go_to(Goal(x=3.0, y=0.0), "preempt", "bob")
    assert robot.step() == 3.0
    waiting = [(task.id, task.state, task.reason) for task in robot.status.queue]
    assert waiting == [("goal-1", "paused", "until goal-3 is done"), ("goal-2", "queued", "")]
    assert robot.reached() == 1.0
    assert robot.reached() == 2.0
    tasks.go_to(Goal(x=4.0, y=0.0), "replace", "bob")
    assert robot.step() == 4.0
    assert robot.last == ("cancelled", "replaced by goal-4")


def test_cancelling_goes_by_name_and_all_at_once(robot: Robot) -> None:
    for x in (1.0, 2.0, 3.0):
        robot.tasks.go_to(Goal(x=x, y=0.0), "queue", "ann")
    assert robot.tasks.cancel("goal-2", "bob") == "goal-2 is cancelled"
    assert robot.tasks.cancel("", "bob") == "goal-1 is cancelled"
    assert robot.last == ("cancelled", "cancelled by bob")
    assert robot.step() == 3.0
    assert robot.tasks.cancel("all", "bob") == "1 task is cancelled"
    assert robot.step() is None
    with pytest.raises(Refused, match="there is nothing to do, so nothing to change"):
        robot.tasks.cancel("", "bob")


def test_a_task_that_is_not_there_is_named_with_those_that_are(robot: Robot) -> None:
    robot.tasks.go_to(Goal(x=1.0, y=0.0), "queue", "ann")
    with pytest.raises(Refused, match="no task 'goal-7' any more; there is: goal-1"):
        robot.tasks.cancel("goal-7", "bob")
    with pytest.raises(Refused, match="goal-1 is not paused"):
        robot.tasks.resume("goal-1")


def test_no_more_than_32_tasks_wait(robot: Robot) -> None:
    for _ in range(33):
        robot.tasks.go_to(Goal(x=1.0, y=0.0), "queue", "ann")
    with pytest.raises(Refused, match="32 tasks wait already; cancel some first"):
        robot.tasks.go_to(Goal(x=1.0, y=0.0), "queue", "ann")
    assert len(robot.status.queue) == 32


ROUND = (
    "do:\n- goto: c\n- retry:\n    times: 3\n    do:\n"
    "    - repeat: {times: 3, do: [{goto: a}, {goto: b}]}\n"
)


def test_after_a_restart_a_mission_goes_on_with_the_step_it_was_at(robot: Robot) -> None:
    robot.tasks.meet(7)
    robot.carry_out(ROUND)
    robot.tasks.go_to(Goal(x=9.0, y=0.0), "queue", "ann")
    assert robot.step() == 3.0
    robot.reached()
    robot.failed()  # a, in the first of three attempts
    assert robot.step() == 1.0
    assert robot.reached() == 2.0  # b, in the first of three rounds
    robot.reached()
    assert robot.step() == 1.0
    assert robot.reached() == 2.0  # b, in the second
    again = Robot(robot.tasks.saved)
    again.tasks.meet(7)
    assert again.step() == 2.0
    again.reached()
    seen = [again.step(), again.reached(), again.reached()]
    assert seen == [1.0, 2.0, 9.0]  # the third round, and what waited
    assert again.tasks.go_to(Goal(x=1.0, y=0.0), "queue", "ann") == "goal-3"


def test_after_a_restart_two_failures_are_still_two(robot: Robot) -> None:
    robot.carry_out("do: [{retry: {times: 3, do: [{goto: a}]}}]")
    robot.step()
    robot.failed()
    robot.step()
    robot.failed()
    robot.step()
    again = Robot(robot.tasks.saved)
    again.step()
    again.failed()
    assert again.last == ("failed", "no way")


def test_after_a_start_of_the_whole_robot_tasks_wait_for_a_person(robot: Robot) -> None:
    robot.tasks.meet(7)
    robot.carry_out("do: [{goto: a}]")
    robot.step()
    again = Robot(robot.tasks.saved)
    again.tasks.meet(8)
    assert again.step() is None
    current = again.status.current
    assert current
    assert (current.state, current.reason) == (
        "paused",
        "the robot was started anew; resume it, or cancel it",
    )
    assert again.tasks.resume("") == "mission-1 goes on"
    assert again.step() == 1.0
    again.tasks.meet(9)  # a driver that starts anew alone: the gate asks for a person already
    assert again.step() == 1.0


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("do: []", "m:1: do: expected a list of length >= 1, got a list of 0"),
        ("do:\n- gotoo: a", "m:2: unknown field 'gotoo'; did you mean 'goto'? known: "),
        ("do:\n- goto: a", "m:2: do[0].goto: no place 'a'; known: none"),
        (
            "places: {kitchen: [1, 2]}\ndo:\n- wait: 1\n- patrol: {points: [kichen]}",
            "m:4: do[1].patrol.points[0]: no place 'kichen'; did you mean 'kitchen'?",
        ),
        ("do:\n- goto: [1, .nan]", "m:2: .nan is not allowed; expected a finite number"),
        ("do:\n- goto: [1]", "m:2: do[0].goto: expected "),
        ("do:\n- wait: 1\n  goto: [1, 2]", "m:2: do[0].wait: a step is one thing"),
        ("do:\n- explore:", "m:2: do[0]: a step that does nothing; expected one of goto, "),
        ("do:\n- tree: b", "m:2: do[0].tree: no tree 'b'; known: none"),
        (
            "trees:\n  a: [{tree: b}]\n  b: [{retry: {times: 2, do: [{tree: a}]}}]\n"
            "do: [{tree: a}]",
            "m:2: trees.a: goes round in a circle: a → b → a",
        ),
        (
            "trees:\n  a: [{tree: a}]\ndo: [{wait: 1}]",
            "m:2: trees.a: goes round in a circle: a → a",
        ),
        ("do:\n- check: nonsense", "m:2: do[0].check: expected a field, one of < <= > >= == != "),
        (
            "do:\n- wait_until: battery.percentag < 3",
            "m:2: do[0].wait_until: no field 'percentag'; did you mean 'percentage'?",
        ),
        ("do:\n- check: pose.x == here", "pose.x is a number; it cannot be compared with 'here'"),
        ("do:\n- check: gate.mode < idle", "gate.mode is a word; expected == or !=, got <"),
        ("do:\n- check: pose.x < nan", "pose.x is a number; it cannot be compared with 'nan'"),
        ("do:\n- check: robot.legs < 4", "no field 'robot'"),
        ("do:\n- check: map.cells == 3", "map.cells is no number, word or truth value"),
        ("", "m:1: the file is empty"),
    ],
)
def test_a_mission_that_cannot_be_carried_out_is_refused_with_its_line(
    text: str, problem: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        checks.loads(text, "m")
    assert problem in str(refused.value)


def test_trees_that_multiply_are_refused() -> None:
    trees = "".join(f"  t{i}: [{{tree: t{i + 1}}}, {{tree: t{i + 1}}}]\n" for i in range(30))
    text = f"trees:\n{trees}  t30: [{{wait: 1}}]\ndo: [{{tree: t0}}]"
    with pytest.raises(ConfigError, match="more than 2000 steps once every tree is written out"):
        checks.loads(text, "m")


def test_a_file_says_which_mission_and_which_programs_it_needs(tmp_path: Path) -> None:
    file = tmp_path / "m.yaml"
    file.write_text("do: [{script: {run: beep}}, {wait: 3}]")
    mission, text = checks.load(file)
    assert list(checks.scripts(mission)) == ["beep"]
    assert not checks.drives(mission)
    assert text == file.read_text()
    file.write_text("points: [[1, 2], b]")
    with pytest.raises(ConfigError, match=r"m.yaml:1: points\[1\]: no place 'b'"):
        checks.load_patrol(file)
