"""Detection of pushes on an arm by effort and lag, and the near side of a thing."""

import math

import numpy as np
import pytest

from gigabrain_zenoh.manipulation.collision import Thing, turned
from gigabrain_zenoh.manipulation.contact import REFERENCE_TICKS, SKIPPED_TICKS, ContactSense
from gigabrain_zenoh.manipulation.press import near_side
from tests.unit.manipulation.arms import arm

POSTURE = np.array([0.2, -0.3, 0.4, 0.6, 0.0])
FIRST_TICKS = SKIPPED_TICKS + REFERENCE_TICKS


def calibrated(efforts: np.ndarray | None) -> ContactSense:
    """Return a sense with reference values of an arm without a push."""
    sense = ContactSense(arm())
    for _ in range(FIRST_TICKS):
        assert sense.feel(POSTURE, POSTURE + 0.01, efforts) is None
    return sense


def test_a_push_is_felt_by_the_change_of_efforts() -> None:
    friction = np.array([0.0, 0.05, -0.05, 0.02, 0.0])
    holding = arm().weights(POSTURE) + friction
    push = np.array([0.5, -1.0, 3.0])  # [N], on the tool
    sense = calibrated(holding)
    _, jacobian = arm().jacobian(POSTURE)
    felt = sense.feel(POSTURE, POSTURE + 0.01, holding - jacobian[:3].T @ push)
    assert felt
    assert felt.force == pytest.approx(push, abs=1e-6)
    assert felt.lag == pytest.approx(np.zeros(3), abs=1e-9)


def test_the_weight_of_an_arm_in_another_posture_is_no_push() -> None:
    sense = calibrated(arm().weights(POSTURE))
    other = POSTURE + np.array([0.0, 0.3, -0.2, 0.1, 0.0])
    felt = sense.feel(other, other + 0.01, arm().weights(other))
    assert felt
    assert felt.force == pytest.approx(np.zeros(3), abs=1e-6)


def test_without_efforts_only_the_lag_is_known() -> None:
    sense = calibrated(None)
    sent = POSTURE + np.array([0.0, 0.06, 0.0, 0.0, 0.0])
    felt = sense.feel(POSTURE, sent, None)
    expected = arm().forward(sent).position - arm().forward(POSTURE + 0.01).position
    assert felt
    assert felt.force is None
    assert felt.lag == pytest.approx(expected, abs=1e-9)


def test_the_weights_are_those_of_the_links() -> None:
    level = np.array([0.0, math.pi / 2, -math.pi / 2, 0.0, 0.0])  # the upper arm ahead, then up
    lift = arm().weights(level)[1]
    assert -1.2 < lift < -0.3  # [N m]: 0.4 kg about 0.15 m ahead; positive turns it down


@pytest.mark.parametrize(
    ("thing", "approach", "near"),
    [
        (Thing(name="a", kind="sphere", size=(0.02,)), (0, 0, -1), (0, 0, 0.02)),
        (Thing(name="a", kind="cylinder", size=(0.03, 0.1)), (0, 0, -1), (0, 0, 0.05)),
        (Thing(name="a", kind="cylinder", size=(0.03, 0.1)), (1, 0, 0), (-0.03, 0, 0)),
        (Thing(name="a", kind="box", size=(0.02, 0.04, 0.06)), (0, 1, 0), (0, -0.02, 0)),
        (Thing(name="a", kind="box", size=(0.02, 0.04, 0.06), axes=turned(math.pi / 2)),
         (0, 1, 0), (0, -0.01, 0)),
    ],
)  # fmt: skip
def test_the_near_side_is_where_a_ray_to_the_middle_enters(
    thing: Thing, approach: tuple[float, ...], near: tuple[float, ...]
) -> None:
    assert near_side(thing, np.array(approach, float)) == pytest.approx(near, abs=1e-9)
