"""Detects contact at an arm's tool: it presses against something, or a person pulls."""

import math
from dataclasses import dataclass

import numpy as np

from gigabrain_zenoh.decision.arm_readings import ArmReading
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner
from gigabrain_zenoh.manipulation.contact import ContactSense, Push

TOUCHED_N, TOUCHED_M = 1.0, 0.003  # a stronger push, or a longer lag, is a touch
PRESSED_M = 0.015  # a longer lag counts as pressed, where efforts are missing or too low
PULLED_N, PULLED_M, PULLED_TICKS = 2.0, 0.008, 5  # minimum force, lag and time of a pull


@dataclass(frozen=True, kw_only=True)
class Pressure:
    """Force and lag of a tool along its approach."""

    newtons: float | None  # force; None if efforts are not measured
    metres: float  # lag

    @property
    def touched(self) -> bool:
        """True if the tool touches something."""
        return (self.newtons or 0.0) > TOUCHED_N or self.metres > TOUCHED_M

    def reaches(self, force: float) -> bool:
        """Return whether the tool presses with `force` [N], or lags by more than PRESSED_M."""
        return (self.newtons or 0.0) >= force or self.metres > PRESSED_M

    def __str__(self) -> str:
        return "pressed" if self.newtons is None else f"pressed with {math.floor(self.newtons)} N"


class Touch:
    """Compares each state with the first ones, which have no contact."""

    def __init__(self, planner: ArmPlanner) -> None:
        self._sense = ContactSense(planner.arm)
        self._pulled_ticks = 0

    def pressure(self, arm: ArmReading) -> Pressure | None:
        """Return how hard the tool presses; None during the first states."""
        push = self._feel(arm)
        if push is None:
            return None
        approach = arm.planner.arm.forward(arm.measured_posture).axes[:, 0]
        force = None if push.force is None else -float(push.force @ approach)
        return Pressure(newtons=force, metres=float(push.lag @ approach))

    def is_pulled(self, arm: ArmReading) -> bool:
        """Return whether a person pulls, since PULLED_TICKS or longer."""
        push = self._feel(arm)
        pulls = push is not None and (
            float(np.linalg.norm(push.lag)) > PULLED_M
            or (push.force is not None and float(np.linalg.norm(push.force)) > PULLED_N)
        )
        self._pulled_ticks = self._pulled_ticks + 1 if pulls else 0
        return self._pulled_ticks >= PULLED_TICKS

    def _feel(self, arm: ArmReading) -> Push | None:
        return self._sense.feel(arm.measured_posture, arm.sent_posture, arm.measured_efforts)
