"""The fault suite: its frame, and every fault once, in its short form, on real processes."""

import asyncio
from pathlib import Path

import pytest

from gigabrain_zenoh.errors import UnknownName
from gigabrain_zenoh.faults.fault import Fault, Limit, Result, Skipped, judge
from gigabrain_zenoh.faults.rig import Options, deployment_of
from gigabrain_zenoh.faults.suite import find_test, run_suite
from gigabrain_zenoh.faults.table import FAULTS, choose

FAULT = Fault(1, "decision-killed", "process", "", "zero after <= 120 ms, travel <= 0.1 m")


def test_the_table_has_all_44_faults_and_automatic_recovery() -> None:
    assert [fault.number for fault in FAULTS] == list(range(1, 46))
    assert len({fault.name for fault in FAULTS}) == 45


def test_every_criterion_can_be_measured() -> None:
    for fault in FAULTS:
        names = [limit.name for limit in fault.limits]
        assert len(set(names)) == len(names) > 0, fault.name


def test_a_criterion_says_figure_limit_and_unit() -> None:
    assert FAULT.limits == (Limit("zero after", 120.0, "ms"), Limit("travel", 0.1, "m"))


def test_the_worst_of_all_runs_is_judged() -> None:
    runs = [{"zero after": 100.0, "travel": 0.09}, {"zero after": 120.0, "travel": 0.05}]
    assert judge(FAULT, runs) == ("passed", "", {"zero after": 120.0, "travel": 0.09})


@pytest.mark.parametrize("travel", [0.1001, float("nan")])
def test_one_figure_of_one_run_over_its_limit_fails(travel: float) -> None:
    runs = [{"zero after": 100.0, "travel": 0.05}, {"zero after": 100.0, "travel": travel}]
    verdict, reason, _ = judge(FAULT, runs[::-1])
    assert verdict == "FAILED"
    assert reason == f"travel is {travel:g} m"


def test_a_test_that_measures_something_else_is_no_pass() -> None:
    with pytest.raises(ValueError, match="is judged by"):
        judge(FAULT, [{"travel": 0.05}])


def test_tests_are_chosen_by_name_or_number() -> None:
    assert [fault.number for fault in choose(["8", "decision-killed"])] == [1, 8]
    assert choose([]) == FAULTS
    with pytest.raises(UnknownName, match="did you mean 'decision-killed'"):
        choose(["decision-kiled"])


def test_a_test_is_the_function_of_its_name_in_the_module_of_its_group() -> None:
    assert find_test(FAULT).__name__ == "decision_killed"
    with pytest.raises(Skipped, match="not written yet"):
        find_test(Fault(1, "nobody-has-written-this", "process", "", "x <= 1"))


def test_a_body_without_the_line_in_question_is_skipped() -> None:
    assert deployment_of(Options(), "serial").body == "mycustombot"
    assert deployment_of(Options(body="alpha"), "sim").body == "alpha"
    with pytest.raises(Skipped, match="alpha has no serial line"):
        deployment_of(Options(body="alpha"), "serial")


async def test_what_cannot_run_is_skipped_and_says_why(tmp_path: Path) -> None:
    missing = Fault(2, "not-there", "process", "", "x <= 1")
    (result,) = await run_suite([missing], Options(), tmp_path)
    assert (result.verdict, result.reason, result.runs) == ("skipped", "not written yet", 0)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Result]:
    """What came of each fault; they share robots, so they run in one go."""
    running = run_suite(FAULTS, Options(), tmp_path_factory.mktemp("faults"))
    return {result.number: result for result in asyncio.run(running)}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_robot_stops_whatever_breaks(fault: Fault, results: dict[int, Result]) -> None:
    result = results[fault.number]
    if result.verdict == "skipped":
        pytest.skip(result.reason)
    assert result.verdict == "passed", f"{result.reason}; worst of all runs: {result.worst}"
