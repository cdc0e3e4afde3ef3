"""The grip of an arm is kept while its base drives."""

import asyncio
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot, make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.body import Joint
from gigabrain_schemas.tasks import MissionRequest
from gigabrain_schemas.topics import ARM_MODEL, BODY, MISSION, STATE, Topic
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.tasks.arm_steps import HeldThing, Solid
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskFile
from gigabrain_zenoh.manipulation.arm_planner import STILL
from tests.node.plane import ROOM, Plane, drawn

LEKIWI = load_robot("lekiwi")
assert LEKIWI.arm
HOME = LEKIWI.arm.home
GRIPPER = LEKIWI.joints[-1]
WIDTH = 0.8  # [rad], position at which the held thing stops the gripper
GRIP = WIDTH - STILL[1] * (GRIPPER.upper - GRIPPER.lower)


class Carrier(Plane):
    """A body with LeKiwi's arm, whose joints reach their targets at once."""

    def __init__(self, config: DecisionConfig | None = None) -> None:
        super().__init__(drawn(ROOM), config=config)
        self.width = WIDTH
        self.description = LEKIWI.description()
        self._model = make_driver("lekiwi", Run(folder=Path()))[1].arm_model()
        self.sent = {joint.name: at for joint, at in zip(LEKIWI.joints, HOME, strict=True)}
        self._send, self.bench.send = self.bench.send, self._with_joints  # type: ignore[method-assign]

    @property
    def lag(self) -> float:
        """Return the lag of the gripper behind its target, as a share of its range."""
        return (self.width - self.sent[GRIPPER.name]) / (GRIPPER.upper - GRIPPER.lower)

    def _with_joints(self, topic: Topic[Any], message: Any) -> None:
        if topic is STATE:
            self.sent |= {target.name: target.position for target in self.intent.joints}
            at = self.sent | {GRIPPER.name: max(self.width, self.sent[GRIPPER.name])}
            joints = tuple(Joint(name=name, position=place) for name, place in at.items())
            message = replace(message, joints=joints, joints_sent=tuple(self.sent.values()))
        self._send(topic, message)
        if topic is BODY:
            assert self._model
            self._send(ARM_MODEL, self._model)


@pytest.mark.parametrize("creeps", [-0.01, 0.01])
async def test_a_grip_follows_a_creeping_thing_while_the_base_drives(creeps: float) -> None:
    async with Carrier() as plane:
        mission = MissionRequest(mission="do: [{gripper: close}, {goto: [4.0, 0.8]}]")
        assert (await plane.ask(MISSION, mission)).ok
        await drive(plane, 0.3)
        assert STILL[0] < plane.lag < STILL[-1]
        plane.width += creeps
        assert not STILL[0] < plane.lag < STILL[-1]
        await drive(plane, 1.0)
        assert STILL[0] < plane.lag < STILL[-1]


@pytest.mark.parametrize("creeps", [-0.01, 0.01])
async def test_a_grip_is_adjusted_after_a_restart_of_decision(
    tmp_path: Path, creeps: float
) -> None:
    async with Carrier(DecisionConfig(behaviour="navigate", state_dir=str(tmp_path))) as plane:
        await restart(plane, tmp_path)
        assert (await plane.ask(MISSION, MissionRequest(mission="do: [{goto: [4.0, 0.8]}]"))).ok
        await drive(plane, 0.3)
        assert plane.sent[GRIPPER.name] == GRIP
        plane.width += creeps
        assert not STILL[0] < plane.lag < STILL[-1]
        await drive(plane, 1.0)
        assert STILL[0] < plane.lag < STILL[-1]


async def test_a_grip_by_gripper_close_survives_a_restart_of_decision(tmp_path: Path) -> None:
    async with Carrier(DecisionConfig(behaviour="navigate", state_dir=str(tmp_path))) as plane:
        mission = MissionRequest(mission="do: [{gripper: close}, {goto: [4.0, 0.8]}]")
        assert (await plane.ask(MISSION, mission)).ok
        await drive(plane, 0.3)
        await plane.restart()
        await drive(plane, 0.6)
        plane.width -= 0.01
        assert not STILL[0] < plane.lag < STILL[-1]
        await drive(plane, 1.3)
        assert STILL[0] < plane.lag < STILL[-1]


async def test_a_held_thing_is_remembered_while_the_arm_starts(tmp_path: Path) -> None:
    config = DecisionConfig(behaviour="navigate", state_dir=str(tmp_path))
    async with Carrier(config) as plane:
        await restart(plane, tmp_path)
        assert (await plane.ask(MISSION, MissionRequest(mission="do: [{posture: home}]"))).ok
        await plane.go(0.5)
        await plane.bench.restart()
        saved, _ = TaskFile(str(tmp_path)).read()
        assert saved.jobs
        assert saved.held


async def restart(plane: Carrier, folder: Path) -> None:
    """Start decision with a task file in which the gripper holds a can."""
    plane.sent[GRIPPER.name] = GRIP
    can = Solid(cylinder=(0.03, 0.1), at=(0.0, 0.0, 0.0))
    axes = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    held = HeldThing(name="can", solid=can, axes=axes, grip=GRIP - 0.01, opening=1.5)
    TaskFile(str(folder)).write([Saved(boot=plane.boot, held=held)])
    await plane.restart()


async def drive(plane: Carrier, way: float) -> None:
    """Let time pass until the base has driven `way` metres in all."""
    while plane.travelled < way:
        await plane.go(0.1)
        await asyncio.sleep(0.01)  # a worker thread loads the arm's kernels and plans
    assert plane.status.current
