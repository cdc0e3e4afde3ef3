"""A base that drives keeps the grip of its arm."""

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
from gigabrain_zenoh.manipulation.arm_planner import STILL
from tests.node.plane import ROOM, Plane, drawn

LEKIWI = load_robot("lekiwi")
assert LEKIWI.arm
HOME = LEKIWI.arm.home
GRIPPER = LEKIWI.joints[-1]


class Carrier(Plane):
    """A body with LeKiwi's arm, whose joints are at once where they are sent."""

    def __init__(self) -> None:
        super().__init__(drawn(ROOM))
        self.width = 0.8  # [rad], where a thing stops the gripper
        self.description = LEKIWI.description()
        self._model = make_driver("lekiwi", Run(folder=Path()))[1].arm_model()
        self.sent = {joint.name: at for joint, at in zip(LEKIWI.joints, HOME, strict=True)}
        self._send, self.bench.send = self.bench.send, self._with_joints  # type: ignore[method-assign]

    @property
    def lag(self) -> float:
        """The distance of the gripper from where it was sent, as a share of its range."""
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
async def test_a_grip_follows_what_creeps_while_the_base_drives(creeps: float) -> None:
    async with Carrier() as plane:
        mission = MissionRequest(mission="do: [{gripper: close}, {goto: [4.0, 0.8]}]")
        assert (await plane.ask(MISSION, mission)).ok
        await drive(plane, 0.3)
        assert STILL[0] < plane.lag < STILL[-1]
        plane.width += creeps
        assert not STILL[0] < plane.lag < STILL[-1]
        await drive(plane, 1.0)
        assert STILL[0] < plane.lag < STILL[-1]


async def drive(plane: Carrier, way: float) -> None:
    """Let time pass until the base has driven so far [m]."""
    while plane.travelled < way:
        await plane.go(0.1)
        await asyncio.sleep(0.01)  # in which a worker thread loads what arms need, and plans
    assert plane.status.current
