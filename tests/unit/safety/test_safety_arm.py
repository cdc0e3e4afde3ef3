"""Safety's monitors of joints: which faults stop an arm, and after how long."""

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.body import (
    Arm,
    Battery,
    BodyDescription,
    GateStatus,
    Joint,
    JointDescription,
    KeepOut,
    LinkHealth,
    RobotState,
)
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh.safety.arm_motion import Kind, Near
from gigabrain_zenoh.safety.step import LATCHING_TICKS, SafetyInputs, SafetyMemory, step
from gigabrain_zenoh.testing.samples import state

LIFT = JointDescription(
    name="lift", lower=-1.0, upper=1.0, max_speed=1.0, max_acceleration=10.0,
    max_effort=2.0, follow=0.05, max_current=1.5,
)  # fmt: skip
GRIP = replace(LIFT, name="grip", part="gripper")
BODY = BodyDescription(
    robot_type="crane",
    drive_type="arm",
    footprint=((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)),
    joints=(LIFT, GRIP),
    arm=Arm(home=(0.0, 0.0), voltage=(6.0, 8.4)),
)
SCRIPT = GateStatus(mode="enabled", commander="script", enables=1)


class Wall:
    """A shape that `lift` reaches at 0.5 rad with a lever of 0.4 m."""

    levers = np.array([[0.4, 0.0]])

    def near(self, postures: NDArray[np.float64], within: NDArray[np.float64]) -> Near:
        distances = 0.4 * (0.5 - postures[:, 0])
        (where,) = np.nonzero(distances < within[:, 0])
        gradients = np.tile((-0.4, 0.0), (len(where), 1))
        return Near(where, np.zeros_like(where), distances[where], gradients)

    def describe(self, pair: int) -> tuple[Kind, str, str]:
        return "keep_out", "jaw", "shelf"


class Crane:
    """An arm of two joints with safety. The joints are at their setpoints by default."""

    def __init__(self, body: BodyDescription = BODY, **fields: Any) -> None:
        self.body, self.memory, self.tick = body, SafetyMemory(), 0
        self.verdict = SafetyState(verdict="stop")
        self.fields: dict[str, Any] = {"shape": Wall(), "problem": ""}
        assert self.go(5, **fields) == []

    def go(
        self,
        ticks: int = 1,
        *,
        sent: float = 0.0,
        at: float | None = None,
        grip: float = 0.0,
        effort: float = 0.1,
        grip_effort: float = 0.1,
        reported: int = 2,
        noise: float = 1e-4,
        volts: float = 7.4,
        **fields: Any,
    ) -> list[str]:
        """Run some ticks; return the codes of the causes after the last one."""
        extra = {key: fields.pop(key) for key in ("current", "temperature") if key in fields}
        inputs = {key: fields.pop(key) for key in ("shape", "problem") if key in fields}
        self.fields |= inputs
        for _ in range(ticks):
            self.tick += 1
            shake = noise * (self.tick % 2)
            lift = Joint(
                name="lift", position=(sent if at is None else at) + shake, effort=effort, **extra
            )
            joints = (lift, Joint(name="grip", position=grip, effort=grip_effort))
            now: RobotState = replace(
                state(self.tick, gate=SCRIPT),
                battery=Battery(voltage=volts, percentage=100.0),
                joints=joints[:reported],
                joints_sent=(sent, 0.0),
                **fields,
            )
            self.memory, self.verdict = step(
                self.body,
                self.memory,
                SafetyInputs(
                    state=now, arm=self.fields["shape"], arm_problem=self.fields["problem"]
                ),
            )
        return self.codes

    @property
    def codes(self) -> list[str]:
        return [cause.code for cause in self.verdict.causes]


@pytest.mark.parametrize(
    ("fields", "code", "ticks"),
    [
        ({"reported": 1}, "joint_lost", 5),
        ({"at": 0.06}, "joint_off", 25),
        ({"at": -0.06}, "joint_off", 25),
        ({"effort": 2.0}, "joint_overload", 50),
        ({"effort": -2.1}, "joint_overload", 50),
        ({"current": 1.5}, "joint_overload", 50),
        ({"grip_effort": 2.0}, "joint_overload", 250),
        ({"volts": 5.9}, "voltage_low", 100),
        ({"volts": 8.5}, "voltage_high", 100),
        ({"temperature": 71.0}, "motor_hot", 25),
    ],
)
def test_a_lasting_fault_stops_the_arm_and_latches(
    fields: dict[str, Any], code: str, ticks: int
) -> None:
    crane = Crane()
    assert crane.go(ticks - 1, **fields) == []
    assert crane.go(1, **fields) == [code]
    assert crane.verdict.verdict == "stop"
    assert crane.verdict.causes[0].latching
    assert crane.go(LATCHING_TICKS) == []


@pytest.mark.long
@pytest.mark.parametrize(
    "fields",
    [
        {"at": 0.04},
        {"effort": 1.9},
        {"current": 1.4},
        {"grip": 0.9},  # it holds something
        {"at": -0.9, "limp": True},
        {"volts": 6.0},
        {"temperature": 59.0},
    ],
)
def test_values_within_limits_do_not_stop_the_arm(fields: dict[str, Any]) -> None:
    crane = Crane(**({"limp": True} if "limp" in fields else {}))
    crane.go(1, **{key: value / 2 for key, value in fields.items() if key in ("at", "grip")})
    assert crane.go(300, **fields) == []


def test_a_joint_that_follows_late_is_not_off() -> None:
    crane = Crane(body=replace(BODY, arm=replace(BODY.arm, voltage=None)))
    found = [crane.go(1, sent=0.02 * tick, at=max(0.0, 0.02 * tick - 0.2), shape=Far())
             for tick in range(45)]  # fmt: skip
    assert found[-1] == []


class Far(Wall):
    def near(self, postures: NDArray[np.float64], within: NDArray[np.float64]) -> Near:
        none = np.zeros(0, np.int64)
        return Near(none, none, np.zeros(0), np.zeros((0, 2)))


def test_a_joint_that_repeats_its_values_away_from_its_setpoint_is_frozen() -> None:
    crane = Crane(noise=0.0)
    assert crane.go(19, sent=0.3, at=0.0, noise=0.0) == []
    assert crane.go(1, sent=0.3, at=0.0, noise=0.0) == ["joint_frozen"]
    assert not crane.verdict.causes[0].latching
    assert crane.go(1, sent=0.3, at=0.001, noise=0.0) == []


def test_a_joint_at_rest_may_repeat_its_values() -> None:
    assert Crane(noise=0.0).go(300, noise=0.0) == []


@pytest.mark.parametrize(("to", "codes"), [(0.13, ["joint_jump"]), (0.11, [])])
def test_a_joint_that_moves_faster_than_it_can_jumps(to: float, codes: list[str]) -> None:
    """The limit is 0.12 rad: 1.5 times 1 rad/s, for one tick and 3 ticks of delay."""
    crane = Crane(noise=0.0)
    assert crane.go(LATCHING_TICKS, at=to, noise=0.0) == codes  # reported for so long
    assert crane.go(1, at=to, noise=0.0) == []


def test_joints_are_not_judged_while_the_link_is_lost() -> None:
    crane = Crane()
    gone = LinkHealth(connected=False)
    assert crane.go(200, sent=0.4, at=0.0, link=gone, noise=0.0) == []


def test_without_a_model_the_arm_does_not_move() -> None:
    crane = Crane()
    assert crane.go(1, shape=None, problem="it has a mesh") == ["arm_model"]
    assert crane.verdict.verdict == "stop"
    assert crane.verdict.causes[0].text == "it has a mesh"


def test_near_a_box_the_arm_only_moves_away() -> None:
    crane = Crane()
    crane.go(30, sent=0.485)
    assert crane.codes == ["arm_keep_out"]
    assert crane.verdict.verdict == "slow"
    assert crane.verdict.causes[0].text == "jaw is 6 mm from shelf; it only moves away"
    (cap,) = crane.verdict.joints
    assert (cap.name, cap.fall) == ("lift", None)
    assert cap.rise is not None
    assert cap.rise < 0.05
    crane.go(30, sent=0.495)
    assert crane.verdict.joints[0].rise == 0.0


@pytest.mark.parametrize("name", ["floor", "again"])
def test_boxes_need_names_of_their_own(name: str) -> None:
    box = KeepOut(name=name, center=(0.0, 0.0, 0.0), size=(0.1, 0.1, 0.1))
    with pytest.raises(ValueError, match="keep_out: each box needs a name of its own"):
        Arm(home=(0.0,), keep_out=(box, box))


@pytest.mark.parametrize(
    ("change", "says"),
    [({"follow": 0.6}, "a quarter of its range")],
)
def test_a_monitor_of_a_joint_cannot_be_switched_off(change: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        replace(LIFT, **change)


def test_the_supply_needs_the_least_voltage_first() -> None:
    with pytest.raises(ValueError, match="the least and the greatest"):
        Arm(home=(0.0,), voltage=(8.4, 6.0))
