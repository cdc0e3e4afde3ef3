"""At the first start of an installation, a robot drives while its kernels compile."""

import asyncio

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.requests import MapRequest
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import GOAL, MAP_SAVE, POSE, WORLD
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import InputLogger
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.decision.behaviours import WaitReason
from gigabrain_zenoh.decision.drive_kernels import CAR_KERNELS, DRIVE_KERNELS, DriveKernels
from gigabrain_zenoh.decision.goal_server import COMPILING, FIRST_MAP_TICKS
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.kernels import precompile
from gigabrain_zenoh.plugins import find
from gigabrain_zenoh.testing import in_memory
from gigabrain_zenoh.testing.samples import WAFFLE
from tests.node.mapping_robot import Robot
from tests.node.plane import ROOM, Plane, drawn

CELLS = drawn(ROOM)
CAR = replace(WAFFLE, drive_type="ackermann", min_turning_radius=0.4)
EXPLORES = DecisionConfig(behaviour="navigate", settings={"start": "explore"})


class Compiler:
    """A fake of the child process that compiles."""

    def __init__(self) -> None:
        self.may_end, self.began = asyncio.Event(), 0
        self.kills = 0  # how many of the next children get killed
        self.compiled: list[str] = []
        self._loaded, self._loop = asyncio.Event(), asyncio.get_running_loop()

    async def compile(self, warm_up: str, *, step_aside: bool = False) -> int:
        self.began += 1
        await self.may_end.wait()
        if self.kills:
            self.kills -= 1
            return -9
        self.compiled.append(warm_up)
        return 0

    def load(self, warm_up: str) -> None:
        """Load the real kernels, in a worker thread."""
        find(warm_up)()
        self._loop.call_soon_threadsafe(self._loaded.set)

    async def end(self) -> None:
        """End the child, and wait until the kernels are loaded."""
        self.may_end.set()
        await self._loaded.wait()
        await asyncio.sleep(0.01)


@pytest.fixture
async def compiler(monkeypatch: pytest.MonkeyPatch) -> Compiler:
    compiler = Compiler()
    monkeypatch.setattr(precompile, "_is_missing", lambda warm_up: warm_up not in compiler.compiled)
    monkeypatch.setattr(precompile, "compile_in_child", compiler.compile)
    monkeypatch.setattr(precompile, "_call", compiler.load)
    monkeypatch.setattr(in_memory, "PatientJournal", InputLogger)
    return compiler


async def test_it_roams_while_kernels_compile_and_then_explores(compiler: Compiler) -> None:
    async with Plane(CELLS, config=EXPLORES) as plane:
        plane.maps = False
        await plane.go(20.0)
        assert compiler.began == 1
        assert plane.intent.behaviour == "avoid"
        assert COMPILING in plane.intent.reason
        assert plane.travelled > 1.5
        assert plane.closest > 0.2
        assert plane.status.current is None
        await compiler.end()
        await plane.go(1.0)
        assert plane.intent.behaviour == "avoid"  # it needs a map from perception too
        plane.maps = True
        await plane.go(3.0)
        assert plane.intent.behaviour == "navigate"
        assert plane.status.current
        assert plane.status.current.label == "roaming"


async def test_a_new_task_ends_the_roaming_and_waits_for_the_kernels(compiler: Compiler) -> None:
    async with Plane(CELLS, config=EXPLORES) as plane:
        await plane.go(2.0)
        reply = await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        assert reply.text == f"goal-1: accepted; {WaitReason.STARTING}"
        await plane.go(1.0)
        assert plane.intent.twist in (None, Velocity())
        assert plane.status.current
        assert WaitReason.STARTING in plane.status.current.reason
        await compiler.end()
        await plane.until("succeeded", seconds=60)


async def test_a_robot_without_a_start_task_stands_while_kernels_compile(
    compiler: Compiler,
) -> None:
    async with Plane(CELLS) as plane:
        await plane.go(5.0)
        assert plane.travelled == 0.0
        await compiler.end()
        await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.until("succeeded", seconds=60)


async def test_roaming_ends_if_no_map_arrives(compiler: Compiler) -> None:
    async with Plane(CELLS, config=EXPLORES) as plane:
        plane.maps = False
        await plane.go(0.2)
        await compiler.end()
        await plane.go(FIRST_MAP_TICKS / 50 + 0.5)
        assert WaitReason.NO_LOCALIZATION in plane.intent.reason


async def test_a_roaming_robot_obeys_the_speed_limit(compiler: Compiler) -> None:
    slow = {"start": "explore", "max_linear_speed": 0.05}
    config = DecisionConfig(behaviour="navigate", settings=slow)
    async with Plane(CELLS, config=config) as plane:
        await plane.go(4.0)
        assert 0.1 < plane.travelled < 0.21


async def test_in_lock_step_all_kernels_are_compiled_first(compiler: Compiler) -> None:
    compiler.may_end.set()
    config = DecisionConfig(behaviour="navigate", compile_first=True)
    async with Plane(CELLS, config=config) as plane:
        assert compiler.compiled
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.until("succeeded", seconds=60)


async def test_perception_publishes_worlds_at_once_and_maps_once_compiled(
    compiler: Compiler,
) -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(scans=3)
        assert len(robot.sent(WORLD)) == 3
        asks = Bus(robot.network.transport(), robot.clock, "test")
        assert await asks.ask(MAP_SAVE, MapRequest(name="too_early"), timeout_s=1.0) == []
        await asks.close()
        await compiler.end()
        robot.drive(scans=5)
        assert len(robot.sent(POSE)) == 5


async def test_perception_with_a_saved_map_waits_for_its_kernels(compiler: Compiler) -> None:
    compiler.may_end.set()
    config = PerceptionConfig(mapping="localize", map="/nowhere/house.yaml")
    with pytest.raises(ConfigError, match="nowhere"):
        async with Robot(config):
            raise AssertionError("it is ready")
    assert compiler.compiled


async def test_a_package_missing_for_the_kernels_is_named(
    compiler: Compiler, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing(_: str) -> None:
        raise ModuleNotFoundError("no", name="gtsam")

    monkeypatch.setattr(precompile, "_call", nothing)
    compiler.may_end.set()
    kernels = precompile.Kernels("some:kernels", InputLogger().in_time)
    await kernels.load(wait=False)
    with pytest.raises(ConfigError, match="gtsam"):
        await kernels.finish()
    with pytest.raises(ConfigError, match="gtsam"):
        assert kernels.loaded


async def test_kernels_for_cars_are_compiled_when_the_body_is_known(compiler: Compiler) -> None:
    compiler.may_end.set()
    async with Plane(CELLS, config=EXPLORES) as plane:
        plane.description = CAR
        await compiler.end()
        assert compiler.compiled == [DRIVE_KERNELS]
        await plane.go(1.0)
        assert compiler.compiled == [DRIVE_KERNELS, CAR_KERNELS]


async def test_in_lock_step_kernels_for_cars_are_compiled_first_too(compiler: Compiler) -> None:
    compiler.may_end.set()
    kernels = DriveKernels(InputLogger().in_time)
    assert await kernels.load(wait=True)
    assert kernels.loaded(CAR)


@pytest.mark.parametrize(("kills", "logged"), [(1, ["compiled"]), (2, [])])
async def test_a_compiling_child_that_is_killed_is_restarted_once(
    compiler: Compiler,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    kills: int,
    logged: list[str],
) -> None:
    monkeypatch.setattr(precompile, "_call", lambda warm_up: None)
    compiler.kills = kills
    compiler.may_end.set()
    kernels = precompile.Kernels("some:kernels", lambda job, _budget: job.done())
    with caplog.at_level("INFO", precompile.__name__):
        await kernels.load(wait=False)
        await kernels.finish()
    assert kernels.loaded
    assert compiler.began == 2
    assert caplog.messages.count("compiling was ended by signal 9") == kills
    assert [text for text in caplog.messages if text == "compiled"] == logged
