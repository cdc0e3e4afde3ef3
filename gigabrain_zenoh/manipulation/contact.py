"""Feels what pushes an arm's tool: by the efforts of its joints, and by how far they lag behind.

Both are compared with what they were a moment before, so that gravity, friction and a steady speed
do not count. Efforts are those with which joints hold the tool against the push: J^T F.
"""

from dataclasses import dataclass

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics

SKIPPED_TICKS = 10  # at first: friction and speed have to settle
REFERENCE_TICKS = 10  # after them, with whose mean is compared
MIN_SHARE = 0.1  # of the greatest lever; where levers are shorter, a force is not known


@dataclass(frozen=True, kw_only=True, eq=False)
class Push:
    """The force on the tool and the tool's lag, in the frame of the base."""

    force: Floats | None  # (3,) [N]; None where efforts are not measured
    lag: Floats  # (3,) [m], from where the tool is to where it was sent


class ContactSense:
    """Compares an arm tick by tick with what it was in the first ones."""

    def __init__(self, arm: ArmKinematics) -> None:
        self._arm = arm
        self._ticks = 0
        self._loads, self._lag = np.zeros(len(arm.joints)), np.zeros(3)

    def feel(self, measured: Floats, sent: Floats, efforts: Floats | None) -> Push | None:
        """Return what pushes the tool since the first ticks; None during these.

        Args:
            measured: Where the joints are (n,) [rad] or [m].
            sent: Where they were sent.
            efforts: With which they hold (n,) [N m] or [N].
        """
        ahead = self._arm.forward(sent).position
        here, jacobian = self._arm.jacobian(measured)
        lag = ahead - here.position
        loads = None if efforts is None else efforts - self._arm.weights(measured)
        self._ticks += 1
        if self._ticks <= SKIPPED_TICKS + REFERENCE_TICKS:
            if self._ticks > SKIPPED_TICKS:
                self._lag += lag / REFERENCE_TICKS
                self._loads += 0.0 if loads is None else loads / REFERENCE_TICKS
            return None
        lag = lag - self._lag
        if loads is None:
            return Push(force=None, lag=lag)
        change = self._loads - loads
        force = np.linalg.lstsq(jacobian[:3].T, change, rcond=MIN_SHARE)[0]
        return Push(force=np.asarray(force, np.float64), lag=lag)
