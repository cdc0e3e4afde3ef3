"""Control's step with a simple body that drives straight or turns."""

import math

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription, GateStatus
from gigabrain_schemas.brain import CmdVel, Intent
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.control.node import ControlInputs, ControlMemory, step
from gigabrain_zenoh.testing.samples import DRIVING, WAFFLE, state

SHUT = {
    "latched": GateStatus(mode="latched", enables=1),
    "idle": GateStatus(mode="idle", enables=1),
    "stopping": GateStatus(mode="stopping", commander="control", enables=1),
    "a script's": GateStatus(mode="enabled", commander="script", enables=1),
}


def want(v: float = 0.0, w: float = 0.0, *, basis: int = 1) -> Intent:
    twist = Velocity(linear_x=v, angular_z=w)
    return Intent(twist=twist, behaviour="avoid", reason="because", basis=basis)


class Drive:
    """Control, and a body with a gain, and a first-order lag, from commanded to real speed."""

    def __init__(
        self, body: BodyDescription = WAFFLE, *, gain: float = 1.0, lag_s: float = 0.0
    ) -> None:
        self.body, self.memory, self.tick = body, ControlMemory(), 0
        self._gain, self._response = gain, 1 - math.exp(-0.02 / lag_s) if lag_s else 1.0
        self.v = self.w = 0.0
        self._command = CmdVel(linear_x=0.0)

    def go(
        self,
        intent: Intent | None = None,
        *,
        teleop: Velocity | None = None,
        caps: SpeedCaps | None = None,
        gate: GateStatus = DRIVING,
        boot: int = 7,
        ticks_passed: int = 1,
    ) -> CmdVel:
        """One tick."""
        self.tick += ticks_passed
        self.v += (self._gain * self._command.linear_x - self.v) * self._response
        self.w += (self._gain * self._command.angular_z - self.w) * self._response
        measured = state(self.tick, v=self.v, w=self.w, gate=gate, boot=boot)
        inputs = ControlInputs(
            state=measured, intent=intent, teleop=teleop, caps=caps or SpeedCaps()
        )
        self.memory, self._command = step(self.body, self.memory, inputs)
        return self._command

    def speeds(
        self, ticks: int, intent: Intent | None = None, *, caps: SpeedCaps | None = None
    ) -> list[float]:
        """The linear speeds commanded in so many ticks."""
        return [self.go(intent, caps=caps).linear_x for _ in range(ticks)]
