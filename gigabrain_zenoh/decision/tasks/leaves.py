"""Leaves of mission trees for py-trees: drive, move the arm, wait, check, or run a program.

All use the robot's time.
"""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field

from msgspec.structs import replace
from py_trees.behaviour import Behaviour
from py_trees.common import Status

from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.behaviours import (
    ArmCommand,
    Command,
    DriveCommand,
    DriveKind,
    StepOutcome,
    Target,
    describe_goal,
)
from gigabrain_zenoh.decision.known_objects import Seek, Sought, Wanted, named
from gigabrain_zenoh.decision.tasks.arm_steps import (
    ArmAction,
    AwaitTaken,
    Held,
    HeldThing,
    Pick,
    Solid,
    describe,
)
from gigabrain_zenoh.decision.tasks.conditions import Condition, Read
from gigabrain_zenoh.decision.tasks.mission import Script
from gigabrain_zenoh.decision.tasks.scripts import Run, RunningScripts

TARGET_MOVED_M = 0.15  # a target that moved farther needs another command
TRIED_M = 0.4  # radius of a place that was reached in vain: an unknown target is not sought there
FIRST_MESSAGE_S = 1.0  # a check waits so long for the first message of its topic
MAX_APPROACHES = 4  # of a thing to pick up
NOBODY_LOOKS = "waiting: nothing is recognised in pictures; run the process `recognition`"


def seek_nothing(_wanted: Wanted, _without: Collection[int], _preferred: int | None) -> Sought:
    """Find nothing."""
    return Sought()


@dataclass
class Hand:
    """The thing in the gripper, as far as decision knows; shared by all tasks."""

    held: Held | None = None


@dataclass
class MissionContext:
    """Inputs and outputs of a mission's nodes in one tick. Time stops while a mission waits."""

    read: Read
    scripts: RunningScripts
    numbers: Iterator[int]  # unique numbers for commands
    seek: Seek = seek_nothing
    hand: Hand = field(default_factory=Hand)
    now_s: float = 0.0
    held_s: float = 0.0  # part of `now_s` in which the body did not follow a command
    passed_s: float = 0.0  # since the last tick; 0 while the body is held
    outcome: StepOutcome | None = None  # of the command of the last tick
    command: Command | None = None  # of the active node
    given: Mapping[str, Solid] = field(default_factory=dict)  # things of the mission's file
    things: dict[str, Solid] = field(default_factory=dict)  # now around the arm
    offers: bool = False  # the active step waits for a person to take something
    may_let_go: bool = False  # a person confirmed that the gripper may open
    doing: str = ""  # the active step, shown to users
    problem: str = ""  # the last failure, shown to users
    progress: float | None = None  # of a step that does not drive
    left_s: float | None = None  # time left of such a step, if known

    @property
    def free_s(self) -> float:
        """Running time of the mission without the time in which the body was held [s]."""
        return self.now_s - self.held_s

    def begin(self, seconds: float, outcome: StepOutcome | None) -> None:
        """Begin the next tick, `seconds` after the last one."""
        held = outcome is not None and outcome.held
        self.now_s += seconds
        self.held_s += seconds if held else 0.0
        self.passed_s = 0.0 if held else seconds
        self.outcome, self.command, self.doing = outcome, None, ""
        self.progress = self.left_s = None
        self.offers = False


class Leaf(Behaviour):
    """A node without children."""

    def __init__(self, name: str, context: MissionContext) -> None:
        super().__init__(name)
        self.context = context

    def failed(self, why: str) -> Status:
        """Record why the node failed, and return FAILURE."""
        self.context.problem = why
        return Status.FAILURE


class DriveNode(Leaf):
    """Issues a drive command, and ends with its outcome."""

    def __init__(
        self,
        kind: DriveKind,
        context: MissionContext,
        goal: Goal | None = None,
        place: str = "",
        target: Target | None = None,
    ) -> None:
        doing = {"explore": "exploring", "visit": "visiting a place"}.get(kind)
        if target:
            doing = f"going to {target.name}"
        super().__init__(doing or f"going to {place or (goal and describe_goal(goal))}", context)
        self._command = DriveCommand(0, kind, goal, target)
        self._prefix = f"{place}: " if place else ""

    def initialise(self) -> None:
        """Start the node, or start it again."""
        self._command = replace(self._command, number=next(self.context.numbers))

    def update(self) -> Status:
        """Advance the node by one tick, and return its status."""
        outcome, self.context.doing = self.context.outcome, self.name
        if outcome and outcome.number == self._command.number and outcome.state != "running":
            done = outcome.state == "done"
            return Status.SUCCESS if done else self.failed(self._prefix + outcome.reason)
        self.context.command = self._command
        return Status.RUNNING


class ArmNode(Leaf):
    """Issues a command to the arm, ends with its outcome, and records where things are."""

    def __init__(self, action: ArmAction, context: MissionContext) -> None:
        super().__init__(describe(action), context)
        self._action = action
        self._command: ArmCommand | None = None

    def initialise(self) -> None:
        """Start the node, or start it again."""
        number, things = next(self.context.numbers), dict(self.context.things)
        self._command = ArmCommand(number, self._action, things)

    def update(self) -> Status:
        """Advance the node by one tick, and return its status."""
        outcome, self.context.doing = self.context.outcome, self.name
        assert self._command
        if outcome and outcome.number == self._command.number:
            lost, self.context.hand.held = self.context.hand.held, outcome.holds
            if isinstance(outcome.holds, HeldThing):
                self.context.things.pop(outcome.holds.name, None)
            elif isinstance(lost, HeldThing):
                given = self.context.given.get(lost.name)
                if given and given.at is None:
                    self.context.things[lost.name] = given  # cameras have to locate it again
            if outcome.placed:  # before the command ends, as its retreat may be cut short
                name, solid = outcome.placed
                given = self.context.given.get(name, solid)
                self.context.things[name] = solid if given.at else given
        if outcome and outcome.number == self._command.number and outcome.state != "running":
            done = outcome.state == "done"
            return Status.SUCCESS if done else self.failed(f"{self.name}: {outcome.reason}")
        self.context.command = self._command
        return Status.RUNNING


class OfferNode(ArmNode):
    """Holds still until a person pulls at the held thing, takes it, or confirms to let go."""

    def __init__(self, seconds: float, context: MissionContext) -> None:
        super().__init__(AwaitTaken(), context)
        self._seconds, self._until_s = seconds, 0.0

    def initialise(self) -> None:
        """Start the node, or start it again."""
        super().initialise()
        self.context.may_let_go = False
        self._until_s = self.context.free_s + self._seconds

    def delay(self, seconds: float) -> None:
        """Extend the time limit by `seconds`."""
        self._until_s += seconds

    def update(self) -> Status:
        """Advance the node by one tick, and return its status."""
        status = super().update()
        if status is not Status.RUNNING:
            return status
        if self.context.may_let_go:
            self.context.command = None
            return Status.SUCCESS
        if self.context.free_s > self._until_s:
            self.context.command = None
            held = self.context.hand.held
            name = held.name if isinstance(held, HeldThing) else "it"
            return self.failed(
                f"no person took {name} within {self._seconds:g} s; the gripper still holds it"
            )
        self.context.offers = True
        return Status.RUNNING


class SeekNode(Leaf):
    """Drives to the nearest wanted object or tag, and looks around while none is known.

    A target that gets lost on the way may only be hidden: the robot still drives there once.
    """

    def __init__(self, wanted: Wanted, context: MissionContext) -> None:
        super().__init__(f"looking for {named(wanted)}", context)
        self._wanted = wanted
        self._command = DriveCommand(0, "look")
        self._id: int | None = None  # of the target
        self._seek = 0
        self._unreached: dict[int, str] = {}  # reasons, by id of the target
        self._tried: list[Target] = []  # places that it reached, but without the target

    def initialise(self) -> None:
        """Start the node, or start it again."""
        self._seek = next(self.context.numbers)
        self._command, self._id = DriveCommand(self._seek, "look", seek=self._seek), None
        self._unreached, self._tried = {}, []

    def update(self) -> Status:
        """Advance the node by one tick, and return its status."""
        outcome = self.context.outcome
        ended = outcome and outcome.number == self._command.number and outcome.state != "running"
        if outcome and ended and self._command.kind == "look":
            return self.failed(self._not_found(outcome.reason))
        if outcome and ended and outcome.state != "done" and self._id is not None:
            self._unreached[self._id] = outcome.reason
        found = self.context.seek(self._wanted, self._unreached, self._id)
        if outcome and ended and outcome.state == "done" and found.target and found.id == self._id:
            return Status.SUCCESS
        if ended and self._command.target:
            self._tried.append(self._command.target)
        self._choose(found)
        target = self._command.target
        self.context.doing = f"going to {target.name}" if target else self.name
        if target is None and not found.recognizing:
            self.context.doing = NOBODY_LOOKS
        else:
            self.context.command = self._command
        return Status.RUNNING

    def _choose(self, found: Sought) -> None:
        """Issue a new command if the target is another one, or moved."""
        target, before = found.target, self._command.target
        if target is None:
            lost = before and any(_distance(before, place) <= TRIED_M for place in self._tried)
            if lost or (before is None and self._command.kind != "look"):
                number = next(self.context.numbers)
                self._command, self._id = DriveCommand(number, "look", seek=self._seek), None
            return
        if found.id != self._id or before is None or _distance(target, before) > TARGET_MOVED_M:
            number = next(self.context.numbers)
            self._command = DriveCommand(number, "approach", target=target)
            self._id = found.id

    def _not_found(self, reason: str) -> str:
        text = f"{named(self._wanted)} was not found: {reason}"
        if self._unreached:
            text = "; ".join((*dict.fromkeys(self._unreached.values()), text))
        return text


class PickNode(ArmNode):
    """Picks up a thing; a body that can drive also searches for it, and drives near enough."""

    def __init__(self, action: Pick, context: MissionContext) -> None:
        super().__init__(action, context)
        self._approach: DriveNode | SeekNode | None = None  # the arm tries again after it
        self._approaches = 0

    def initialise(self) -> None:
        """Start the node, or start it again."""
        super().initialise()
        self._approach, self._approaches = None, 0

    def update(self) -> Status:
        """Advance the node by one tick, and return its status."""
        if self._approach:
            status = self._approach.update()
            if status is not Status.SUCCESS:
                return status
            self._approach = None
            super().initialise()
        self._approach = self._next_approach()
        if self._approach is None:
            return super().update()
        self._approaches += 1
        self._approach.initialise()
        return self._approach.update()

    def _next_approach(self) -> DriveNode | SeekNode | None:
        outcome, command = self.context.outcome, self._command
        assert command
        if self._approaches == MAX_APPROACHES:
            return None
        if outcome is None or outcome.number != command.number:
            return None
        if outcome.approach:
            return DriveNode("approach", self.context, target=outcome.approach)
        return SeekNode(outcome.seek, self.context) if outcome.seek else None


class WaitNode(Leaf):
    """Succeeds after some seconds of the robot's time."""

    def __init__(self, seconds: float, context: MissionContext) -> None:
        super().__init__(f"waiting {seconds:g} s", context)
        self._seconds, self._until_s = seconds, 0.0

    def initialise(self) -> None:
        """Start the node, or start it again."""
        self._until_s = self.context.now_s + self._seconds

    def update(self) -> Status:
        """Advance the node by one tick, and return its status."""
        left_s = self._until_s - self.context.now_s
        if left_s <= 1e-9:
            return Status.SUCCESS
        self.context.doing, self.context.left_s = self.name, left_s
        self.context.progress = 1.0 - left_s / self._seconds
        return Status.RUNNING


class ConditionNode(Leaf):
    """Succeeds if a condition holds; otherwise waits or fails, also if the value is unknown.

    The first read of a topic subscribes to it, so its first message may still be in transit.
    """

    def __init__(self, condition: Condition, context: MissionContext, *, waits: bool) -> None:
        super().__init__(f"{'waiting until' if waits else 'checking'} {condition.text}", context)
        self._condition, self._waits, self._until_s = condition, waits, 0.0

    def initialise(self) -> None:
        """Start the node, or start it again."""
        self._until_s = self.context.now_s + FIRST_MESSAGE_S

    def update(self) -> Status:
        """Advance the node by one tick, and return its status."""
        self.context.doing = self.name
        holds = self._condition.holds(self.context.read)
        if holds or self._waits:
            return Status.SUCCESS if holds else Status.RUNNING
        silent = holds is None and self.context.read(self._condition.topic) is None
        if silent and self.context.now_s < self._until_s:
            return Status.RUNNING
        why = "is not known" if holds is None else "does not hold"
        return self.failed(f"{self._condition.text} {why}")


class ScriptNode(Leaf):
    """Runs a program of the host, and stops it if the node is interrupted."""

    def __init__(self, script: Script, context: MissionContext) -> None:
        super().__init__(f"running {script.run}", context)
        self._script = script
        self._running: Run | None = None

    def initialise(self) -> None:
        """Start the node, or start it again."""
        self._running = self.context.scripts.start(self._script)

    def update(self) -> Status:
        """Advance the node by one tick, and return its status."""
        assert self._running
        self.context.doing, result = self.name, self._running.result
        if result is None:
            self.context.scripts.keep_running(self._running)
            return Status.RUNNING
        return Status.SUCCESS if result[0] else self.failed(f"{self._script.run} {result[1]}")

    def terminate(self, new_status: Status) -> None:
        """Stop the program."""
        if self._running:
            self.context.scripts.stop(self._running)
            self._running = None


def _distance(one: Target, other: Target) -> float:
    return math.hypot(one.x - other.x, one.y - other.y)
