"""Records what the gripper holds, and controls its grip while the arm or the body moves."""

from gigabrain_schemas.brain import JointTarget
from gigabrain_zenoh.decision.arm_readings import ArmReading
from gigabrain_zenoh.decision.held_things import held_thing, hold_of
from gigabrain_zenoh.decision.tasks.arm_steps import Held, HeldThing
from gigabrain_zenoh.manipulation.arm_planner import Hold
from gigabrain_zenoh.manipulation.collision import Thing
from gigabrain_zenoh.manipulation.phases import Phase, PhaseRun

MAX_MOVE_TICKS = 50  # then the gripper stays at its last command
REST_TICKS = 25  # before the grip is judged: the held thing springs back
AT_PLACE = 0.001  # share of the gripper's range, tolerance of its command


class Grip:
    """The thing in the gripper, and the gripper position that holds it.

    A gripper closed by a command may hold something unknown: a position without a thing. The grip
    is adjusted at rest, so that it is not too hard for long, and no thing creeps out.
    """

    def __init__(self, recalled: Held | None = None) -> None:
        """Start empty; `recall` checks if the gripper still holds what it held before a restart."""
        self.moves = False  # its command has not reached `_place` yet
        self.firm_tick = 0  # of the last `make_firm`
        self._recalled = recalled
        self._thing: Thing | None = None
        self._opening = 0.0  # [rad] or [m], position that releases the thing
        self._place: float | None = None  # [rad] or [m], command that holds something
        self._since_tick = 0  # of its rest or motion

    @property
    def hold(self) -> Hold | None:
        """The held thing in the planner's format; None if there is none, or it is unknown."""
        if self._thing is None or self._place is None:
            return None
        return Hold(thing=self._thing, grip=self._place, opening=self._opening)

    @property
    def held(self) -> Held | None:
        """Describe the held thing, also one from before a restart, in the task file's format."""
        if self._recalled is not None:
            return self._recalled
        hold = self.hold
        return held_thing(hold) if hold else self._place

    @property
    def text(self) -> str:
        """Describe the held thing for users; empty for none."""
        return f"it holds {self._thing.name}" if self._thing else ""

    def take(self, hold: Hold) -> None:
        """Record that the gripper holds a thing."""
        self._thing, self._opening = hold.thing, hold.opening
        self._set_place(hold.grip)

    def close_at(self, arm: ArmReading, place: float) -> None:
        """Record that a command moved the gripper; it holds what stopped it before `place`."""
        self.release()
        if arm.planner.holds(arm.gripper_place(place), place):
            self._set_place(place)

    def release(self) -> None:
        """Record that the gripper holds nothing."""
        self._thing = None
        self._set_place(None)

    def recall(self, arm: ArmReading) -> None:
        """Restore what the gripper held before a restart, if the measured state agrees; once."""
        recalled, self._recalled = self._recalled, None
        if recalled is None or arm.planner.arm.gripper is None:
            return
        if isinstance(recalled, HeldThing):
            if hold := arm.still_held(hold_of(recalled)):
                self.take(hold)
        elif arm.squeezes(recalled):
            self._set_place(recalled)
        if self._place is not None:
            self._set_place(arm.sent_place(self._place))

    def keeps(self, arm: ArmReading) -> bool:
        """Return whether the thing is still held, also after a small change of the command."""
        hold = self.hold
        if hold and (hold := arm.still_held(hold)):
            self._set_place(hold.grip)
        return hold is not None

    def make_firm(self, arm: ArmReading, run: PhaseRun) -> None:
        """Insert a phase into `run` that squeezes the thing firmly enough for a moving arm."""
        self.firm_tick = arm.state.tick
        assert self._place is not None
        place = arm.planner.squeeze(arm.gripper_place(self._place), self._place, moving=True)
        if place != self._place:
            run.insert(Phase(name="squeeze", gripper=place))
            self._set_place(place)

    def follow(self, arm: ArmReading) -> tuple[JointTarget, ...]:
        """Return the target that adjusts the grip of a resting arm; nothing if it is good."""
        gripper, place, tick = arm.planner.arm.gripper, self._place, arm.state.tick
        if gripper is None or place is None:
            return ()
        elapsed, sent = tick - self._since_tick, arm.sent_place(place)
        sent_there = abs(sent - place) <= AT_PLACE * (gripper.upper - gripper.lower)
        if self.moves and (sent_there or not 0 <= elapsed < MAX_MOVE_TICKS):
            place, self.moves, self._since_tick = sent, False, tick
        elif sent_there and not self.moves and not 0 <= elapsed < REST_TICKS:
            measured = arm.gripper_place(place)
            if arm.planner.holds(measured, place):
                place = arm.planner.squeeze(measured, place, moving=False)
                self.moves, self._since_tick = place != self._place, tick
        self._place = place
        return (JointTarget(name=gripper.name, position=place),) if self.moves else ()

    def _set_place(self, place: float | None) -> None:
        self.moves = self.moves and place == self._place
        self._place = place
