"""Finds the points of a depth image that lie on the robot's own arm, or in its hand."""

from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics, PostureSetter

MARGIN_M = 0.015  # round each part, for errors of a camera's mounting and a servo's play
HAND_M = 0.06  # radius round the tool, for an object that it holds or is about to grasp


class ArmMask:
    """The shapes of an arm, placed by its joints' positions. Not for two threads at once."""

    def __init__(self, mjcf: str, body: BodyDescription) -> None:
        """Read a model. Raises ConfigError for one that cannot be used."""
        assert body.arm
        self._floor = np.array((0.0, 0.0, body.arm.floor or 0.0))
        arm = ArmKinematics(mjcf, body.joints, body.arm.tool)
        self._names, self._gripper = arm.names, arm.gripper
        self._model = arm.spec().compile()
        self._data = mujoco.MjData(self._model)
        self._set = PostureSetter(self._model, arm)
        self._tool = self._model.site(arm.tool).id

    def knows(self, joints: Mapping[str, float]) -> bool:
        """Return whether the positions of all of the arm's joints are given."""
        return joints.keys() >= set(self._names)

    def covers(self, points: Floats, joints: Mapping[str, float]) -> NDArray[np.bool_]:
        """Return which points (n, 3) [m] are on the arm or in its hand.

        Points are in the body's frame, with z from the floor. `joints` must have the positions
        [rad] or [m] of all of the arm's joints.
        """
        gripper = joints.get(self._gripper.name) if self._gripper else None
        self._set(self._data, np.array([joints[name] for name in self._names]), gripper)
        mujoco.mj_kinematics(self._model, self._data)
        points = points + self._floor
        away = np.linalg.norm(points - self._data.site_xpos[self._tool], axis=1)
        found: NDArray[np.bool_] = away < HAND_M
        for geom in range(self._model.ngeom):
            if self._model.geom_bodyid[geom]:
                middle, half = self._model.geom_aabb[geom].reshape(2, 3)
                axes = self._data.geom_xmat[geom].reshape(3, 3)
                off = np.abs((points - self._data.geom_xpos[geom]) @ axes - middle)
                found |= (off < half + MARGIN_M).all(axis=1)
        return found
