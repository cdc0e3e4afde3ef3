"""Ground truth of an emulated arm: when its joints last moved, and what it carries."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.arm import SimArm
from gigabrain_drivers.sim.scene import ROBOT

MAX_SAG = math.radians(2.0)  # [rad] or [m], of an arm at rest
HISTORY_STEPS = 200  # 2 s


class ArmTruth:
    """Truth of an arm. Call `update` once a step.

    joints_moved_s: last time when a joint was more than 2 deg from its present position. carried:
    number of movable things that touch only the robot.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, arm: SimArm) -> None:
        self._data, self._arm = data, arm
        self._moved_ns, self._carried, self._steps = 0, 0, 0
        self._times = np.zeros(HISTORY_STEPS, np.int64)  # [ns]
        self._places = np.tile(arm.truth()[0], (HISTORY_STEPS, 1))
        self._roots = model.body_rootid[model.geom_bodyid]
        self._own = int(model.body(f"{ROBOT}base").id)
        free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
        self._things = [int(body) for body in free if model.body_rootid[body] != self._own]

    def update(self, now_ns: int) -> None:
        """Add the newest step."""
        row = self._steps % HISTORY_STEPS
        self._steps += 1
        self._times[row], self._places[row] = now_ns, self._arm.truth()[0]
        away = np.abs(self._places - self._places[row]).max(axis=1) > MAX_SAG
        self._moved_ns = max(self._moved_ns, int(self._times[away].max(initial=0)))
        pairs = self._roots[self._data.contact.geom]
        self._carried = sum(self._is_carried(thing, pairs) for thing in self._things)

    def _is_carried(self, thing: int, pairs: NDArray[np.int32]) -> bool:
        """Return whether a thing touches only the robot; `pairs` (n, 2) of bodies in contact."""
        touching = pairs[(pairs == thing).any(axis=1)]
        others = touching[touching != thing]
        return bool(len(others)) and bool((others == self._own).all())

    def report(self) -> dict[str, float | int]:
        """Return the truth of the newest step."""
        return {
            "joints_moved_s": round(self._moved_ns / 1e9, 2),
            "carried": self._carried,
        }
