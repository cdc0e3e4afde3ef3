"""The steps of missions by kind: their commands and their results."""

from collections.abc import Iterator

import pytest

from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.tasks.mission import Script
from tests.unit.decision.sites import Robot, one_robot


@pytest.fixture
def robot() -> Iterator[Robot]:
    with one_robot() as made:
        yield made


def test_a_goal_is_a_command_until_it_is_reached(robot: Robot) -> None:
    name = robot.tasks.add_goal(Goal(x=4.0, y=1.0), "replace", "ann")
    assert name == "goal-1"
    assert [robot.step(), robot.step()] == [4.0, 4.0]
    current = robot.status.current
    assert current
    assert (current.state, current.label, current.source) == ("active", "(4.00, 1.00)", "ann")
    assert robot.reached() is None
    assert robot.last == ("succeeded", "it is there")
    assert robot.status.current is None


def test_a_goal_that_cannot_be_reached_fails_with_the_reason(robot: Robot) -> None:
    robot.tasks.add_goal(Goal(x=4.0, y=1.0), "replace", "ann")
    robot.step()
    assert robot.failed("a wall") is None
    assert robot.last == ("failed", "a wall")


def test_a_sequence_continues_with_the_next_place_at_once(robot: Robot) -> None:
    robot.carry_out("do: [{goto: a}, {goto: b}, {wait: 5}]")
    assert robot.step() == 1.0
    assert robot.reached() == 2.0
    assert robot.reached() is None
    assert robot.status.doing == "waiting 5 s"
    robot.step(2.0)
    assert (robot.status.progress, robot.status.eta) == (pytest.approx(0.4), pytest.approx(3.0))
    robot.step(3.0)
    assert robot.last[0] == "succeeded"


def test_a_step_after_a_wait_begins_with_no_progress(robot: Robot) -> None:
    robot.carry_out("do: [{wait: 5}, {goto: a}]")
    robot.step()
    assert robot.step(5.0) == 1.0
    status = robot.status
    assert (status.doing, status.progress, status.eta) == ("going to a", 0.0, None)


def test_a_sequence_ends_with_the_step_that_fails(robot: Robot) -> None:
    robot.carry_out("do: [{goto: a}, {goto: b}]")
    robot.step()
    assert robot.failed() is None
    assert robot.last == ("failed", "a: no way")


def test_a_fallback_ends_with_the_first_step_that_succeeds(robot: Robot) -> None:
    robot.carry_out("do: [{fallback: [{goto: a}, {goto: b}, {goto: c}]}]")
    assert robot.step() == 1.0
    assert robot.failed() == 2.0
    assert robot.reached() is None
    assert robot.last[0] == "succeeded"


def test_a_mission_that_succeeds_does_not_name_earlier_failures(robot: Robot) -> None:
    robot.carry_out("do: [{fallback: [{goto: a}, {check: battery.percentage > 1}]}]")
    assert robot.step() == 1.0
    assert robot.failed("a wall") is None
    assert robot.last == ("succeeded", "")


def test_a_retry_issues_a_new_command_each_time_and_gives_up_after_the_last(robot: Robot) -> None:
    robot.carry_out("do: [{retry: {times: 3, do: [{goto: a}]}}]")
    robot.step()
    numbers = []
    for _ in range(3):
        assert robot.command
        numbers.append(robot.command.number)
        robot.failed()
        robot.step()
    assert len(set(numbers)) == 3
    assert robot.last == ("failed", "a: no way")


def test_a_timeout_fails_by_the_robots_time_and_withdraws_the_command(robot: Robot) -> None:
    robot.carry_out("do: [{timeout: {seconds: 10, do: [{goto: a}]}}]")
    assert [robot.step(5.0) for _ in range(3)] == [1.0, 1.0, 1.0]  # starts at the first step
    assert robot.step(0.1) is None
    assert robot.last == ("failed", "going to a: not done within 10 s")


def test_a_pause_stops_the_timer_of_a_timeout(robot: Robot) -> None:
    robot.carry_out("do: [{timeout: {seconds: 10, do: [{goto: a}]}}]")
    robot.step()
    robot.tasks.pause("", "ann")
    assert [robot.step(60.0), robot.step(60.0)] == [None, None]
    robot.tasks.resume("")
    assert robot.step(1.0) == 1.0


def test_a_patrol_repeats_its_round_as_often_as_given(robot: Robot) -> None:
    robot.carry_out("do: [{patrol: {points: [a, [7, 7]], loops: 2}}]")
    seen = [robot.step()]
    while robot.status.current:
        seen.append(robot.reached() or robot.step())
    assert seen == [1.0, 7.0, 1.0, 7.0, None]
    assert robot.last[0] == "succeeded"


def test_exploring_is_its_own_kind_of_command(robot: Robot) -> None:
    robot.carry_out("do: [{explore: {}}, {goto: dock}]")
    assert robot.step() == "explore"
    assert robot.reached() == 0.0
    assert robot.status.doing == "going to dock"


def test_a_low_battery_interrupts_the_mission_for_the_dock(robot: Robot) -> None:
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
    assert robot.step() == 2.0  # it does not repeat place a


def test_a_timeout_does_not_run_while_the_robot_charges(robot: Robot) -> None:
    within = "{timeout: {seconds: 100, do: [{goto: a}]}}"
    robot.carry_out(
        f"do: [{{battery_below: {{percentage: 20, goto: dock, until: 80, do: [{within}]}}}}]"
    )
    robot.step()
    assert robot.step(60.0) == 1.0
    robot.charge = 19.0
    assert robot.step() == 0.0
    robot.reached()
    robot.step(3600.0)
    again = Robot(robot.tasks.saved)  # the same after a restart
    for one in (robot, again):
        one.charge = 80.0
        one.step(600.0)
        assert one.step(30.0) == 1.0
        assert one.step(20.0) is None
        assert one.last == ("failed", "going to a: not done within 100 s")


def test_a_timeout_around_the_charging_runs_while_the_robot_charges(robot: Robot) -> None:
    low = "{battery_below: {percentage: 20, goto: dock, until: 80, do: [{goto: a}]}}"
    robot.carry_out(f"do: [{{timeout: {{seconds: 10, do: [{low}]}}}}]")
    robot.step()
    robot.charge = 19.0
    robot.step()
    robot.reached()
    robot.step(11.0)
    assert robot.last[0] == "failed"


def test_a_dock_that_does_not_charge_ends_the_mission(robot: Robot) -> None:
    robot.carry_out("do: [{battery_below: {percentage: 20, goto: dock, do: [{goto: a}]}}]")
    robot.step()
    robot.charge = 19.0
    assert robot.step() == 0.0
    robot.reached()
    assert robot.last == (
        "failed",
        "battery.percentage < 20 still holds after the remedy",
    )


def test_waiting_until_a_condition_holds(robot: Robot) -> None:
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


def test_a_check_of_a_silent_topic_fails_after_a_second(robot: Robot) -> None:
    robot.carry_out("do: [{fallback: [{check: pose.x > 0}, {check: pose.y > 0}]}]")
    for _ in range(19):
        robot.step()
        assert robot.status.current
    robot.step(1.0)
    robot.step()
    assert robot.last == ("failed", "pose.y > 0 is not known")


def test_a_script_is_run_and_its_result_counts(robot: Robot) -> None:
    robot.carry_out("do: [{script: {run: beep, arguments: [twice]}}, {goto: a}]")
    robot.step()
    program = robot.programs[0]
    assert program.script == Script(run="beep", arguments=("twice",))
    program.result = True, "ended well"
    assert robot.step() == 1.0


def test_a_failed_script_gives_the_reason_and_a_cancelled_one_is_stopped(robot: Robot) -> None:
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


def test_a_script_is_paused_while_its_mission_is_paused(robot: Robot) -> None:
    robot.carry_out("do: [{script: {run: beep}}]")
    robot.step()
    robot.tasks.pause("", "ann")
    robot.step()
    assert robot.programs[0].paused
    robot.tasks.resume("")
    robot.step()
    assert not robot.programs[0].paused
    robot.tasks.cancel("", "ann")


def test_a_script_is_paused_while_another_task_is_active(robot: Robot) -> None:
    robot.carry_out("do: [{script: {run: beep}}]")
    robot.step()
    robot.carry_out("do: [{goto: a}]", "preempt")
    assert robot.step() == 1.0
    assert robot.programs[0].paused
    robot.reached()
    assert not robot.programs[0].paused
    robot.tasks.cancel("", "ann")


def test_a_script_is_paused_while_a_guard_interrupts_it(robot: Robot) -> None:
    low = "battery_below: {percentage: 20, goto: dock, until: 80, do: [{script: {run: beep}}]}"
    robot.carry_out(f"do: [{{{low}}}]")
    robot.step()
    robot.charge = 10.0
    assert robot.step() == 0.0
    assert robot.programs[0].paused
    robot.charge = 90.0
    robot.reached()
    robot.step()
    assert not robot.programs[0].paused
    robot.tasks.cancel("", "ann")


def test_a_paused_script_is_stopped_with_its_mission(robot: Robot) -> None:
    robot.carry_out("do: [{script: {run: beep}}]")
    robot.step()
    robot.tasks.pause("", "ann")
    robot.step()
    robot.tasks.cancel("", "ann")
    assert robot.programs[0].stopped
    robot.step()


def test_a_mission_that_is_paused_before_its_script_starts_it_when_resumed(robot: Robot) -> None:
    robot.carry_out("do: [{script: {run: beep}}]")
    robot.tasks.pause("", "ann")
    robot.step()
    assert robot.programs == []
    robot.tasks.resume("")
    robot.step()
    assert not robot.programs[0].paused
    robot.tasks.cancel("", "ann")
