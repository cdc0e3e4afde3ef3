"""An arm in MuJoCo reaches goals near its body, a shelf and the table, and touches nothing."""

from pathlib import Path

import pytest

from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Joint, RobotState
from gigabrain_zenoh.decision.arm_readings import ArmReading
from gigabrain_zenoh.decision.arm_work import WorkInputs, work_for
from gigabrain_zenoh.decision.tasks.arm_steps import Reach
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner, Plan
from gigabrain_zenoh.qa.bench.reach import measure_reach
from tests.node.arm_rig import Rig

BASE = "robot/base_plate"
LYING = (-0.5016, 0.4755, 0.3543, 1.6276, -0.25, -0.1745)  # [rad], lying on the table


@pytest.mark.parametrize(
    ("body", "goals"),
    [
        ("so101", 10),
        pytest.param("so101", 60, marks=pytest.mark.slow),
        pytest.param("piper", 60, marks=pytest.mark.slow),
    ],
)
def test_an_arm_reaches_each_goal_for_which_a_posture_exists(body: str, goals: int) -> None:
    result = measure_reach(body, goals, 1, lambda _: None)
    assert result.touched == ()
    assert result.no_way == {}
    assert result.held == 0
    assert result.reached == result.solved.n > goals / 6
    assert sum(result.refused.values()) == result.unsolved.n == goals - result.solved.n
    assert result.off_p95_m < 0.03


@pytest.mark.parametrize("body", ["turtlebot3_burger", "lekiwi"])
def test_a_body_without_a_fixed_arm_is_refused(body: str) -> None:
    with pytest.raises(ConfigError, match=f"{body} has no arm that stands in MuJoCo"):
        measure_reach(body, 1, 0, lambda _: None)


def parts_on_floor(rig: Rig) -> set[str]:
    """Return the moving parts of the arm that touch the floor in the physics."""
    model, contacts = rig.arm.simulation.model, rig.arm.simulation.data.contact
    pairs = [{str(model.geom(geom).name) for geom in pair} for pair in contacts.geom]
    touching = {name for pair in pairs if "world/floor" in pair for name in pair}
    return {name for name in touching if name.startswith("robot/")} - {BASE}


def test_an_open_gripper_does_not_touch_the_table(tmp_path: Path) -> None:
    rig, touched = Rig(tmp_path), set[str]()
    for step in ("posture: {wrist_roll: 2.6}", "gripper: 0.8", "reach: [0.2505, 0.0165, 0.0421]",
                 "reach: [0.2649, 0.1855, 0.032]", "reach: [0.1913, -0.1977, 0.041]"):  # fmt: skip
        rig.add_mission(f"do: [{{{step}}}]")
        while rig.queue.status.current:
            rig.tick()
            touched |= parts_on_floor(rig)
        assert (rig.queue.status.done[0].state, step) == ("succeeded", step)
    assert touched == set()
    rig.manipulator.close()


def test_an_arm_lying_on_the_table_can_leave_it() -> None:
    body = load_robot("so101").description()
    planner = ArmPlanner(robot_path("so101").with_name("model.xml").read_text(), body)
    joints = tuple(
        Joint(name=joint.name, position=position)
        for joint, position in zip(body.joints, LYING, strict=True)
    )
    here = Pose(x=0.0, y=0.0, yaw=0.0)
    state = RobotState(
        robot_type="so101", pose=here, velocity=Velocity(), joints=joints, joints_sent=LYING
    )
    arm = ArmReading(planner, body, state)
    now = WorkInputs(arm=arm, things={}, hold=None, misses=0, drives=False)
    work = work_for(Reach(at=(0.2, 0.0, 0.15)), now)
    assert not isinstance(work, str)
    assert isinstance(work(), Plan)


@pytest.mark.parametrize(
    ("goal", "why", "names_nearest"),
    [
        ("[0.9, 0.0, 0.1]", "too far by", True),
        ("[0.2, 0.0, -0.05]", "collides: the table", False),
        ("{at: [0.25, 0.1, 0.03], pitch: 0.0}", "the orientation is not possible there", False),
    ],
)
def test_an_unreachable_goal_names_the_nearest_point_if_that_helps(
    tmp_path: Path, goal: str, why: str, names_nearest: bool
) -> None:
    rig = Rig(tmp_path)
    task = rig.run_mission(f"do: [{{reach: {goal}}}]")
    assert why in task.reason
    assert ("the nearest is" in task.reason) == names_nearest
    rig.manipulator.close()
