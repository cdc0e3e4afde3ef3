"""Behaviour-tree nodes of missions, besides those of py-trees. They use the robot's time."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.decorators import Decorator

from gigabrain_zenoh.decision.tasks.drive_command import (
    DriveCommand,
    DriveKind,
    Outcome,
    describe_goal,
)

if TYPE_CHECKING:
    from gigabrain_schemas.tasks import Goal
    from gigabrain_zenoh.decision.tasks.conditions import Condition, Read
    from gigabrain_zenoh.decision.tasks.mission import Script


class RunningScript(Protocol):
    """A program of the host that was started."""

    @property
    def result(self) -> tuple[bool, str] | None:
        """Success and a text for people; None while it runs."""
        ...

    def stop(self) -> None:
        """End it, if it still runs."""
        ...


StartScript = Callable[["Script"], RunningScript]


@dataclass
class MissionContext:
    """Inputs and outputs of a mission's nodes in one tick. Time stops while a mission waits."""

    read: "Read"
    start: StartScript
    numbers: Iterator[int]  # of drive commands, each only once
    now_s: float = 0.0
    held_s: float = 0.0  # of that, while the body did not follow a command
    outcome: Outcome | None = None  # of the command of the last tick
    command: DriveCommand | None = None  # of the active node
    doing: str = ""  # the active step, for people
    problem: str = ""  # the last failure, for people
    progress: float | None = None  # of a step that does not drive
    left_s: float | None = None  # until such a step is done, if known

    @property
    def free_s(self) -> float:
        """Time that the mission has run while nothing held the body [s]."""
        return self.now_s - self.held_s

    def begin(self, seconds: float, outcome: Outcome | None) -> None:
        """Begin the next tick, `seconds` after the last."""
        self.now_s += seconds
        if outcome and outcome.held:
            self.held_s += seconds
        self.outcome, self.command, self.doing = outcome, None, ""
        self.progress = self.left_s = None


class Leaf(Behaviour):
    """A node without children."""

    def __init__(self, name: str, context: MissionContext) -> None:
        super().__init__(name)
        self.context = context

    def failed(self, why: str) -> Status:
        """Record why the node failed, and return FAILURE."""
        self.context.problem = why
        return Status.FAILURE


class Drive(Leaf):
    """Issues a drive command, and ends with its outcome."""

    def __init__(
        self, kind: DriveKind, context: MissionContext, goal: "Goal | None" = None, place: str = ""
    ) -> None:
        doing = {"explore": "exploring", "visit": "visiting a place"}.get(kind)
        super().__init__(doing or f"going to {place or (goal and describe_goal(goal))}", context)
        self._command = DriveCommand(0, kind, goal)
        self._prefix = f"{place}: " if place else ""

    def initialise(self) -> None:
        """Take a new number, so that it is a new command."""
        self._command = DriveCommand(
            next(self.context.numbers), self._command.kind, self._command.goal
        )

    def update(self) -> Status:
        """Return the state of the command."""
        outcome, self.context.doing = self.context.outcome, self.name
        if outcome and outcome.number == self._command.number and outcome.state != "running":
            done = outcome.state == "done"
            return Status.SUCCESS if done else self.failed(self._prefix + outcome.reason)
        self.context.command = self._command
        return Status.RUNNING


class Wait(Leaf):
    """Succeeds after some seconds of the robot's time."""

    def __init__(self, seconds: float, context: MissionContext) -> None:
        super().__init__(f"waiting {seconds:g} s", context)
        self._seconds, self._until_s = seconds, 0.0

    def initialise(self) -> None:
        """Start the timer."""
        self._until_s = self.context.now_s + self._seconds

    def update(self) -> Status:
        """Succeed once the time has passed."""
        left_s = self._until_s - self.context.now_s
        if left_s <= 1e-9:
            return Status.SUCCESS
        self.context.doing, self.context.left_s = self.name, left_s
        self.context.progress = 1.0 - left_s / self._seconds
        return Status.RUNNING


class WaitUntil(Leaf):
    """Succeeds once a condition holds. An unknown value does not hold."""

    def __init__(self, condition: "Condition", context: MissionContext) -> None:
        super().__init__(f"waiting until {condition.text}", context)
        self._condition = condition

    def update(self) -> Status:
        """Check the condition."""
        self.context.doing = self.name
        return Status.SUCCESS if self._condition.holds(self.context.read) else Status.RUNNING


class Check(Leaf):
    """Succeeds if a condition holds, and fails if it does not or is unknown."""

    def __init__(self, condition: "Condition", context: MissionContext) -> None:
        super().__init__(f"checking {condition.text}", context)
        self._condition = condition

    def update(self) -> Status:
        """Check the condition once."""
        self.context.doing = self.name
        holds = self._condition.holds(self.context.read)
        if holds:
            return Status.SUCCESS
        why = "is not known" if holds is None else "does not hold"
        return self.failed(f"{self._condition.text} {why}")


class RunScript(Leaf):
    """Runs a program of the host, which ends with the node."""

    def __init__(self, script: "Script", context: MissionContext) -> None:
        super().__init__(f"running {script.run}", context)
        self._script = script
        self._running: RunningScript | None = None

    def initialise(self) -> None:
        """Start the program."""
        self._running = self.context.start(self._script)

    def update(self) -> Status:
        """Return the program's result."""
        self.context.doing = self.name
        result = self._running.result if self._running else None
        if result is None:
            return Status.RUNNING
        return Status.SUCCESS if result[0] else self.failed(f"{self._script.run} {result[1]}")

    def terminate(self, new_status: Status) -> None:
        """Stop the program."""
        if self._running:
            self._running.stop()
            self._running = None


class Timeout(Decorator):
    """Fails if its child takes longer than some seconds of the robot's time.

    The clock stops while the gate or an operator holds the body.
    """

    def __init__(self, child: Behaviour, seconds: float, context: MissionContext) -> None:
        super().__init__(f"at most {seconds:g} s", child)
        self._seconds, self._context, self.began_s = seconds, context, 0.0

    def initialise(self) -> None:
        """Start the timer."""
        self.began_s = self._context.free_s

    def update(self) -> Status:
        """Return the child's status, or FAILURE once the time has passed."""
        too_long = self._context.free_s - self.began_s > self._seconds
        if self.decorated.status is Status.RUNNING and too_long:
            outcome = self._context.outcome
            why = f": {outcome.reason}" if outcome and outcome.reason else ""
            problem = f"{self._context.doing}: not done within {self._seconds:g} s"
            self._context.problem = problem + why
            self._context.command = None
            return Status.FAILURE
        return self.decorated.status


class Guard(Behaviour):
    """Ticks `then` to its end whenever a condition holds, otherwise `do`, which then continues."""

    def __init__(
        self, condition: "Condition", then: Behaviour, do: Behaviour, context: MissionContext
    ) -> None:
        super().__init__(f"while not {condition.text}")
        self._condition, self._context = condition, context
        self._then, self._do, self.interrupted = then, do, False
        for child in (then, do):
            child.parent = self
            self.children.append(child)

    def tick(self) -> Iterator[Behaviour]:
        """Tick one of the two children."""
        if self.status is not Status.RUNNING:
            self.interrupted = False
        if not self.interrupted and self._condition.holds(self._context.read):
            self.interrupted = True
        child = self._then if self.interrupted else self._do
        yield from child.tick()
        status = child.status
        if self.interrupted and status is Status.SUCCESS:
            status = self._resume()
        if status is not Status.RUNNING:
            self.stop(status)
        self.status = status
        yield self

    def update(self) -> Status:
        """Return the status of the last tick: `tick` does the work."""
        return self.status

    def _resume(self) -> Status:
        """Continue with `do` after `then`; fail if the condition still holds."""
        self.interrupted = False
        if self._condition.holds(self._context.read):
            self._context.problem = f"{self._condition.text} still holds after the remedy"
            return Status.FAILURE
        return Status.RUNNING

    def stop(self, new_status: Status) -> None:
        """Stop both children."""
        for child in self.children:
            if child.status is Status.RUNNING or new_status is Status.INVALID:
                child.stop(Status.INVALID)
        super().stop(new_status)
