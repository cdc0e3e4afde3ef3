"""Limits that `gigabrain bench hands` checks by the physics of an arm."""

from types import SimpleNamespace
from typing import cast

import pytest

from gigabrain_schemas.body import JointDescription
from gigabrain_zenoh.qa.bench.hands import ArmInMemory

LIFT = JointDescription(name="lift", lower=-1.0, upper=1.0, max_speed=2.0)
JAW = JointDescription(name="jaw", part="gripper", unit="m", lower=0.0, upper=0.1, max_speed=0.2)


def judged(positions: list[float], speeds: list[float]) -> tuple[bool, float]:
    """Return whether an arm breaks its limits, and the highest share of a speed."""
    arm = SimpleNamespace(
        description=SimpleNamespace(joints=(LIFT, JAW)),
        arm=SimpleNamespace(truth=lambda: (positions, speeds)),
        fastest=0.0,
    )
    breaks = ArmInMemory._breaks_limits(cast("ArmInMemory", arm))
    return breaks, arm.fastest


@pytest.mark.parametrize(
    ("positions", "speeds", "breaks"),
    [
        ([1.0, 0.1], [2.0, -0.2], False),
        ([1.01, 0.0], [0.0, 0.0], True),
        ([0.0, -0.01], [0.0, 0.0], True),
        ([0.0, 0.0], [-2.1, 0.0], True),
        ([0.0, 0.0], [0.0, 0.21], True),
    ],
)
def test_a_joint_breaks_its_limits_beyond_its_range_or_its_speed(
    positions: list[float], speeds: list[float], breaks: bool
) -> None:
    assert judged(positions, speeds)[0] is breaks


def test_the_highest_speed_is_of_all_joints_also_when_one_is_out_of_its_range() -> None:
    assert judged([1.5, 0.0], [1.0, 0.18]) == (True, pytest.approx(0.9))
