"""Arbitration between several viewers that can steer the robot."""

from typing import Protocol

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Body
from gigabrain_zenoh.geometry.limits import ZERO, clamp, limits_of

SEAT_S = 0.5  # after this time without a command, another viewer may steer
GAP_S = 0.2  # after a longer gap, commands count as a new stream
SETTLE_S = 0.1  # start of a new stream that is ignored: commands the network had buffered


class Steered(Protocol):
    """Interface to the robot that steering needs."""

    @property
    def body(self) -> Body | None:
        """Return the robot's body; None until it is received."""
        ...

    @property
    def enables(self) -> int | None:
        """Return how often its gate was enabled; None while the robot sends nothing."""
        ...

    def steer(self, wanted: Velocity) -> None:
        """Send the operator's wanted velocity to the robot's control."""
        ...


class Seat:
    """Lets one viewer steer at a time, while its commands come. Commands are never repeated."""

    def __init__(self, robot: Steered) -> None:
        self._robot = robot
        self._viewer = 0
        self._until_s = self._said_s = self._from_s = 0.0
        self._enables: int | None = None  # the gate's count when a viewer last steered

    def driving(self, now_s: float) -> int:
        """Return the number of the viewer that steers, or 0."""
        return self._viewer if now_s < self._until_s else 0

    def drive(self, viewer: int, wanted: Velocity, now_s: float) -> bool:
        """Pass on the velocity that a viewer (1, 2, …) wants; return False if another one steers.

        A zero velocity from another viewer is ignored, and returns True.
        """
        if self.driving(now_s) not in (0, viewer):
            return wanted == ZERO
        body = self._robot.body
        if body is None or (wanted == ZERO and viewer != self._viewer):
            return True
        if viewer != self._viewer or now_s - self._said_s > GAP_S:
            self._from_s = now_s + SETTLE_S
        self._viewer, self._said_s, self._until_s = viewer, now_s, now_s + SEAT_S
        if wanted == ZERO:
            self._end()
        elif now_s >= self._from_s:
            self._enables = self._robot.enables
            self._robot.steer(clamp(wanted, limits_of(body.description)))
        return True

    def leave(self, viewer: int) -> None:
        """Stop the robot if the viewer that leaves was steering it."""
        if viewer == self._viewer:
            self._end()

    def clear(self) -> None:
        """End steering by any viewer, because an e-stop was pressed."""
        if self._viewer:
            self._end()

    def _end(self) -> None:
        """Publish a zero velocity, unless the gate was enabled again since the last command.

        In that case a zero would take the body back from its new commander.
        """
        self._viewer = 0
        if self._robot.enables in (None, self._enables):
            self._robot.steer(ZERO)
