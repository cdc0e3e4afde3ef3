"""Estimates the push on an arm's tool from the joints' efforts and lag.

Both are compared with their means of a moment before, so that gravity, friction and a steady speed
do not count. The joints hold the tool against a force F with the efforts J^T F.
"""

from dataclasses import dataclass

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics

SKIPPED_TICKS = 10  # until friction and speed have settled
REFERENCE_TICKS = 10  # the next ones, whose mean is the reference
MIN_SHARE = 0.1  # of the longest lever; forces on shorter levers are not estimated


@dataclass(frozen=True, kw_only=True, eq=False)
class Push:
    """The force on the tool and the tool's lag, in the frame of the base."""

    force: Floats | None  # (3,) [N]; None where efforts are not measured
    lag: Floats  # (3,) [m], from where the tool is to where it was sent


class ContactSense:
    """Compares an arm's efforts and lag in each tick with those of the first ticks."""

    def __init__(self, arm: ArmKinematics) -> None:
        self._arm = arm
        self._ticks = 0
        self._loads, self._lag = np.zeros(len(arm.joints)), np.zeros(3)

    def feel(self, measured: Floats, sent: Floats, efforts: Floats | None) -> Push | None:
        """Return the change of the push since the first ticks; None during these.

        Args:
            measured: Positions of the joints (n,) [rad] or [m].
            sent: Their goals (n,) [rad] or [m].
            efforts: Their efforts (n,) [N m] or [N]; None if not measured.
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
