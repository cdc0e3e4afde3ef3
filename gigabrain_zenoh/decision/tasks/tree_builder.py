"""Builds the py-trees tree of a mission, and saves and restores how far it has come."""

from typing import Annotated, Literal

from msgspec import Meta, Struct
from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Selector, Sequence
from py_trees.decorators import Repeat, Retry

from gigabrain_schemas.tasks import Task, TaskState
from gigabrain_zenoh.decision.tasks import tree_nodes as nodes
from gigabrain_zenoh.decision.tasks.conditions import parse
from gigabrain_zenoh.decision.tasks.drive_command import Outcome
from gigabrain_zenoh.decision.tasks.mission import BatteryBelow, Mission, Patrol, Place, Step
from gigabrain_zenoh.decision.tasks.tree_nodes import MissionContext

FOREVER = -1  # for py-trees
Index = Annotated[float, Meta(ge=0, le=1e9)]
Progress = dict[str, Index]  # of each running node, by its number in depth-first order


class TreeBuilder:
    """Builds the nodes of one mission, which share one context."""

    def __init__(self, mission: Mission, context: MissionContext) -> None:
        self._mission, self._context = mission, context

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
        if step.explore or step.visit:
            return nodes.Drive("explore" if step.explore else "visit", context)
        if step.wait is not None:
            return nodes.Wait(step.wait, context)
        if step.wait_until is not None:
            return nodes.WaitUntil(parse(step.wait_until), context)
        if step.check is not None:
            return nodes.Check(parse(step.check), context)
        return nodes.RunScript(step.script, context) if step.script else None

    def _decorated(self, step: Step) -> Behaviour:
        if step.retry:
            child = self._sequence(step.retry.do)
            return Retry(f"up to {step.retry.times} times", child, step.retry.times)
        if step.repeat:
            return _repeated(self._sequence(step.repeat.do), step.repeat.times)
        if step.timeout:
            child = self._sequence(step.timeout.do)
            return nodes.Timeout(child, step.timeout.seconds, self._context)
        if step.guard:
            then, do = self._sequence(step.guard.then), self._sequence(step.guard.do)
            return nodes.Guard(parse(step.guard.when), then, do, self._context)
        assert step.battery_below
        return self._battery(step.battery_below)

    def _battery(self, low: BatteryBelow) -> Behaviour:
        then = self._go_to(low.goto)
        if low.until is not None:
            charged = parse(f"battery.percentage >= {low.until:g}")
            wait = nodes.WaitUntil(charged, self._context)
            then = Sequence("charge", memory=True, children=[then, wait])
        when = parse(f"battery.percentage < {low.percentage:g}")
        return nodes.Guard(when, then, self._sequence(low.do), self._context)

    def _patrol(self, patrol: Patrol) -> Behaviour:
        children: list[Behaviour] = []
        for place in patrol.points:
            children.append(self._go_to(place))
            if patrol.wait:
                children.append(nodes.Wait(patrol.wait, self._context))
        return _repeated(Sequence("round", memory=True, children=children), patrol.loops)

    def _go_to(self, place: Place) -> Behaviour:
        name = place if isinstance(place, str) else ""
        return nodes.Drive("goto", self._context, self._mission.goal(place), name)


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
        elif isinstance(node, nodes.Timeout):
            progress[str(number)] = round(free_s - node.began_s, -1)  # coarse: each change is saved
        elif isinstance(node, nodes.Guard):
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
        elif isinstance(node, nodes.Timeout):
            node.began_s = -value
        elif isinstance(node, nodes.Guard):
            node.interrupted = bool(value)
        else:
            continue
        node.status = Status.RUNNING


def _nodes(root: Behaviour) -> list[Behaviour]:
    """Return `root` and all nodes below it, depth first."""
    return [root, *(node for child in root.children for node in _nodes(child))]


class SavedJob(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A task as the file holds it."""

    id: str
    kind: Literal["goal", "mission"]
    label: str
    source: str
    mission: str  # as JSON, which is YAML too
    held: bool = False
    memory: Progress = {}


class Job:
    """A task with the tree of its mission. A goal is a mission of one step."""

    def __init__(self, saved: SavedJob, mission: Mission, context: MissionContext) -> None:
        self._saved, self.context = saved, context
        self.id, self.held = saved.id, saved.held  # held: paused by a person
        self.begun = bool(saved.memory)
        self.why_held = ""
        self._root = TreeBuilder(mission, context).tree()
        restore(self._root, saved.memory)

    def step(self, seconds: float, outcome: Outcome | None) -> Status:
        """Tick the tree once, `seconds` after the last tick."""
        self.context.begin(seconds if self.begun else 0.0, outcome)
        self.begun = True
        self._root.tick_once()
        return self._root.status

    def stop(self) -> None:
        """Stop all nodes."""
        self._root.stop(Status.INVALID)

    @property
    def saved(self) -> SavedJob:
        """The part that survives a restart."""
        return SavedJob(
            id=self.id, kind=self._saved.kind, label=self._saved.label, source=self._saved.source,
            mission=self._saved.mission, held=self.held,
            memory=progress_of(self._root, self.context.free_s),
        )  # fmt: skip

    def task(self, state: TaskState, reason: str = "", outcome: Outcome | None = None) -> Task:
        """Return the task as published; a goal that has ended has its errors from `outcome`."""
        saved = self._saved
        measured = outcome if saved.kind == "goal" else None
        return Task(
            id=self.id, kind=saved.kind, label=saved.label[:64], source=saved.source[:64],
            state=state, reason=reason[:500],
            position_error=measured.position_error if measured else None,
            heading_error=measured.heading_error if measured else None,
        )  # fmt: skip
