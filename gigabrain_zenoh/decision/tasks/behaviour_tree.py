"""Behaviour trees of missions: own nodes for py-trees, the builder, and their progress on disk.

All nodes use the robot's time.
"""

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta
from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Selector, Sequence
from py_trees.decorators import Decorator, Repeat, Retry

from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.behaviours import (
    ArmCommand,
    Command,
    DriveCommand,
    DriveKind,
    StepOutcome,
    describe_goal,
)
from gigabrain_zenoh.decision.known_objects import Seek, Sought, Wanted, named
from gigabrain_zenoh.decision.tasks.arm_steps import ArmAction, Solid, describe
from gigabrain_zenoh.decision.tasks.conditions import Condition, Read, parse
from gigabrain_zenoh.decision.tasks.mission import (
    AtTag,
    BatteryBelow,
    Mission,
    Patrol,
    Place,
    Script,
    Step,
)
from gigabrain_zenoh.decision.tasks.scripts import Run

FOREVER = -1  # for py-trees
Index = Annotated[float, Meta(ge=0, le=1e9)]
Progress = dict[str, Index]  # of each running node, by its number in depth-first order


StartScript = Callable[[Script], Run]
MOVED_M = 0.15  # that a target may be off where the robot drives to

NOBODY_LOOKS = "waiting: nothing is recognised in pictures; run the process `recognition`"


def seek_nothing(_wanted: Wanted, _without: Collection[int], _preferred: int | None) -> Sought:
    """Return that nothing is known."""
    return Sought()


@dataclass
class MissionContext:
    """Inputs and outputs of a mission's nodes in one tick. Time stops while a mission waits."""

    read: Read
    start: StartScript
    numbers: Iterator[int]  # of commands, each only once
    seek: Seek = seek_nothing
    now_s: float = 0.0
    held_s: float = 0.0  # of that, while the body did not follow a command
    outcome: StepOutcome | None = None  # of the command of the last tick
    command: Command | None = None  # of the active node
    things: dict[str, Solid] = field(default_factory=dict)  # what stands round the arm by now
    doing: str = ""  # the active step, for people
    problem: str = ""  # the last failure, for people
    progress: float | None = None  # of a step that does not drive
    left_s: float | None = None  # until such a step is done, if known

    @property
    def free_s(self) -> float:
        """Time that the mission has run while nothing held the body [s]."""
        return self.now_s - self.held_s

    def begin(self, seconds: float, outcome: StepOutcome | None) -> None:
        """Begin the next tick, `seconds` after the last."""
        self.now_s += seconds
        if outcome and outcome.held:
            self.held_s += seconds
        self.outcome, self.command, self.doing = outcome, None, ""
        self.progress = self.left_s = None


class _Leaf(Behaviour):
    """A node without children."""

    def __init__(self, name: str, context: MissionContext) -> None:
        super().__init__(name)
        self.context = context

    def failed(self, why: str) -> Status:
        """Record why the node failed, and return FAILURE."""
        self.context.problem = why
        return Status.FAILURE


class _DriveNode(_Leaf):
    """Issues a drive command, and ends with its outcome."""

    def __init__(
        self, kind: DriveKind, context: MissionContext, goal: Goal | None = None, place: str = ""
    ) -> None:
        doing = {"explore": "exploring", "visit": "visiting a place"}.get(kind)
        super().__init__(doing or f"going to {place or (goal and describe_goal(goal))}", context)
        self._command = DriveCommand(0, kind, goal)
        self._prefix = f"{place}: " if place else ""

    def initialise(self) -> None:
        self._command = DriveCommand(
            next(self.context.numbers), self._command.kind, self._command.goal
        )

    def update(self) -> Status:
        outcome, self.context.doing = self.context.outcome, self.name
        if outcome and outcome.number == self._command.number and outcome.state != "running":
            done = outcome.state == "done"
            return Status.SUCCESS if done else self.failed(self._prefix + outcome.reason)
        self.context.command = self._command
        return Status.RUNNING


class _ArmNode(_Leaf):
    """Issues a command to the arm, ends with its outcome, and records where things are then."""

    def __init__(self, action: ArmAction, context: MissionContext) -> None:
        super().__init__(describe(action), context)
        self._action = action
        self._command: ArmCommand | None = None

    def initialise(self) -> None:
        number, things = next(self.context.numbers), dict(self.context.things)
        self._command = ArmCommand(number, self._action, things)

    def update(self) -> Status:
        outcome, self.context.doing = self.context.outcome, self.name
        assert self._command
        if outcome and outcome.number == self._command.number and outcome.state != "running":
            if outcome.picked:
                self.context.things.pop(outcome.picked, None)
            if outcome.placed:
                name, solid = outcome.placed
                self.context.things[name] = solid
            done = outcome.state == "done"
            return Status.SUCCESS if done else self.failed(f"{self.name}: {outcome.reason}")
        self.context.command = self._command
        return Status.RUNNING


class _SeekNode(_Leaf):
    """Drives before the nearest wanted thing or tag, and looks for one while none is known."""

    def __init__(self, wanted: Wanted, context: MissionContext) -> None:
        super().__init__(f"looking for {named(wanted)}", context)
        self._wanted = wanted
        self._command = DriveCommand(0, "look")
        self._id: int | None = None  # of the target
        self._seek = 0
        self._missed: dict[int, str] = {}  # ids that it cannot get to, and why

    def initialise(self) -> None:
        self._seek = next(self.context.numbers)
        self._command, self._id = DriveCommand(self._seek, "look", seek=self._seek), None
        self._missed = {}

    def update(self) -> Status:
        outcome = self.context.outcome
        if outcome and outcome.number == self._command.number and outcome.state != "running":
            if self._command.kind == "look":
                return self.failed(self._why(outcome.reason))
            if outcome.state == "done":
                return Status.SUCCESS
            if self._id is not None:
                self._missed[self._id] = outcome.reason
        found = self.context.seek(self._wanted, self._missed, self._id)
        self._choose(found)
        target = self._command.target
        self.context.doing = f"going before {target.name}" if target else self.name
        if target is None and not found.recognizing:
            self.context.doing = NOBODY_LOOKS
        else:
            self.context.command = self._command
        return Status.RUNNING

    def _choose(self, found: Sought) -> None:
        """Give another command if there is another target, or if it is somewhere else."""
        target, before = found.target, self._command.target
        if target is None:
            if before or self._command.kind != "look":
                number = next(self.context.numbers)
                self._command, self._id = DriveCommand(number, "look", seek=self._seek), None
            return
        off = math.hypot(target.x - before.x, target.y - before.y) if before else math.inf
        if found.id != self._id or off > MOVED_M:
            number = next(self.context.numbers)
            self._command = DriveCommand(number, "approach", target=target)
            self._id = found.id

    def _why(self, reason: str) -> str:
        text = f"{named(self._wanted)} was not found: {reason}"
        if self._missed:
            text = "; ".join((*dict.fromkeys(self._missed.values()), text))
        return text


class _WaitNode(_Leaf):
    """Succeeds after some seconds of the robot's time."""

    def __init__(self, seconds: float, context: MissionContext) -> None:
        super().__init__(f"waiting {seconds:g} s", context)
        self._seconds, self._until_s = seconds, 0.0

    def initialise(self) -> None:
        self._until_s = self.context.now_s + self._seconds

    def update(self) -> Status:
        left_s = self._until_s - self.context.now_s
        if left_s <= 1e-9:
            return Status.SUCCESS
        self.context.doing, self.context.left_s = self.name, left_s
        self.context.progress = 1.0 - left_s / self._seconds
        return Status.RUNNING


class _ConditionNode(_Leaf):
    """Succeeds if a condition holds; otherwise waits or fails. An unknown value does not hold."""

    def __init__(self, condition: Condition, context: MissionContext, *, waits: bool) -> None:
        super().__init__(f"{'waiting until' if waits else 'checking'} {condition.text}", context)
        self._condition, self._waits = condition, waits

    def update(self) -> Status:
        self.context.doing = self.name
        holds = self._condition.holds(self.context.read)
        if holds or self._waits:
            return Status.SUCCESS if holds else Status.RUNNING
        why = "is not known" if holds is None else "does not hold"
        return self.failed(f"{self._condition.text} {why}")


class _ScriptNode(_Leaf):
    """Runs a program of the host, which ends with the node."""

    def __init__(self, script: Script, context: MissionContext) -> None:
        super().__init__(f"running {script.run}", context)
        self._script = script
        self._running: Run | None = None

    def initialise(self) -> None:
        self._running = self.context.start(self._script)

    def update(self) -> Status:
        self.context.doing = self.name
        result = self._running.result if self._running else None
        if result is None:
            return Status.RUNNING
        return Status.SUCCESS if result[0] else self.failed(f"{self._script.run} {result[1]}")

    def terminate(self, new_status: Status) -> None:
        if self._running:
            self._running.stop()
            self._running = None


class _TimeoutNode(Decorator):
    """Fails if its child takes longer than some seconds of the robot's time.

    The clock stops while the gate or an operator holds the body.
    """

    def __init__(self, child: Behaviour, seconds: float, context: MissionContext) -> None:
        super().__init__(f"at most {seconds:g} s", child)
        self._seconds, self._context, self.began_s = seconds, context, 0.0

    def initialise(self) -> None:
        self.began_s = self._context.free_s

    def update(self) -> Status:
        too_long = self._context.free_s - self.began_s > self._seconds
        if self.decorated.status is Status.RUNNING and too_long:
            outcome = self._context.outcome
            why = f": {outcome.reason}" if outcome and outcome.reason else ""
            problem = f"{self._context.doing}: not done within {self._seconds:g} s"
            self._context.problem = problem + why
            self._context.command = None
            return Status.FAILURE
        return self.decorated.status


class _GuardNode(Behaviour):
    """Ticks `then` to its end whenever a condition holds, otherwise `do`, which then continues."""

    def __init__(
        self, condition: Condition, then: Behaviour, do: Behaviour, context: MissionContext
    ) -> None:
        super().__init__(f"while not {condition.text}")
        self._condition, self._context = condition, context
        self._then, self._do, self.interrupted = then, do, False
        for child in (then, do):
            child.parent = self
            self.children.append(child)

    def tick(self) -> Iterator[Behaviour]:
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
        return self.status  # of the last `tick`

    def _resume(self) -> Status:
        """Continue with `do` after `then`; fail if the condition still holds."""
        self.interrupted = False
        if self._condition.holds(self._context.read):
            self._context.problem = f"{self._condition.text} still holds after the remedy"
            return Status.FAILURE
        return Status.RUNNING

    def stop(self, new_status: Status) -> None:
        for child in self.children:
            if child.status is Status.RUNNING or new_status is Status.INVALID:
                child.stop(Status.INVALID)
        super().stop(new_status)


class TreeBuilder:
    """Builds the nodes of one mission, which share one context."""

    def __init__(self, mission: Mission, context: MissionContext) -> None:
        self._mission, self._context = mission, context
        context.things = dict(mission.things)

    def tree(self) -> Behaviour:
        """Return the root of the whole mission."""
        return self._sequence(self._mission.do)

    def _sequence(self, steps: tuple[Step, ...]) -> Behaviour:
        if len(steps) == 1:
            return self._node(steps[0])
        return Sequence("sequence", memory=True, children=[self._node(step) for step in steps])

    def _node(self, step: Step) -> Behaviour:
        leaf = self._leaf(step)
        if leaf:
            return leaf
        if step.patrol:
            return self._patrol(step.patrol)
        if step.tree is not None:
            return self._sequence(self._mission.trees[step.tree])
        if step.sequence:
            return self._sequence(step.sequence)
        if step.fallback:
            children = [self._node(inner) for inner in step.fallback]
            return Selector("fallback", memory=True, children=children)
        return self._decorated(step)

    def _leaf(self, step: Step) -> Behaviour | None:
        context = self._context
        if step.goto is not None:
            return self._go_to(step.goto)
        if step.find is not None:
            return _SeekNode(step.find if isinstance(step.find, str) else step.find.tag, context)
        if step.arm:
            return _ArmNode(step.arm, context)
        if step.explore or step.visit:
            return _DriveNode("explore" if step.explore else "visit", context)
        if step.wait is not None:
            return _WaitNode(step.wait, context)
        if step.wait_until is not None:
            return _ConditionNode(parse(step.wait_until), context, waits=True)
        if step.check is not None:
            return _ConditionNode(parse(step.check), context, waits=False)
        return _ScriptNode(step.script, context) if step.script else None

    def _decorated(self, step: Step) -> Behaviour:
        if step.retry:
            child = self._sequence(step.retry.do)
            return Retry(f"up to {step.retry.times} times", child, step.retry.times)
        if step.repeat:
            return _repeated(self._sequence(step.repeat.do), step.repeat.times)
        if step.timeout:
            child = self._sequence(step.timeout.do)
            return _TimeoutNode(child, step.timeout.seconds, self._context)
        if step.guard:
            then, do = self._sequence(step.guard.then), self._sequence(step.guard.do)
            return _GuardNode(parse(step.guard.when), then, do, self._context)
        assert step.battery_below
        return self._battery(step.battery_below)

    def _battery(self, low: BatteryBelow) -> Behaviour:
        then = self._go_to(low.goto)
        if low.until is not None:
            charged = parse(f"battery.percentage >= {low.until:g}")
            wait = _ConditionNode(charged, self._context, waits=True)
            then = Sequence("charge", memory=True, children=[then, wait])
        when = parse(f"battery.percentage < {low.percentage:g}")
        return _GuardNode(when, then, self._sequence(low.do), self._context)

    def _patrol(self, patrol: Patrol) -> Behaviour:
        children: list[Behaviour] = []
        for place in patrol.points:
            children.append(self._go_to(place))
            if patrol.wait:
                children.append(_WaitNode(patrol.wait, self._context))
        return _repeated(Sequence("round", memory=True, children=children), patrol.loops)

    def _go_to(self, place: Place) -> Behaviour:
        if isinstance(place, AtTag):
            return _SeekNode(place.tag, self._context)
        name = place if isinstance(place, str) else ""
        return _DriveNode("goto", self._context, self._mission.goal(place), name)


def _repeated(child: Behaviour, times: int | None) -> Behaviour:
    return Repeat("for ever" if times is None else f"{times} times", child, times or FOREVER)


def progress_of(root: Behaviour, free_s: float) -> Progress:
    """Return how far the running nodes below `root` have come; leaves have no progress."""
    progress: Progress = {}
    for number, node in enumerate(_nodes(root)):
        if node.status is not Status.RUNNING:
            continue
        if isinstance(node, Sequence | Selector) and node.current_child:
            progress[str(number)] = node.children.index(node.current_child)
        elif isinstance(node, Retry):
            progress[str(number)] = node.failures
        elif isinstance(node, Repeat):
            progress[str(number)] = node.success
        elif isinstance(node, _TimeoutNode):
            progress[str(number)] = round(free_s - node.began_s, -1)  # coarse: each change is saved
        elif isinstance(node, _GuardNode):
            progress[str(number)] = node.interrupted
    return progress


def restore(root: Behaviour, progress: Progress) -> None:
    """Let the nodes below `root` continue from `progress`; leaves start again."""
    for number, node in enumerate(_nodes(root)):
        if str(number) not in progress:
            continue
        value = progress[str(number)]
        if isinstance(node, Sequence | Selector):
            node.current_child = node.children[min(int(value), len(node.children) - 1)]
        elif isinstance(node, Retry):
            node.failures = int(value)
        elif isinstance(node, Repeat):
            node.success = int(value)
        elif isinstance(node, _TimeoutNode):
            node.began_s = -value
        elif isinstance(node, _GuardNode):
            node.interrupted = bool(value)
        else:
            continue
        node.status = Status.RUNNING


def _nodes(root: Behaviour) -> list[Behaviour]:
    """Return `root` and all nodes below it, depth first."""
    return [root, *(node for child in root.children for node in _nodes(child))]
