"""A fixed arm has neither scans nor worlds, so safety waits for none."""

import pytest

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import GateStatus, Joint, RobotState
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, needed, step
from gigabrain_zenoh.testing.samples import WAFFLE
from tests.unit.control.arm import arm_body

IDLE = GateStatus(mode="idle")
ENABLED = GateStatus(mode="enabled", commander="control")


def codes(silent: tuple[str, ...], gate: GateStatus) -> list[str]:
    state = RobotState(
        robot_type="crane",
        pose=Pose(x=0.0, y=0.0, yaw=0.0),
        velocity=Velocity(),
        joints=(Joint(name="pan", position=0.0), Joint(name="lift", position=0.0)),
        joints_sent=(0.0, 0.0),
        gate=gate,
        boot=7,
        tick=50,
    )
    inputs = SafetyInputs(state=state, silent=silent)
    _, verdict = step(arm_body(), SafetyMemory(boot=7, tick=49), inputs)
    return [cause.code for cause in verdict.causes if cause.code.endswith(("silent", "starting"))]


def test_only_a_body_with_a_base_or_a_lidar_needs_perception() -> None:
    assert needed(arm_body()) == ("decision", "control")
    assert needed(WAFFLE) == ("perception", "decision", "control")


@pytest.mark.parametrize("gate", [IDLE, ENABLED])
def test_silent_perception_is_no_cause(gate: GateStatus) -> None:
    assert codes(("perception",), gate) == []


@pytest.mark.parametrize("system", ["decision", "control"])
def test_silent_decision_or_control_is_a_cause(system: str) -> None:
    assert codes(("perception", system), ENABLED) == [f"{system}_silent"]
    assert codes(("perception", system), IDLE) == [f"{system}_silent"]


def test_a_script_need_not_wait_for_a_missing_brain() -> None:
    assert codes(("perception", "decision", "control"), IDLE) == []
