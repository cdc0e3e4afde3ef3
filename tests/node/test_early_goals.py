"""Goals sent while the robot starts: they are accepted at once and reached afterwards."""

import asyncio
import functools
import subprocess
import sys

import pytest

from gigabrain_schemas.tasks import GoalReply, GoalRequest, MissionRequest, TaskStatus
from gigabrain_schemas.topics import GOAL, INTENT, MISSION, TASK
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.cli.task import progress
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.decision.behaviours import WaitReason
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.kernels import precompile
from gigabrain_zenoh.kernels.precompile import ensure_compiled
from gigabrain_zenoh.testing.in_memory import NodeBench
from tests.node.plane import ROOM, Plane, drawn

CELLS = drawn(ROOM)
NAVIGATE = DecisionConfig(behaviour="navigate")


async def test_a_goal_is_accepted_while_decision_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    may_compile = asyncio.Event()

    async def compiled_later(warm_up: str) -> None:
        await may_compile.wait()
        await ensure_compiled(warm_up)

    monkeypatch.setattr(precompile, "ensure_compiled", compiled_later)
    statuses: list[TaskStatus] = []
    async with NodeBench(functools.partial(decision.run, NAVIGATE)) as bench:
        operator = Bus(bench.network.transport(), bench.clock, "operator")
        operator.subscribe(TASK, lambda _key, status: statuses.append(status))
        replies = await operator.ask(GOAL, GoalRequest(x=4.0, y=0.8, source="ann"))
        assert replies == [GoalReply(ok=True, text=f"goal-1: accepted; {WaitReason.STARTING}",
                                     goal="goal-1")]  # fmt: skip
        for _ in range(3):
            await bench.clock.advance(200_000_000)
        assert len(statuses) >= 3
        assert (
            progress("goal-1", statuses[-1]) == f"goal-1: accepted, waiting: {WaitReason.STARTING}"
        )
        assert not bench.sent(INTENT)
        may_compile.set()
        await bench.ready()
        await operator.close()


async def test_it_drives_to_a_goal_that_was_accepted_before_the_first_map() -> None:
    async with Plane(CELLS) as plane:
        reply = await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        assert reply.text == f"goal-1: accepted; {WaitReason.PERCEPTION_STARTING}"
        assert (await plane.ask_at_once(MISSION, MissionRequest(mission="do: [{goto: [1, 2]}]"))).ok
        await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.until("succeeded", seconds=60)


async def test_a_goal_in_a_wall_accepted_before_the_first_map_fails_with_the_reason() -> None:
    async with Plane(CELLS) as plane:
        assert (await plane.ask_at_once(GOAL, GoalRequest(x=2.6, y=0.5))).ok
        await plane.until("failed", seconds=2)
        reason = plane.status.done[0].reason
        assert reason.startswith("the goal is inside an obstacle; nearest reachable point is ")
        assert plane.travelled == 0.0


async def test_a_goal_waits_for_the_first_localization() -> None:
    async with Plane(CELLS) as plane:
        plane.localized = False
        await plane.go(0.3)
        reply = await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        assert reply.text == f"goal-1: accepted; {WaitReason.NOT_LOCALIZED}"
        await plane.go(1.0)
        assert plane.travelled == 0.0
        assert progress("goal-1", plane.status) == (
            f"goal-1: going to (4.00, 0.80), 0 %, waiting: {WaitReason.NOT_LOCALIZED}"
        )
        plane.localized = True
        await plane.until("succeeded", seconds=60)


async def test_the_error_for_a_missing_package_has_the_command_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("gigabrain_zenoh.kernels.jit", "numba"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=r"pip install 'gigabrain-zenoh\[nav\]'"):
        await ensure_compiled("gigabrain_zenoh.kernels.jit:kernel")


IMPORT_GOAL_SERVER = """
import sys
import gigabrain_zenoh.decision.goal_server
print(*(name for name in ("numba", "gtsam", "scipy") if name in sys.modules))
"""


def test_the_goal_server_imports_no_heavy_package() -> None:
    done = subprocess.run(
        (sys.executable, "-c", IMPORT_GOAL_SERVER), capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr
