"""Arm plans for viewers: the tool's path and its grasps. They are made for viewers only."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gigabrain_schemas.brain import ArmPlan
from tests.node.arm_rig import THINGS, Rig


@pytest.fixture
def rig(tmp_path: Path) -> Any:
    made = Rig(tmp_path)
    yield made
    made.manipulator.close()


def test_the_path_of_the_tool_ends_at_the_goal(rig: Rig) -> None:
    rig.watch_plans(True)
    assert rig.run_mission("do: [{reach: [0.22, 0.05, 0.12]}]").state == "succeeded"
    rig.tick()
    plan, over = rig.plans
    assert over == ArmPlan()
    points = plan.points()
    assert points[-1] == pytest.approx([0.22, 0.05, 0.12], abs=0.012)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).min() > 0.0099


def test_a_pick_shows_its_grasps_with_the_chosen_one_first(rig: Rig) -> None:
    rig.add_mission(THINGS + "do: [{pick: cube}]")
    while rig.outcome is None or rig.outcome.reason != "hover":
        rig.tick()
    assert rig.plans == []  # there is no viewer
    rig.watch_plans(True)
    rig.tick()
    (plan,) = rig.plans
    assert 1 < len(plan.grasps) <= 8
    chosen = plan.grasps[0]
    assert chosen.position[:2] == pytest.approx((0.2388, 0.0), abs=0.01)
    assert chosen.opening == pytest.approx(0.03)
    assert np.linalg.norm(plan.points() - chosen.position, axis=1).min() < 0.03
    rig.watch_plans(False)
    rig.run_until_done()
    assert len(rig.plans) == 1
