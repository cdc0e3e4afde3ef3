"""The truth of an emulated arm, by a physics of some boxes."""

import math

import mujoco
import pytest

from gigabrain_drivers.sim.arm_truth import ArmTruth

ON_FLOOR, ON_ROBOT = "0.5 0 0.05", "0 0 0.25"
MODEL = """<mujoco><worldbody>
  <geom type="plane" size="2 2 .1"/>
  <body name="robot/base"><geom type="box" size=".1 .1 .1" pos="0 0 .1"/></body>
  <body name="world/thing" pos="{at}"><freejoint/><geom type="box" size=".05 .05 .05"/></body>
</worldbody></mujoco>"""
STEP_NS = 10_000_000


class Arm:
    """Joints that are wherever a test says."""

    def __init__(self) -> None:
        self.places = [0.0, 0.0]

    def truth(self) -> tuple[list[float], list[float]]:
        return list(self.places), [0.0, 0.0]


def truth_of(at: str = ON_FLOOR) -> tuple[ArmTruth, Arm, mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(MODEL.format(at=at))
    data, arm = mujoco.MjData(model), Arm()
    return ArmTruth(model, data, arm), arm, model, data  # type: ignore[arg-type]


@pytest.mark.parametrize(("at", "carried"), [(ON_FLOOR, 0), (ON_ROBOT, 1), ("0 0 1", 0)])
def test_what_touches_the_robot_alone_is_carried(at: str, carried: int) -> None:
    truth, _, model, data = truth_of(at)
    mujoco.mj_step(model, data, nstep=20)
    truth.update(STEP_NS)
    assert truth.report()["carried"] == carried


def test_an_arm_rests_from_when_on_no_joint_is_more_than_2_deg_from_where_it_ends() -> None:
    truth, arm, _, _ = truth_of()
    for step in range(1, 51):  # 1 deg a step for 30 steps, then 1 deg in 20 steps
        arm.places[1] = math.radians(min(step, 30) + max(0, step - 30) / 20)
        truth.update(step * STEP_NS)
    assert truth.report()["joints_moved_s"] == 0.28
    for step in range(51, 400):
        truth.update(step * STEP_NS)
    assert truth.report()["joints_moved_s"] == 0.28


def test_an_arm_that_sags_for_long_has_moved() -> None:
    truth, arm, _, _ = truth_of()
    for step in range(1, 1001):  # 2 deg a second
        arm.places[0] = -math.radians(0.02 * step)
        truth.update(step * STEP_NS)
    assert truth.report()["joints_moved_s"] == pytest.approx(9.0, abs=0.05)
