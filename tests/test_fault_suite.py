"""The fault suite: its frame, and every fault once, in its short form, on real processes."""

import asyncio
import math
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.topics import INTENT, WORLD
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.errors import UnknownName
from gigabrain_zenoh.faults import suite
from gigabrain_zenoh.faults.fault import Failed, Fault, Limit, Result, Skipped, judge
from gigabrain_zenoh.faults.hanging import HangingBus
from gigabrain_zenoh.faults.rig import Options, Rig, deployment_of
from gigabrain_zenoh.faults.suite import failed, run_suite
from gigabrain_zenoh.faults.table import FAULTS, choose
from gigabrain_zenoh.process import find
from gigabrain_zenoh.transport import LocalNetwork
from tests.bus_rig import settle
from tests.turns import TURNS

STALL_S = 0.2
FAULT = Fault(1, "decision-killed", "process", "", "zero after <= 120 ms, travel <= 0.1 m")


def test_the_table_has_all_44_faults_and_two_recoveries() -> None:
    assert [fault.number for fault in FAULTS] == list(range(1, 47))
    assert len({fault.name for fault in FAULTS}) == 46


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
    assert [find(fault.path).__name__.replace("_", "-") for fault in FAULTS] == [
        fault.name for fault in FAULTS
    ]


def test_a_body_without_the_line_in_question_is_skipped() -> None:
    assert deployment_of(Options(), "serial").body == "mycustombot"
    assert deployment_of(Options(body="alpha"), "sim").body == "alpha"
    with pytest.raises(Skipped, match="alpha has no serial line"):
        deployment_of(Options(body="alpha"), "serial")


def test_deaths_of_the_driver_are_judged_on_whatever_line_a_body_has() -> None:
    assert [fault.number for fault in FAULTS if fault.stage == "line"] == [7, 8, 11]
    assert deployment_of(Options(), "line") == deployment_of(Options(), "serial")
    assert deployment_of(Options(body="alpha"), "line").link == "emulated"
    with pytest.raises(Skipped, match="mock has no line"):
        deployment_of(Options(body="mock"), "line")


def test_the_same_robots_can_be_had_navigating() -> None:
    robot = deployment_of(Options(behaviour="navigate"), "serial")
    assert (robot.decision.behaviour, robot.decision.begin) == ("navigate", "roam")
    assert (robot.perception.mapping, robot.decision.speed_limit) == ("slam", 0.26)
    assert deployment_of(Options(), "serial").perception.mapping == "off"


async def test_what_cannot_run_is_skipped_and_says_why(tmp_path: Path) -> None:
    (result,) = await run_suite(choose(["12"]), Options(body="alpha"), tmp_path)
    assert result.verdict == "skipped"
    assert result.reason == "alpha has no serial line"


async def results_of(
    runs: Sequence[Callable[[], dict[str, float]]],
    repeat: int,
    monkeypatch: pytest.MonkeyPatch,
    stall_s: float = math.inf,
) -> Result:
    """What the suite makes of a test whose runs do these things, one after the other."""
    monkeypatch.setattr(suite, "STALL_S", stall_s)
    left = iter(runs)

    async def test(_: Rig) -> dict[str, float]:
        await asyncio.sleep(0)
        return next(left)()

    monkeypatch.setattr(suite, "find", lambda path: test)
    (result,) = await run_suite([FAULT], Options(), Path(), repeat)
    return result


def well() -> dict[str, float]:
    return {"zero after": 100.0, "travel": 0.05}


def badly() -> dict[str, float]:
    raise Failed("it drove on")


def slowly() -> dict[str, float]:
    time.sleep(2 * STALL_S)
    return {"zero after": 300.0, "travel": 0.05}


def stalled() -> dict[str, float]:
    time.sleep(2 * STALL_S)  # as a machine does that stands still
    raise Failed("it drove on")


async def test_the_worst_of_n_runs_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    worse = {"zero after": 120.0, "travel": 0.04}
    result = await results_of([well, lambda: worse, well], 3, monkeypatch)
    assert (result.verdict, result.runs) == ("passed", 3)
    assert result.worst == {"zero after": 120.0, "travel": 0.05}


async def test_one_run_that_fails_fails_the_test(monkeypatch: pytest.MonkeyPatch) -> None:
    result = await results_of([well, badly], 3, monkeypatch)
    assert (result.verdict, result.reason, result.stalls) == ("FAILED", "it drove on", 0)
    assert failed([result])


@pytest.mark.parametrize("first", [stalled, slowly])
async def test_a_run_that_fails_while_the_machine_stands_still_is_run_again_and_told(
    first: Callable[[], dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    result = await results_of([first, well], 1, monkeypatch, STALL_S)
    assert (result.verdict, result.stalls, result.runs) == ("passed", 1, 1)
    assert result.worst == {"zero after": 100.0, "travel": 0.05}


async def test_a_run_that_misses_its_limit_fails_and_shows_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = await results_of([lambda: {"zero after": 140.0, "travel": 0.05}], 2, monkeypatch)
    assert (result.verdict, result.reason) == ("FAILED", "zero after is 140 ms")
    assert result.worst == {"zero after": 140.0, "travel": 0.05}


async def test_a_machine_that_always_stands_still_passes_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = await results_of([stalled, stalled, stalled], 1, monkeypatch, STALL_S)
    assert (result.verdict, result.stalls) == ("FAILED", 2)
    assert result.stall_ms >= 200


async def test_a_part_that_hangs_leaves_the_rest_of_its_process_running() -> None:
    network, hangs = LocalNetwork(), threading.Event()
    bus = HangingBus(WORLD, hangs, network.transport(), FakeClock(), "decision")
    speaker = Bus(network.transport(), FakeClock(), "perception")
    heard: list[str] = []
    bus.latest(WORLD, lambda _: heard.append("world"))
    bus.latest(INTENT, lambda _: heard.append("intent"))
    for _ in range(2):
        speaker.publish(WORLD, WorldModel(scan_ok=True, obstacle_ahead=False))
        speaker.publish(INTENT, Intent(behaviour="avoid", reason="free"))
        await settle()
        hangs.set()
    assert heard == ["world", "intent", "intent"]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Result]:
    """What came of each fault; they share robots, so they run in one go.

    Those that failed while the machine stood still are run again while no other test runs.
    """

    def run(faults: Sequence[Fault], **turns: Callable[..., None]) -> dict[int, Result]:
        done = asyncio.run(run_suite(faults, Options(), tmp_path_factory.mktemp("faults"), **turns))
        return {result.number: result for result in done}

    results = run(FAULTS, begun=lambda _: TURNS.beside(), ended=lambda _: TURNS.leave())
    held_up = [fault for fault in FAULTS if disturbed(results[fault.number])]
    TURNS.alone()
    return results | run(held_up)


def disturbed(result: Result) -> bool:
    """Whether a failure says nothing of the robot."""
    return result.verdict == "FAILED" and result.stall_ms >= suite.STALL_S * 1e3


@pytest.mark.once
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_robot_stops_whatever_breaks(fault: Fault, results: dict[int, Result]) -> None:
    result = results[fault.number]
    if result.verdict == "skipped":
        pytest.skip(result.reason)
    assert result.verdict == "passed", f"{result.reason}; worst of all runs: {result.worst}"
