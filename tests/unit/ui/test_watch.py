"""RunMonitor counts the way, repeats lost queries, and notices a brain that is held up by load."""

import asyncio

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Cause, Pose, Velocity
from gigabrain_schemas.body import GateMode, GateStatus, RobotState
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import DescribeRequest, Description
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import DESCRIBE, INTENT, SAFETY, STATE
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.ui.live_view import _activity
from gigabrain_zenoh.ui.run_report import RunMonitor


async def answer(_: DescribeRequest) -> Description:
    return Description(process="driver", pid=7, host="robot", version="1")


async def test_a_process_that_returns_in_time_is_described() -> None:
    net = Net()
    asking = asyncio.ensure_future(RunMonitor(net.one).describe("driver", 20.0))
    await asyncio.sleep(0.15)
    net.two.serve(DESCRIBE, answer, name="driver")
    told = await asking
    assert told
    assert told.pid == 7


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
    watch, said = RunMonitor(net.one), Cause(code=cause, text="why")
    gate = GateStatus(mode=mode, causes=(said,), enables=1)
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


async def test_each_look_adds_the_way_since_the_last_and_counts_turns_that_begin() -> None:
    net = Net()
    watch = RunMonitor(net.one)
    watch.look()  # nothing has come
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
