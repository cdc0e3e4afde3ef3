"""Behaviour trees of missions: own py-trees nodes, the builder, and the saved progress.

All nodes use the robot's time.
"""

from collections.abc import Iterator
from typing import Annotated

from msgspec import Meta
from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Selector, Sequence
from py_trees.decorators import Decorator, Repeat, Retry

from gigabrain_zenoh.decision.tasks.arm_steps import Gripper, HandOver, Pick, TakePosture
from gigabrain_zenoh.decision.tasks.conditions import Condition, parse
from gigabrain_zenoh.decision.tasks.leaves import (
    ArmNode,
    ConditionNode,
    DriveNode,
    MissionContext,
    OfferNode,
    PickNode,
    ScriptNode,
    SeekNode,
    WaitNode,
)
from gigabrain_zenoh.decision.tasks.mission import (
    AtTag,
    BatteryBelow,
    Mission,
    Patrol,
    Place,
    Step,
)

FOREVER = -1  # for py-trees
HAND_AWAY_S = 1.5  # for a person to withdraw the hand, once the gripper is open
Index = Annotated[float, Meta(ge=0, le=1e9)]
Progress = dict[str, Index]  # state of each running node, by its number in depth-first order


class _TimeoutNode(Decorator):
    """Fails if its child takes longer than `seconds` of the robot's time.

    The timer stops while the gate or an operator holds the body, and while a guard around it runs
    its `then`.
    """

    def __init__(self, child: Behaviour, seconds: float, context: MissionContext) -> None:
        super().__init__(f"at most {seconds:g} s", child)
        self._seconds, self._context, self.began_s = seconds, context, 0.0

    def initialise(self) -> None:
        self.began_s = self._context.free_s

    def delay(self, seconds: float) -> None:
        """Exclude `seconds` of the elapsed time."""
        self.began_s += seconds

    def update(self) -> Status:
        timed_out = self._context.free_s - self.began_s > self._seconds
        if self.decorated.status is Status.RUNNING and timed_out:
            outcome = self._context.outcome
            why = f": {outcome.reason}" if outcome and outcome.reason else ""
            problem = f"{self._context.doing}: not done within {self._seconds:g} s"
            self._context.problem = problem + why
            self._context.command = None
            return Status.FAILURE
        return self.decorated.status


class _GuardNode(Behaviour):
    """Ticks `do`; whenever a condition holds, ticks `then` to its end first."""

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
        if self.interrupted:
            self._delay()
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

    def _delay(self) -> None:
        """Stop the timers in `do` for the current tick."""
        for node in _nodes(self._do):
            if isinstance(node, _TimeoutNode | OfferNode):
                node.delay(self._context.passed_s)

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
        context.given, context.things = mission.things, dict(mission.things)

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
            return SeekNode(step.find if isinstance(step.find, str) else step.find.tag, context)
        if isinstance(step.arm, Pick):
            return PickNode(step.arm, context)
        if isinstance(step.arm, HandOver):
            return self._hand_over(step.arm)
        if step.arm:
            return ArmNode(step.arm, context)
        if step.explore or step.visit:
            return DriveNode("explore" if step.explore else "visit", context)
        if step.wait is not None:
            return WaitNode(step.wait, context)
        if step.wait_until is not None:
            return ConditionNode(parse(step.wait_until), context, waits=True)
        if step.check is not None:
            return ConditionNode(parse(step.check), context, waits=False)
        return ScriptNode(step.script, context) if step.script else None

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
            wait = ConditionNode(charged, self._context, waits=True)
            then = Sequence("charge", memory=True, children=[then, wait])
        when = parse(f"battery.percentage < {low.percentage:g}")
        return _GuardNode(when, then, self._sequence(low.do), self._context)

    def _hand_over(self, do: HandOver) -> Behaviour:
        context = self._context
        children = [
            ArmNode(do, context),
            OfferNode(do.seconds, context),
            ArmNode(Gripper("open"), context),
            WaitNode(HAND_AWAY_S, context),
            ArmNode(TakePosture("home"), context),
        ]
        return Sequence("hand over", memory=True, children=children)

    def _patrol(self, patrol: Patrol) -> Behaviour:
        children: list[Behaviour] = []
        for place in patrol.points:
            children.append(self._go_to(place))
            if patrol.wait:
                children.append(WaitNode(patrol.wait, self._context))
        return _repeated(Sequence("round", memory=True, children=children), patrol.loops)

    def _go_to(self, place: Place) -> Behaviour:
        if isinstance(place, AtTag):
            return SeekNode(place.tag, self._context)
        name = place if isinstance(place, str) else ""
        return DriveNode("goto", self._context, self._mission.goal(place), name)


def _repeated(child: Behaviour, times: int | None) -> Behaviour:
    return Repeat("for ever" if times is None else f"{times} times", child, times or FOREVER)


def progress_of(root: Behaviour, free_s: float) -> Progress:
    """Return the progress of the running nodes below `root`; leaves have none."""
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
    """Restore the nodes below `root` from `progress`; leaves start again."""
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
