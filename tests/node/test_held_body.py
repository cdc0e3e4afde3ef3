"""A goal while an operator or the gate holds the body: its timers stop, and it has a reason."""

import math
from collections.abc import Callable

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.tasks import GoalRequest, MissionRequest
from gigabrain_schemas.topics import CMD_VEL, GOAL, MISSION
from gigabrain_zenoh.decision.context import OPERATOR_HOLDS
from gigabrain_zenoh.gate.causes import estop
from gigabrain_zenoh.testing.samples import DRIVING
from tests.node.plane import ROOM, Plane, drawn

CELLS = drawn(ROOM)


class Held(Plane):
    """A body that an operator or the gate can hold."""

    held = False

    async def _tick(self) -> None:
        command = CmdVel(linear_x=0.0, source="control", operator=self.held)
        self.bench.send(CMD_VEL, replace(command, boot=self.boot, tick=self.tick))
        await super()._tick()

    def _move(self) -> None:
        if self.held or self.gate != DRIVING:
            self.velocity = Velocity()
        else:
            super()._move()


def operator(plane: Held) -> None:
    plane.held = True


def pressed(plane: Held) -> None:
    plane.gate = GateStatus(mode="latched", causes=(estop("ann"),), enables=1)


def script(plane: Held) -> None:
    plane.gate = GateStatus(mode="enabled", commander="script-7", enables=2)


@pytest.mark.parametrize(
    ("hold", "why"),
    [
        (operator, OPERATOR_HOLDS),
        (pressed, "the gate is latched: e-stop pressed by ann"),
        (script, "script-7 drives"),
    ],
)
async def test_a_goal_waits_with_a_reason_while_the_body_is_held(
    hold: Callable[[Held], None], why: str
) -> None:
    async with Held(CELLS) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.go(1.0)
        hold(plane)
        await plane.go(31.0)
        assert plane.status.current
        assert (plane.status.current.state, plane.status.current.reason) == ("active", why)
        assert plane.travelled < 0.5
        plane.held, plane.gate = False, DRIVING
        await plane.until("succeeded", seconds=60)
        done = plane.status.done[0]
        assert done.position_error is not None
        assert done.position_error <= 0.1
        off = math.hypot(plane.x - 4.0, plane.y - 0.8)
        assert done.position_error == pytest.approx(off, abs=0.02)
        assert done.heading_error is None


async def test_the_time_limit_of_a_mission_stops_while_an_operator_drives() -> None:
    text = "do: [{timeout: {seconds: 3, do: [{goto: [4, 0.8]}]}}]"
    async with Held(CELLS) as plane:
        await plane.go(0.2)
        plane.held = True
        await plane.ask(MISSION, MissionRequest(mission=text))
        await plane.go(20.0)
        assert plane.status.current
        assert plane.status.current.state == "active"
        plane.held = False
        await plane.until("failed", seconds=10)
        assert plane.status.done[0].reason.startswith("going to (4.00, 0.80): not done within 3 s")
