"""The fault suite: its frame, and every fault once, in its short form, on real processes."""

import asyncio
import gc
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.topics import INTENT, WORLD
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.cli.faults import faults
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.renames import FAULT_NAMES
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.qa.faults.broken_process import HangingBus
from gigabrain_zenoh.qa.faults.rig import Options, Rig, deployment_of
from gigabrain_zenoh.qa.faults.rows.processes import decision_killed
from gigabrain_zenoh.qa.faults.suite import (
    FAULTS,
    POLL_S,
    RunQueueWatch,
    RunsFile,
    choose,
    failed,
    run_suite,
)
from gigabrain_zenoh.qa.judging import (
    Failed,
    FaultResult,
    FaultRow,
    FaultRun,
    Figure,
    Skipped,
    judge,
    worst_of,
)
from gigabrain_zenoh.testing.waiting import settle

BRAKES, TRAVEL = Figure("brakes after", "ms"), Figure("travel", "m")
LOST = Figure("lost")
LIMITS = (BRAKES.at_most(120), TRAVEL.at_most(0.1))
FAULT = FaultRow(1, decision_killed.test, "", LIMITS)


def test_every_row_has_a_number_and_a_name_of_its_own() -> None:
    assert [fault.number for fault in FAULTS] == list(range(1, len(FAULTS) + 1))
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


def test_every_criterion_can_be_measured() -> None:
    for fault in FAULTS:
        figures = [limit.figure for limit in fault.limits]
        assert len({figure.name for figure in figures}) == len(figures) > 0, fault.name


def test_a_criterion_says_figure_limit_unit_and_clock() -> None:
    assert FAULT.criterion == "brakes after <= 120 ms, travel <= 0.1 m"
    answer, slope = Figure("answer", "ms", wall=True), Figure("slope", "MB/h", long=True)
    limits = (answer.at_most(50), slope.at_most(1), LOST.at_most(0))
    pressed = replace(FAULT, limits=limits)
    assert pressed.criterion == "answer <= 50 ms wall, slope <= 1 MB/h long, lost <= 0"


def test_the_worst_of_all_runs_is_reported() -> None:
    runs = [{"brakes after": 100.0, "travel": 0.09}, {"brakes after": 120.0, "travel": 0.05}]
    assert worst_of(FAULT, runs) == {"brakes after": 120.0, "travel": 0.09}


@pytest.mark.parametrize("travel", [0.1001, float("nan")])
def test_one_figure_over_its_limit_fails(travel: float) -> None:
    assert judge(FAULT, {BRAKES: 100.0, TRAVEL: 0.1}) == ("passed", "")
    judged = judge(FAULT, {BRAKES: 100.0, TRAVEL: travel})
    assert judged == ("FAILED", f"travel is {travel:g} m")


def test_a_limit_of_the_wall_clock_is_judged_on_request() -> None:
    answer = Figure("answer", "ms", wall=True)
    pressed = replace(FAULT, limits=(answer.at_most(50), LOST.at_most(0)))
    late = {answer: 70.0, LOST: 0.0}
    assert judge(pressed, late) == ("FAILED", "answer is 70 ms")
    assert judge(pressed, late, wall=False) == ("passed", "")


def test_a_limit_of_the_long_form_is_measured_there_alone() -> None:
    slope = Figure("slope", "MB/h", long=True)
    soaked = replace(FAULT, limits=(LOST.at_most(0), slope.at_most(1)))
    assert judge(soaked, {LOST: 0.0}) == ("passed", "")
    grown = {LOST: 0.0, slope: 180.0}
    assert judge(soaked, grown, long=True) == ("FAILED", "slope is 180 MB/h")
    with pytest.raises(ValueError, match="is judged by"):
        judge(soaked, {LOST: 0.0}, long=True)


def test_a_test_that_measures_something_else_is_no_pass() -> None:
    with pytest.raises(ValueError, match="is judged by"):
        judge(FAULT, {TRAVEL: 0.05})


def test_tests_are_chosen_by_name_or_number() -> None:
    assert [fault.number for fault in choose(["8", "decision-killed"])] == [1, 8]
    assert choose([]) == FAULTS
    with pytest.raises(UnknownName, match="did you mean 'decision-killed'"):
        choose(["decision-kiled"])


def test_an_old_name_of_a_fault_prints_a_notice(capsys: pytest.CaptureFixture[str]) -> None:
    for rename in FAULT_NAMES:
        assert choose([rename.old])[0].name == rename.new
        assert f"'{rename.old}' is now '{rename.new}'" in capsys.readouterr().err


def test_a_row_holds_its_test_and_takes_its_name_from_it() -> None:
    assert (FAULT.test, FAULT.name, FAULT.group) == (
        decision_killed.test,
        "decision-killed",
        "processes",
    )


def test_a_body_without_the_line_in_question_is_skipped() -> None:
    assert deployment_of(Options(), "serial").body == "mycustombot"
    assert deployment_of(Options(body="alpha"), "sim").body == "alpha"
    with pytest.raises(Skipped, match="alpha has no serial line"):
        deployment_of(Options(body="alpha"), "serial")


def test_deaths_of_driver_and_emulator_are_judged_on_any_line_of_a_body() -> None:
    assert [fault.number for fault in FAULTS if fault.stage == "line"] == [7, 8, 11, 64]
    assert deployment_of(Options(), "line") == deployment_of(Options(), "serial")
    assert deployment_of(Options(body="alpha"), "line").link == "emulated"
    with pytest.raises(Skipped, match="mock has no line"):
        deployment_of(Options(body="mock"), "line")


def test_the_same_robots_can_be_had_navigating() -> None:
    robot = deployment_of(Options(behaviour="navigate"), "serial")
    assert robot.decision.behaviour == "navigate"
    assert robot.decision.settings == {"start": "explore", "max_linear_speed": 0.26}
    assert robot.perception.mapping == "slam"
    assert deployment_of(Options(), "serial").perception.mapping == "off"


def test_a_choice_of_no_test_is_refused() -> None:
    with pytest.raises(ConfigError, match="--skip leaves no test to run"):
        faults(only=("8", "decision-killed"), skip=("1", "driver-killed"))


async def test_what_cannot_run_is_skipped_and_says_why(tmp_path: Path) -> None:
    (result,) = await run_suite(choose(["12"]), Options(body="alpha"), tmp_path)
    assert result.verdict == "skipped"
    assert result.reason == "alpha has no serial line"


Run = Callable[[], dict[Figure, float]]
SHORT = Options()


async def result_of(
    runs: Sequence[tuple[Run, float]],
    monkeypatch: pytest.MonkeyPatch,
    repeat: int = 1,
    fault: FaultRow = FAULT,
    options: Options = SHORT,
) -> FaultResult:
    """Return the suite's result of these runs, each with its longest wait for a core [ms]."""
    left, waits = iter(run for run, _ in runs), iter(wait for _, wait in runs)

    async def test(_: Rig) -> dict[Figure, float]:
        return next(left)()

    def start(watch: RunQueueWatch) -> None:
        watch.longest_ms = next(waits)

    monkeypatch.setattr(RunQueueWatch, "start", start)
    (result,) = await run_suite([replace(fault, test=test)], options, Path(), repeat)
    return result


def well() -> dict[Figure, float]:
    return {BRAKES: 100.0, TRAVEL: 0.05}


def worse() -> dict[Figure, float]:
    return {BRAKES: 120.0, TRAVEL: 0.04}


def late() -> dict[Figure, float]:
    return {BRAKES: 140.0, TRAVEL: 0.05}


def badly() -> dict[Figure, float]:
    raise Failed("it drove on")


def verdicts(result: FaultResult) -> list[tuple[str, bool]]:
    """Of each try: its verdict, and whether it was disturbed."""
    return [(one.verdict, one.disturbed) for one in result.tries]


async def test_the_worst_of_n_runs_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    result = await result_of([(well, 0), (worse, 29.9), (well, 0)], monkeypatch, repeat=3)
    assert verdicts(result) == [("passed", False)] * 3
    assert result.worst == {"brakes after": 120.0, "travel": 0.05}


async def test_one_run_that_fails_fails_the_test_and_all_are_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = await result_of([(well, 0), (badly, 0), (well, 0)], monkeypatch, repeat=3)
    assert (result.verdict, result.reason) == ("FAILED", "it drove on")
    assert verdicts(result) == [("passed", False), ("FAILED", False), ("passed", False)]
    assert failed([result])


async def test_a_run_that_misses_its_limit_fails_and_shows_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = await result_of([(late, 0)], monkeypatch)
    assert (result.verdict, result.reason) == ("FAILED", "brakes after is 140 ms")
    assert result.worst == {"brakes after": 140.0, "travel": 0.05}


@pytest.mark.parametrize("first", [well, late, badly])
async def test_a_disturbed_run_does_not_count_whether_it_passed_or_failed(
    first: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = await result_of([(first, 30.0), (worse, 0)], monkeypatch)
    assert [one.disturbed for one in result.tries] == [True, False]
    assert (result.verdict, result.worst) == ("passed", {"brakes after": 120.0, "travel": 0.04})
    result = await result_of([(first, 30.0), (late, 0)], monkeypatch)
    assert result.verdict == "FAILED"


async def test_where_every_run_is_disturbed_all_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    result = await result_of([(well, 40.0), (late, 40.0), (well, 40.0)], monkeypatch)
    assert verdicts(result) == [("passed", True), ("FAILED", True), ("passed", True)]
    assert result.verdict == "FAILED"


async def test_a_fault_that_loads_the_machine_is_not_disturbed_by_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hogs = replace(FAULT, loads=True)
    result = await result_of([(late, 500.0)], monkeypatch, fault=hogs)
    assert (result.verdict, verdicts(result)) == ("FAILED", [("FAILED", False)])
    assert result.tries[0].waited_ms == 500.0


async def test_a_long_form_counts_in_any_case(monkeypatch: pytest.MonkeyPatch) -> None:
    result = await result_of([(late, 90.0)], monkeypatch, options=Options(long=True))
    assert (result.verdict, verdicts(result)) == ("FAILED", [("FAILED", False)])
    assert result.tries[0].waited_ms == 90.0


async def test_no_garbage_is_collected_while_a_fault_is_tried() -> None:
    collects = list[bool]()

    async def noted(_: Rig) -> dict[Figure, float]:
        collects.append(gc.isenabled())
        return well()

    await run_suite([replace(FAULT, test=noted)], Options(), Path())
    assert collects == [False]
    assert gc.isenabled()


async def test_a_suite_goes_on_where_its_file_ends(tmp_path: Path) -> None:
    path, options = tmp_path / "tries.jsonl", Options(body="alpha")
    file = RunsFile(path, options)
    assert file.read() == {}
    before = FaultRun(
        verdict="passed", measured={"brakes after": 80.0, "travel": 0.01}, waited_ms=3.0
    )
    file.append(FAULT, before)
    RunsFile(path, Options()).append(FAULT, FaultRun(verdict="FAILED", reason="another body"))
    assert file.read() == {1: [before]}
    row = replace(FAULT, test=_well)
    (result,) = await run_suite([row], options, tmp_path, 2, earlier=file.read())
    assert verdicts(result) == [("passed", False), ("passed", False)]
    path.write_text("{")
    with pytest.raises(ConfigError, match=r"cannot continue .*tries.jsonl"):
        file.read()


async def _well(_: Rig) -> dict[Figure, float]:
    return well()


async def test_the_longest_wait_of_one_thread_between_two_looks_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks = iter([{"1": 5_000_000, "2": 0}, {"1": 6_000_000, "2": 31_000_000, "3": 90_000_000}])
    monkeypatch.setattr(this_process, "waited_ns_by_thread", lambda process: next(looks))
    monkeypatch.setattr(this_process, "stolen_ns_by_core", dict)
    watch = RunQueueWatch(lambda: [7])
    watch.sample()
    watch.sample()
    assert watch.longest_ms == 31.0  # of the second; the third was not there before


async def test_what_holds_up_the_suite_itself_was_waited_for() -> None:
    watch = RunQueueWatch(list)
    watch.start()
    await asyncio.sleep(0)
    time.sleep(POLL_S + 0.05)  # noqa: ASYNC251  it is to hold up the loop
    await asyncio.sleep(0.01)
    watch.close()
    assert watch.longest_ms >= 50.0


async def test_a_core_that_the_host_gave_to_others_was_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks = iter([{"cpu0": 900_000_000, "cpu1": 0}, {"cpu0": 940_000_000, "cpu1": 10_000_000}])
    monkeypatch.setattr(this_process, "stolen_ns_by_core", lambda: next(looks))
    watch = RunQueueWatch(list)
    watch.sample()
    watch.sample()
    assert watch.longest_ms == 40.0


async def test_a_part_that_hangs_leaves_the_rest_of_its_process_running() -> None:
    network, hangs = LocalNetwork(), threading.Event()
    bus = HangingBus(WORLD, hangs, network.transport(), FakeClock(), "decision")
    speaker = Bus(network.transport(), FakeClock(), "perception")
    received: list[str] = []
    bus.latest(WORLD, lambda _: received.append("world"))
    bus.latest(INTENT, lambda _: received.append("intent"))
    for _ in range(2):
        speaker.publish(WORLD, WorldModel(scan_ok=True, obstacle_ahead=False))
        speaker.publish(INTENT, Intent(behaviour="avoid", reason="free"))
        await settle()
        hangs.set()
    assert received == ["world", "intent", "intent"]
