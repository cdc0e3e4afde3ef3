"""The SO-101 for the tests of manipulation."""

import functools

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import JointDescription
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.inverse_kinematics import InverseKinematics
from tests.places import ROOT

MODEL = ROOT / "drivers/gigabrain_drivers/bodies/so101/model.xml"
LIMITS = {
    "shoulder_pan": 1.91986,
    "shoulder_lift": 1.74533,
    "elbow_flex": 1.69,
    "wrist_flex": 1.65806,
    "wrist_roll": 2.74385,
}
JOINTS = (
    *(
        JointDescription(name=name, lower=-limit, upper=limit, max_speed=3.0)
        for name, limit in LIMITS.items()
    ),
    JointDescription(name="gripper", part="gripper", lower=-0.1745, upper=1.7453, max_speed=3.0),
)


@functools.cache
def arm() -> ArmKinematics:
    return ArmKinematics(MODEL.read_text(), JOINTS)


@functools.cache
def inverse() -> InverseKinematics:
    return InverseKinematics(arm())


def postures(count: int, seed: int = 0) -> Floats:
    """Return random postures (count, 5) within the limits."""
    return np.random.default_rng(seed).uniform(arm().lower, arm().upper, (count, 5))
