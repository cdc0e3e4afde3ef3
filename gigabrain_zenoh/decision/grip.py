"""Records what the gripper holds, and keeps its grip, also while the body drives."""

from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import JointTarget
from gigabrain_zenoh.decision.arm_readings import (
    gripper_place,
    sent_place,
    squeezes,
    still_held,
)
from gigabrain_zenoh.decision.held_things import held_thing, hold_of
from gigabrain_zenoh.decision.tasks.arm_steps import Held, HeldThing
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner, Hold
from gigabrain_zenoh.manipulation.collision import Thing
from gigabrain_zenoh.manipulation.phases import Phase, PhaseRun

LONG_TICKS = 50  # to move on, after which it stays where it was sent
REST_TICKS = 25  # that a gripper rests before its grip is judged: what it holds springs back
THERE = 0.001  # of the gripper's range, within which it was sent where it should be


class Grip:
    """The thing in the gripper, and where the gripper was sent to hold it.

    A gripper that a command has closed may hold something too: then there is a place, but no thing.
    It keeps the gripper from squeezing too hard for long, and from letting a thing creep out.
    """

    def __init__(self, recalled: Held | None = None) -> None:
        """Begin with nothing, until `recall` tells whether it holds what it held at a restart."""
        self.moves = False  # it was not sent all the way there yet
        self.firm_tick = 0  # at which it was last made firm for an arm that moves
        self._recalled = recalled
        self._thing: Thing | None = None
        self._opening = 0.0  # [rad] or [m], where the gripper goes to let go of the thing
        self._place: float | None = None  # [rad] or [m], where it was sent to hold something
        self._since = 0  # tick since which it rests, or moves

    @property
    def hold(self) -> Hold | None:
        """Return what the gripper holds, as the planner knows it."""
        if self._thing is None or self._place is None:
            return None
        return Hold(thing=self._thing, grip=self._place, opening=self._opening)

    @property
    def held(self) -> Held | None:
        """Return what the gripper holds, or held before a restart, for the file of tasks."""
        if self._recalled is not None:
            return self._recalled
        hold = self.hold
        return held_thing(hold) if hold else self._place

    @property
    def text(self) -> str:
        """Return what the gripper holds, for people; empty for nothing."""
        return f"it holds {self._thing.name}" if self._thing else ""

    def take(self, hold: Hold) -> None:
        """Record that the gripper holds a thing."""
        self._thing, self._opening = hold.thing, hold.opening
        self._send(hold.grip)

    def close_at(self, planner: ArmPlanner, state: RobotState, place: float) -> None:
        """Record that a command has moved the gripper, which holds what stops it on the way."""
        self.release()
        if planner.holds(gripper_place(planner, state, place), place):
            self._send(place)

    def release(self) -> None:
        """Record that the gripper holds nothing."""
        self._thing = None
        self._send(None)

    def recall(self, planner: ArmPlanner, body: BodyDescription, state: RobotState) -> None:
        """Take what the gripper held before a restart, once, if it agrees."""
        recalled, self._recalled = self._recalled, None
        if recalled is None or planner.arm.gripper is None:
            return
        if isinstance(recalled, HeldThing):
            if hold := still_held(planner, body, state, hold_of(recalled)):
                self.take(hold)
        elif squeezes(planner, body, state, recalled):
            self._send(recalled)
        if self._place is not None:
            self._send(sent_place(planner, body, state, self._place))

    def keeps(self, planner: ArmPlanner, body: BodyDescription, state: RobotState) -> bool:
        """Return whether the thing is still held, maybe where the gripper was sent meanwhile."""
        hold = self.hold
        if hold and (hold := still_held(planner, body, state, hold)):
            self._send(hold.grip)
        return hold is not None

    def make_firm(self, planner: ArmPlanner, run: PhaseRun, state: RobotState) -> None:
        """Have `run` squeeze the thing as hard as a moving arm should; it may spring back."""
        self.firm_tick = state.tick
        assert self._place is not None
        measured = gripper_place(planner, state, self._place)
        place = planner.squeeze(measured, self._place, moving=True)
        if place != self._place:
            run.insert(Phase(name="squeeze", gripper=place))
            self._send(place)

    def follow(
        self, planner: ArmPlanner, body: BodyDescription, state: RobotState
    ) -> tuple[JointTarget, ...]:
        """Return where the gripper of a still arm should go now; nothing where it may stay."""
        gripper, place = planner.arm.gripper, self._place
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
                self.moves, self._since = place != self._place, state.tick
        self._place = place
        return (JointTarget(name=gripper.name, position=place),) if self.moves else ()

    def _send(self, place: float | None) -> None:
        self.moves = self.moves and place == self._place
        self._place = place
