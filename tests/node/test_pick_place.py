"""An arm picks things up and puts them down in MuJoCo, through control and the gate."""

from pathlib import Path

import numpy as np
import pytest

from gigabrain_drivers.driver.catalog import load_link, load_robot, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.collision import Thing
from gigabrain_zenoh.manipulation.pick_place import NoWay, PickPlacePlanner
from gigabrain_zenoh.qa.bench.hands import arm_before, draw, measure_hands, pan_axis

TABLE = Thing(name="table", kind="floor", position=np.array([0.0, 0.0, -0.001]))
SEEDS = (0, 2, 4, 5, 9, 13)  # for each kind a light and a heavy thing


@pytest.fixture(scope="module")
def planner() -> PickPlacePlanner:
    robot = load_robot("so101")
    assert robot.arm
    model = robot_path("so101").with_name("model.xml").read_text()
    return PickPlacePlanner(ArmKinematics(model, robot.joints, robot.arm.tool))


def home(planner: PickPlacePlanner) -> np.ndarray:
    robot = load_robot("so101")
    assert robot.arm
    return np.array(robot.arm.home[: len(planner.arm.joints)])


@pytest.mark.slow
def test_things_of_all_kinds_are_picked_up_and_put_down() -> None:
    result = measure_hands(SEEDS, "so101", lambda _: None)
    assert {run.kind for run in result.runs} == {"cube", "cylinder", "sphere"}
    assert [run.outcome for run in result.runs] == ["placed"] * len(SEEDS)
    assert all(run.broken_limits == 0 for run in result.runs)


@pytest.mark.parametrize("body", ["so101", "piper"])
def test_a_held_thing_does_not_slide_along_the_pads_while_the_arm_moves(body: str) -> None:
    robot, _, options, folder = load_link(body, Run(folder=Path()))
    assert isinstance(options, MujocoOptions)
    assert robot.arm
    model = sim_body(robot, options, Run(folder=folder))
    kinematics = ArmKinematics(model.model, robot.joints, robot.arm.tool)
    planner, names = PickPlacePlanner(kinematics), kinematics.names
    drawn = draw(np.random.default_rng(5), pan_axis(kinematics))
    arm = arm_before(drawn, robot, model)

    def thing_in_tool() -> np.ndarray:
        tool = kinematics.forward(np.array([arm.measured(name) for name in names]))
        return tool.axes.T @ (arm.thing() - tool.position)

    pick = planner.pick(drawn.thing(), [TABLE], arm.posture(names))
    assert not isinstance(pick, NoWay)
    for phase in pick.phases:
        arm.carry_out(phase)
    before = thing_in_tool()
    across = np.array([drawn.x, -drawn.y, drawn.height])
    place = planner.place(pick.held, across, [TABLE], arm.posture(names), pick.grasp.opening)
    assert not isinstance(place, NoWay)
    assert place.phases[0].name == "traverse"
    arm.carry_out(place.phases[0])
    assert np.linalg.norm(thing_in_tool() - before) < 0.003


def test_equal_inputs_give_equal_plans(planner: PickPlacePlanner) -> None:
    thing = draw(np.random.default_rng(1), pan_axis(planner.arm)).thing()
    plans = [planner.pick(thing, [TABLE], home(planner)) for _ in range(2)]
    assert not any(isinstance(one, NoWay) for one in plans)
    first, second = (one.phases[1].arm.positions for one in plans)  # type: ignore[union-attr]
    assert np.array_equal(first, second)


@pytest.mark.parametrize(
    ("thing", "why"),
    [
        (Thing(name="far", kind="box", size=(0.03,) * 3, position=np.array([0.7, 0.0, 0.015])),
         "too far"),
        (Thing(name="wide", kind="box", size=(0.2,) * 3, position=np.array([0.2, 0.0, 0.1])),
         "cm wide"),
    ],
)  # fmt: skip
def test_a_thing_that_cannot_be_grasped_is_refused_with_the_reason(
    planner: PickPlacePlanner, thing: Thing, why: str
) -> None:
    found = planner.pick(thing, [TABLE], home(planner))
    assert isinstance(found, NoWay)
    assert why in found.reason


def test_a_place_out_of_reach_is_refused_with_the_reason(planner: PickPlacePlanner) -> None:
    thing = draw(np.random.default_rng(1), pan_axis(planner.arm)).thing()
    pick = planner.pick(thing, [TABLE], home(planner))
    assert not isinstance(pick, NoWay)
    found = planner.place(
        pick.held, np.array([0.6, 0.0, 0.02]), [TABLE], pick.grasp.posture, pick.grasp.opening
    )
    assert isinstance(found, NoWay)
    assert "too far" in found.reason


@pytest.mark.parametrize("wrist", [-1.2, 0.0, 1.2])
def test_a_thing_tilted_on_the_way_is_put_down_upright(
    planner: PickPlacePlanner, wrist: float
) -> None:
    can = Thing(
        name="can", kind="cylinder", size=(0.02, 0.06), position=np.array([0.24, 0.0, 0.03])
    )
    pick = planner.pick(can, [TABLE], home(planner))
    assert not isinstance(pick, NoWay)
    carrying = np.array([0.0, -1.0, 0.4, wrist, 0.3])
    found = planner.place(
        pick.held, np.array([0.2, 0.12, 0.03]), [TABLE], carrying, pick.grasp.opening
    )
    assert not isinstance(found, NoWay), found.reason
    lowered = found.phases[1].arm
    assert lowered
    end = planner.arm.forward(lowered.positions[-1])
    assert (end.axes @ pick.held.axes[:, 2])[2] > 0.98
