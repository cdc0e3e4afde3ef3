"""Who of several viewers steers."""

from typing import Protocol

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Body
from gigabrain_zenoh.limits import ZERO, clamp, limits_of

SEAT_S = 0.5  # after so long without a command another viewer may steer
GAP_S = 0.2  # a stream with a longer gap begins anew
SETTLE_S = 0.1  # what a network had stored comes at once: so much of a new stream is passed over


class Steered(Protocol):
    """The robot, as far as somebody who steers it has to know it."""

    @property
    def body(self) -> Body | None:
        """What it is; None while that is not known."""
        ...

    @property
    def enables(self) -> int | None:
        """How often its gate was enabled; None while the robot is silent."""
        ...

    def steer(self, wanted: Velocity) -> None:
        """Tell its control what an operator wants."""
        ...


class Seat:
    """One viewer steers at a time, for as long as commands come. Nothing is ever repeated here."""

    def __init__(self, robot: Steered) -> None:
        self._robot = robot
        self._viewer = 0
        self._until_s = self._said_s = self._from_s = 0.0
        self._enables: int | None = None  # of the gate, when a viewer last steered

    def driving(self, now_s: float) -> int:
        """The number of the viewer who steers, or 0."""
        return self._viewer if now_s < self._until_s else 0

    def drive(self, viewer: int, wanted: Velocity, now_s: float) -> bool:
        """Pass on what a viewer (1, 2, …) wants; False where another one steers."""
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
        """A viewer is gone: whatever it wanted ends."""
        if viewer == self._viewer:
            self._end()

    def clear(self) -> None:
        """Nobody steers any more: an e-stop was pressed."""
        if self._viewer:
            self._end()

    def _end(self) -> None:
        """Stop what was steered, unless the body was handed over since: a zero would take it."""
        self._viewer = 0
        if self._robot.enables in (None, self._enables):
            self._robot.steer(ZERO)
