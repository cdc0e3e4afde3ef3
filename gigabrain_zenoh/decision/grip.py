"""Keeps the grip of an arm that is still, also while the body drives."""

from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import JointTarget
from gigabrain_zenoh.decision.arm_readings import gripper_place, sent_place
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner

LONG_TICKS = 50  # to move on, after which it stays where it was sent
REST_TICKS = 25  # that a gripper rests before its grip is judged: what it holds springs back
THERE = 0.001  # of the gripper's range, within which it was sent where it should be


class Grip:
    """Keeps a gripper from squeezing too hard for long, and from letting a thing creep out."""

    def __init__(self) -> None:
        self.place: float | None = None  # [rad] or [m], where it was sent to hold something
        self.moves = False  # it was not sent all the way there yet
        self._since = 0  # tick since which it rests, or moves

    def hold_by(self, place: float | None) -> None:
        """Record where the gripper was sent to hold something; None for nothing."""
        self.moves = self.moves and place == self.place
        self.place = place

    def keep(
        self, planner: ArmPlanner, body: BodyDescription, state: RobotState
    ) -> tuple[JointTarget, ...]:
        """Return where the gripper should go now; nothing where it may stay."""
        gripper, place = planner.arm.gripper, self.place
        if gripper is None or place is None:
            return ()
        passed, sent = state.tick - self._since, sent_place(planner, body, state, place)
        there = abs(sent - place) <= THERE * (gripper.upper - gripper.lower)
        if self.moves and (there or not 0 <= passed < LONG_TICKS):
            place, self.moves, self._since = sent, False, state.tick
        elif there and not self.moves and not 0 <= passed < REST_TICKS:
            measured = gripper_place(planner, state, place)
            if planner.holds(measured, place):
                place = planner.squeeze(measured, place, moving=False)
                self.moves, self._since = place != self.place, state.tick
        self.place = place
        return (JointTarget(name=gripper.name, position=place),) if self.moves else ()
