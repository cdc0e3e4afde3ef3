"""RunMonitor measures the distance, repeats lost queries, and detects a brain delayed by load."""

import asyncio
import io
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace
from rich.console import Console, RenderableType

from gigabrain_schemas.base import Cause, Pose, Velocity
from gigabrain_schemas.body import GateMode, GateStatus, RobotState
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import DescribeRequest, Description
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import DESCRIBE, INTENT, SAFETY, STATE
from gigabrain_zenoh.diagnostics.discovery import plain_table
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.ui.live_view import HeadlessView, LiveView, _activity
from gigabrain_zenoh.ui.page.node import INSTALL
from gigabrain_zenoh.ui.run_report import RunMonitor


async def answer(_: DescribeRequest) -> Description:
    return Description(process="driver", pid=7, host="robot", version="1")


async def test_a_process_that_starts_in_time_is_described() -> None:
    net = Net()
    asking = asyncio.ensure_future(RunMonitor(net.one).describe("driver", 20.0))
    await asyncio.sleep(0.15)
    net.two.serve(DESCRIBE, answer, name="driver")
    description = await asking
    assert description
    assert description.pid == 7


async def test_a_process_that_never_answers_has_no_description() -> None:
    assert await RunMonitor(Net().one).describe("driver", 0.15) is None


@pytest.mark.parametrize(
    ("mode", "cause", "warning", "held"),
    [
        ("idle", "stale", "cpu_busy", True),
        ("stopping", "decision_silent", "cpu_busy", True),
        ("enabled", "stale", "cpu_busy", False),
        ("latched", "estop", "cpu_busy", False),
        ("idle", "obstacle", "cpu_busy", False),
        ("idle", "stale", "disk_low", False),
    ],
)
async def test_a_brain_that_is_late_on_a_busy_machine_is_held_by_its_load(
    mode: GateMode, cause: str, warning: str, held: bool
) -> None:
    net = Net()
    watch = RunMonitor(net.one)
    gate = GateStatus(mode=mode, causes=(Cause(code=cause, text="why"),), enables=1)
    pose = Pose(x=0.0, y=0.0, yaw=0.0)
    net.two.publish(STATE, RobotState(robot_type="any", pose=pose, velocity=Velocity(), gate=gate))
    busy = Cause(code=warning, text="why")
    net.two.publish(SAFETY, SafetyState(verdict="stop", warnings=(busy,)))
    watch.look()
    assert watch.held_by_load is held


@pytest.mark.parametrize(
    ("process", "activity"),
    [("safety", "ok"), ("emulator", "emulates the body's line"), ("other", "")],
)
async def test_only_the_row_of_safety_shows_its_verdict(process: str, activity: str) -> None:
    net = Net()
    watch = RunMonitor(net.one)
    net.two.publish(STATE, example(RobotState))
    net.two.publish(SAFETY, SafetyState(verdict="ok"))
    watch.look()
    assert _activity(process, watch) == activity


async def test_each_look_adds_the_distance_since_the_last_and_counts_new_turns() -> None:
    net = Net()
    watch = RunMonitor(net.one)
    watch.look()  # before any message
    state = example(RobotState)
    for x, turn in ((0.0, 0.0), (0.3, 0.5), (0.7, 0.5), (0.7, 0.0), (0.7, 0.5)):
        net.two.publish(STATE, replace(state, pose=Pose(x=x, y=0.0, yaw=0.0)))
        twist = Velocity(linear_x=0.0, angular_z=turn)
        net.two.publish(INTENT, Intent(twist=twist, behaviour="any", reason="why"))
        watch.look()
    assert watch.distance_m == pytest.approx(0.7)
    assert watch.turns == 2
    assert watch.start_times.state_s is not None
    assert watch.start_times.motion_s is not None
    assert watch.start_times.metre_s is None


async def test_its_time_continues_when_the_driver_restarts() -> None:
    net = Net()
    watch = RunMonitor(net.one)
    for boot, tick, seconds in ((1, 100, 2.0), (1, 150, 3.0), (2, 1, 3.02), (2, 50, 4.0)):
        net.one.time.boot, net.one.time.tick = boot, tick
        assert watch.seconds == pytest.approx(seconds)
        watch.look()
        assert watch.seconds == pytest.approx(seconds)


NASTY = "avoid [left], [/], \x1b[2J"  # markup of rich, and a control sequence of the terminal
SHOWN = r"avoid [left], [/], \x1b[2J"


def text_of(shown: RenderableType) -> str:
    console = Console(width=200, force_terminal=True, color_system=None, file=io.StringIO())
    with console.capture() as capture:
        console.print(shown)
    return capture.get()


def test_a_table_escapes_markup_and_control_characters() -> None:
    assert SHOWN in text_of(plain_table(("process",), [(NASTY,)], left=("process",)))


async def test_the_view_of_a_demo_escapes_markup_and_control_characters(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    net = Net()
    watch = RunMonitor(net.one)
    gate = GateStatus(mode="enabled", commander="control")
    pose = Pose(x=0.0, y=0.0, yaw=0.0)
    net.two.publish(STATE, RobotState(robot_type="any", pose=pose, velocity=Velocity(), gate=gate))
    net.two.publish(INTENT, Intent(twist=Velocity(), behaviour="own", reason=NASTY))
    supervisor: Any = SimpleNamespace(
        statuses={"decision": SimpleNamespace(state="ready", restarts=0, pid=7)}
    )
    page = text_of(LiveView(watch, supervisor, "demo", (), None)._page())
    assert page.count(SHOWN) == 2  # as headline, and beside decision
    written: list[str] = []
    monkeypatch.setattr("gigabrain_zenoh.ui.live_view.writer", lambda _: written.append)
    monkeypatch.setattr("gigabrain_zenoh.ui.live_view.LINE_INTERVAL_S", 0.0)
    with HeadlessView(watch, None) as headless:
        headless.show()
    assert SHOWN in "".join(written)


async def test_the_view_of_a_demo_without_the_page_says_how_to_install_it() -> None:
    supervisor: Any = SimpleNamespace(statuses={})
    view = LiveView(RunMonitor(Net().one), supervisor, "[red] in a world", (), None, page=INSTALL)
    shown = text_of(view._page())
    assert "pip install 'gigabrain-zenoh[page]' · Ctrl-C ends it" in shown
    assert "[red] in a world" in shown
