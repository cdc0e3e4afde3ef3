"""A mission's steps become py-trees nodes; and how far they have come, to go on after a restart."""

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Selector, Sequence
from py_trees.decorators import Repeat, Retry

from gigabrain_zenoh.decision.tasks import nodes
from gigabrain_zenoh.decision.tasks.conditions import parse
from gigabrain_zenoh.decision.tasks.mission import BatteryBelow, Mission, Patrol, Place, Step
from gigabrain_zenoh.decision.tasks.moment import Moment

FOR_EVER = -1  # as py-trees counts
Memory = dict[str, float]  # of each node that is at work, by its number from the top


class Grower:
    """Makes the nodes of one mission, which all go by one moment."""

    def __init__(self, mission: Mission, moment: Moment) -> None:
        self._mission, self._moment = mission, moment

    def tree(self) -> Behaviour:
        """The whole mission."""
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
        moment = self._moment
        if step.goto is not None:
            return self._go_to(step.goto)
        if step.explore:
            return nodes.explore(moment)
        if step.visit:
            return nodes.visit(moment)
        if step.wait is not None:
            return nodes.Wait(step.wait, moment)
        if step.wait_until is not None:
            return nodes.WaitUntil(parse(step.wait_until), moment)
        if step.check is not None:
            return nodes.Check(parse(step.check), moment)
        return nodes.RunScript(step.script, moment) if step.script else None

    def _decorated(self, step: Step) -> Behaviour:
        if step.retry:
            child = self._sequence(step.retry.do)
            return Retry(f"up to {step.retry.times} times", child, step.retry.times)
        if step.repeat:
            return _repeated(self._sequence(step.repeat.do), step.repeat.times)
        if step.timeout:
            child = self._sequence(step.timeout.do)
            return nodes.Timeout(child, step.timeout.seconds, self._moment)
        if step.guard:
            then, do = self._sequence(step.guard.then), self._sequence(step.guard.do)
            return nodes.Guard(parse(step.guard.when), then, do, self._moment)
        assert step.battery_below
        return self._battery(step.battery_below)

    def _battery(self, low: BatteryBelow) -> Behaviour:
        then = self._go_to(low.goto)
        if low.until is not None:
            charged = parse(f"battery.percentage >= {low.until:g}")
            wait = nodes.WaitUntil(charged, self._moment)
            then = Sequence("charge", memory=True, children=[then, wait])
        when = parse(f"battery.percentage < {low.percentage:g}")
        return nodes.Guard(when, then, self._sequence(low.do), self._moment)

    def _patrol(self, patrol: Patrol) -> Behaviour:
        round_: list[Behaviour] = []
        for place in patrol.points:
            round_.append(self._go_to(place))
            if patrol.wait:
                round_.append(nodes.Wait(patrol.wait, self._moment))
        return _repeated(Sequence("round", memory=True, children=round_), patrol.loops)

    def _go_to(self, place: Place) -> Behaviour:
        name = place if isinstance(place, str) else ""
        return nodes.go_to(self._mission.goal(place), name, self._moment)


def _repeated(child: Behaviour, times: int | None) -> Behaviour:
    return Repeat("for ever" if times is None else f"{times} times", child, times or FOR_EVER)


def remembered(root: Behaviour, free_s: float) -> Memory:
    """How far the nodes below `root` have come, apart from what the leaves are at."""
    memory: Memory = {}
    for number, node in enumerate(_nodes(root)):
        if node.status is not Status.RUNNING:
            continue
        if isinstance(node, Sequence | Selector) and node.current_child:
            memory[str(number)] = node.children.index(node.current_child)
        elif isinstance(node, Retry):
            memory[str(number)] = node.failures
        elif isinstance(node, Repeat):
            memory[str(number)] = node.success
        elif isinstance(node, nodes.Timeout):
            memory[str(number)] = round(free_s - node.began_s, -1)  # seldom another: it is written
        elif isinstance(node, nodes.Guard):
            memory[str(number)] = node.interrupted
    return memory


def restore(root: Behaviour, memory: Memory) -> None:
    """Have the nodes below `root` go on from there; leaves begin anew."""
    for number, node in enumerate(_nodes(root)):
        if str(number) not in memory:
            continue
        value = memory[str(number)]
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
    """The node and all below it, in the order of the file."""
    return [root, *(node for child in root.children for node in _nodes(child))]
