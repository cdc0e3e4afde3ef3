"""Progress is what a process does with its input; silence counts while the supervisor runs."""

import functools
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.topics import WORLD
from gigabrain_zenoh import codec
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.decision.node import InputSource
from gigabrain_zenoh.host.threads import ScheduledWorker
from gigabrain_zenoh.qa.faults.broken_process import HANGING_TOPICS, HangingBus
from gigabrain_zenoh.runtime.child import Child
from gigabrain_zenoh.runtime.heartbeat import LOOK_S, Progress, Silence
from gigabrain_zenoh.runtime.managed_process import (
    Backoff,
    ManagedProcess,
    ProcessSpec,
    Shared,
)
from gigabrain_zenoh.testing.in_memory import BRAIN, RobotInMemory

SECOND_TICKS = 50


def judged(*looks: tuple[tuple[object, ...], object]) -> list[bool]:
    """Return whether each pair of `came` and `done` is progress, from the second on."""
    came, done = iter([look[0] for look in looks]), iter([look[1] for look in looks])
    progress = Progress(came.__next__, done.__next__)
    return [progress() for _ in looks[1:]]


def test_input_with_which_nothing_is_done_is_no_progress() -> None:
    assert judged(((1,), 0), ((2,), 0), ((3,), 0), ((4,), 1)) == [False, False, True]


def test_who_gets_no_input_is_well() -> None:
    assert judged(((1,), 0), ((1,), 0), ((1,), 0)) == [True, True]


def test_who_lacks_one_of_its_inputs_is_well() -> None:
    assert judged(((1, 1), 0), ((1, 2), 0), ((2, 2), 0), ((3, 3), 0)) == [True, True, False]


def test_who_cannot_work_yet_is_well() -> None:
    assert judged(((), 0), ((), 0), ((1,), 0), ((2,), 0)) == [True, True, False]


def looks_until_stuck(silence: Silence, passed_s: float) -> int:
    return next(count for count in range(1, 1000) if silence.add(passed_s))


def test_five_seconds_without_a_beat_are_too_long() -> None:
    silence = Silence()
    assert looks_until_stuck(silence, LOOK_S) == 20
    silence.end()
    assert not silence.add(LOOK_S)


def test_time_in_which_the_supervisor_stood_still_does_not_count() -> None:
    silence = Silence()
    assert not any(silence.add(3600.0) for _ in range(19))
    assert silence.add(3600.0)


class Ended(Child):
    """A child that notes its signals, and runs nothing."""

    def __init__(self) -> None:
        self.signals: list[int] = []

    def send_signal(self, number: int) -> None:
        self.signals.append(number)


def process_of(said: list[str], *, beats: bool = True, keep_stuck: bool = False) -> ManagedProcess:
    """A process that has just become ready."""

    def note(_name: str, record: Mapping[str, Any]) -> None:
        said.append(str(record.get("text", record["event"])))

    shared = Shared(note, Backoff(), keep_stuck)
    process = ManagedProcess(ProcessSpec("decision", (), beats=beats), shared)
    process.child, process.status.state = Ended(), "ready"
    return process


def look(process: ManagedProcess, times: int) -> list[int]:
    """Look so often; the signals that the process has got so far."""
    for _ in range(times):
        process.check_progress(LOOK_S)
    assert isinstance(process.child, Ended)
    return process.child.signals


async def test_a_process_without_progress_for_5_s_is_killed_once_and_reported() -> None:
    said: list[str] = []
    process = process_of(said)
    assert look(process, 19) == []
    assert not process.stuck
    assert look(process, 40) == [9]
    assert process.stuck
    assert said == ["decision has made no progress for 5 s and is killed"]


async def test_a_process_that_beats_is_never_killed() -> None:
    process = process_of([])
    for _ in range(100):
        assert look(process, 19) == []
        process._handle_record({"event": "progress"})


@pytest.mark.parametrize("state", ["starting", "backing off", "given up", "stopped"])
async def test_only_what_is_ready_can_be_stuck(state: Any) -> None:
    process = process_of([])
    process.status.state = state
    assert look(process, 1000) == []


async def test_a_stop_has_its_own_patience() -> None:
    process = process_of([])
    process._shared.halt.set()
    assert look(process, 1000) == []


async def test_a_process_that_never_beats_is_left_alone() -> None:
    assert look(process_of([], beats=False), 1000) == []


async def test_a_debugger_has_all_the_time_it_wants() -> None:
    said: list[str] = []
    process = process_of(said, keep_stuck=True)
    assert look(process, 1000) == []
    assert process.stuck
    assert said == ["decision has made no progress for 5 s and is left alone"]
    process._handle_record({"event": "progress"})
    assert not process.stuck


async def beats(robot: RobotInMemory, name: str, seconds: int) -> list[bool]:
    """In which seconds a process of the robot makes progress."""
    made = []
    for _ in range(seconds):
        await robot.go(SECOND_TICKS)
        made.append(robot.bus(name).progress())
    return made


@pytest.mark.long
async def test_a_robot_that_drives_makes_progress_in_every_second(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(SECOND_TICKS)
        for name in (*BRAIN, "driver"):
            robot.bus(name).progress()
            assert await beats(robot, name, 3) == [True] * 3, name


@pytest.mark.long
@pytest.mark.parametrize("name", BRAIN)
async def test_who_hears_nothing_any_more_is_well(name: str, tmp_path: Path) -> None:
    """Its upstream is dead, or the link is."""
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(2 * SECOND_TICKS)
        robot.freeze(name)
        await beats(robot, name, 1)
        assert await beats(robot, name, 6) == [True] * 6


@pytest.mark.long
@pytest.mark.parametrize("name", ["perception", "decision", "control", "safety"])
async def test_who_is_not_reached_by_its_own_input_makes_no_progress(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages come and are decoded; the part that should handle them never does."""
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(SECOND_TICKS)
        await robot.kill(name)
        hangs = threading.Event()
        robot.start(name, functools.partial(HangingBus, HANGING_TOPICS[name], hangs))
        assert (await beats(robot, name, 3))[1:] == [True] * 2
        hangs.set()
        assert (await beats(robot, name, 4))[1:] == [False] * 3


async def test_a_plan_that_never_ends_is_no_progress(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is made in a thread; the loop goes on and repeats the old way."""
    ends, overdue = threading.Event(), []
    beside = ScheduledWorker(0.0)
    beside.start(lambda: ends.wait(20.0) and list, 2)  # type: ignore[arg-type,return-value]

    class Hanging(InputSource):
        @property
        def hung(self) -> bool:  # type: ignore[override]
            return beside.overdue > 200

    monkeypatch.setattr(decision, "input_source", lambda _config, _bus: Hanging())
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(SECOND_TICKS)
        robot.bus("decision").progress()
        for _ in range(210):
            beside.at_scan()
            overdue.append(beside.overdue)
        assert (overdue[:4], overdue[-1]) == ([0, 0, 1, 2], 208)
        assert (await beats(robot, "decision", 4))[1:] == [False] * 3
        ends.set()
        beside.finish()
        assert beside.overdue == 0
        assert await beats(robot, "decision", 3) == [True] * 3
    beside.close()


def world_of(robot: RobotInMemory, late_ticks: int) -> WorldModel:
    """A world that took so long to come."""
    assert robot.state
    then = robot.state.tick - late_ticks
    return WorldModel(
        scan_ok=True, obstacle_ahead=False, boot=robot.state.boot, tick=then, basis=then
    )


@pytest.mark.long
async def test_old_worlds_are_looked_at_and_refused_which_is_progress(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(SECOND_TICKS)
        await robot.kill("perception")
        await robot.go(SECOND_TICKS)
        made = []
        for _ in range(6):
            for _ in range(10):
                await robot.go(5)
                robot.network.deliver(WORLD.key, codec.encode(world_of(robot, 40)))
            made.append(robot.bus("decision").progress())
        assert made == [True] * 6
        assert robot.mode != "enabled"


async def test_a_driver_whose_body_stands_still_makes_no_progress(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(SECOND_TICKS)
        bus = robot.bus("driver")
        robot.clock.stall(1_000_000_000)  # time goes on, and no tick
        assert bus.progress()
        robot.clock.stall(1_000_000_000)
        assert not bus.progress()
