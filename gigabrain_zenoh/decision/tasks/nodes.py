"""The nodes that a mission is made of beside py-trees' own. They keep the robot's time."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.decorators import Decorator

from gigabrain_zenoh.decision.tasks.orders import Explore, GoTo, Order, Visit, where

if TYPE_CHECKING:
    from gigabrain_schemas.tasks import Goal
    from gigabrain_zenoh.decision.tasks.conditions import Condition
    from gigabrain_zenoh.decision.tasks.mission import Script
    from gigabrain_zenoh.decision.tasks.moment import Moment, Running


class Leaf(Behaviour):
    """A node without others below it."""

    def __init__(self, name: str, moment: "Moment") -> None:
        super().__init__(name)
        self.moment = moment

    def failed(self, why: str) -> Status:
        """A failure, with its reason for people."""
        self.moment.problem = why
        return Status.FAILURE


class Drive(Leaf):
    """Gives an order to whoever drives, and waits for what becomes of it."""

    def __init__(
        self, name: str, moment: "Moment", order: Callable[[int], Order], place: str = ""
    ) -> None:
        super().__init__(name, moment)
        self._make, self._order = order, order(0)
        self._whose = f"{place}: " if place else ""

    def initialise(self) -> None:
        """A new order."""
        self._order = self._make(next(self.moment.numbers))

    def update(self) -> Status:
        """Whether it is carried out."""
        outcome, self.moment.doing = self.moment.outcome, self.name
        if outcome and outcome.number == self._order.number and outcome.state != "running":
            done = outcome.state == "done"
            return Status.SUCCESS if done else self.failed(self._whose + outcome.reason)
        self.moment.order = self._order
        return Status.RUNNING


def go_to(goal: "Goal", name: str, moment: "Moment") -> Drive:
    """Be at a place; `name` is what people call it."""
    doing = f"going to {name or where(goal)}"
    return Drive(doing, moment, lambda number: GoTo(number, goal), name)


def explore(moment: "Moment") -> Drive:
    """See all that there is."""
    return Drive("exploring", moment, Explore)


def visit(moment: "Moment") -> Drive:
    """Be somewhere else."""
    return Drive("visiting a place", moment, Visit)


class Wait(Leaf):
    """Succeeds after some seconds of the robot's time."""

    def __init__(self, seconds: float, moment: "Moment") -> None:
        super().__init__(f"waiting {seconds:g} s", moment)
        self._seconds, self._until_s = seconds, 0.0

    def initialise(self) -> None:
        """It begins now."""
        self._until_s = self.moment.now_s + self._seconds

    def update(self) -> Status:
        """Whether the time is over."""
        left_s = self._until_s - self.moment.now_s
        if left_s <= 1e-9:
            return Status.SUCCESS
        self.moment.doing, self.moment.left_s = self.name, left_s
        self.moment.progress = 1.0 - left_s / self._seconds
        return Status.RUNNING


class WaitUntil(Leaf):
    """Succeeds once a condition holds. What is not known does not hold."""

    def __init__(self, condition: "Condition", moment: "Moment") -> None:
        super().__init__(f"waiting until {condition.text}", moment)
        self._condition = condition

    def update(self) -> Status:
        """Whether it holds."""
        self.moment.doing = self.name
        return Status.SUCCESS if self._condition.holds(self.moment.read) else Status.RUNNING


class Check(Leaf):
    """Succeeds where a condition holds, and fails where it does not or where that is not known."""

    def __init__(self, condition: "Condition", moment: "Moment") -> None:
        super().__init__(f"checking {condition.text}", moment)
        self._condition = condition

    def update(self) -> Status:
        """Whether it holds."""
        self.moment.doing = self.name
        holds = self._condition.holds(self.moment.read)
        if holds:
            return Status.SUCCESS
        why = "is not known" if holds is None else "does not hold"
        return self.failed(f"{self._condition.text} {why}")


class RunScript(Leaf):
    """Runs a program of the host, and ends it with itself."""

    def __init__(self, script: "Script", moment: "Moment") -> None:
        super().__init__(f"running {script.run}", moment)
        self._script = script
        self._running: Running | None = None

    def initialise(self) -> None:
        """Start it."""
        self._running = self.moment.start(self._script)

    def update(self) -> Status:
        """What it came to."""
        self.moment.doing = self.name
        result = self._running.result if self._running else None
        if result is None:
            return Status.RUNNING
        return Status.SUCCESS if result[0] else self.failed(f"{self._script.run} {result[1]}")

    def terminate(self, new_status: Status) -> None:
        """It must not outlive its step."""
        if self._running:
            self._running.stop()
            self._running = None


class Timeout(Decorator):
    """Fails when what is below takes longer than some seconds of the robot's time.

    The clock stands while the gate or an operator holds the body.
    """

    def __init__(self, child: Behaviour, seconds: float, moment: "Moment") -> None:
        super().__init__(f"at most {seconds:g} s", child)
        self._seconds, self._moment, self.began_s = seconds, moment, 0.0

    def initialise(self) -> None:
        """It begins now."""
        self.began_s = self._moment.free_s

    def update(self) -> Status:
        """As below, or a failure when it is late."""
        too_long = self._moment.free_s - self.began_s > self._seconds
        if self.decorated.status is Status.RUNNING and too_long:
            outcome = self._moment.outcome
            why = f": {outcome.reason}" if outcome and outcome.reason else ""
            problem = f"{self._moment.doing}: not done within {self._seconds:g} s"
            self._moment.problem = problem + why
            self._moment.order = None
            return Status.FAILURE
        return self.decorated.status


class Guard(Behaviour):
    """Ticks `then` whenever a condition holds, to its end; else `do`, which goes on as it was."""

    def __init__(
        self, condition: "Condition", then: Behaviour, do: Behaviour, moment: "Moment"
    ) -> None:
        super().__init__(f"while not {condition.text}")
        self._condition, self._moment = condition, moment
        self._then, self._do, self.interrupted = then, do, False
        for child in (then, do):
            child.parent = self
            self.children.append(child)

    def tick(self) -> Iterator[Behaviour]:
        """One of the two children."""
        if self.status is not Status.RUNNING:
            self.interrupted = False
        if not self.interrupted and self._condition.holds(self._moment.read):
            self.interrupted = True
        child = self._then if self.interrupted else self._do
        yield from child.tick()
        status = child.status
        if self.interrupted and status is Status.SUCCESS:
            status = self._afterwards()
        if status is not Status.RUNNING:
            self.stop(status)
        self.status = status
        yield self

    def update(self) -> Status:
        """What the last tick came to: `tick` does the work."""
        return self.status

    def _afterwards(self) -> Status:
        """`then` has succeeded: on with `do`, unless nothing is better for it."""
        self.interrupted = False
        if self._condition.holds(self._moment.read):
            self._moment.problem = f"{self._condition.text} still holds after what is done about it"
            return Status.FAILURE
        return Status.RUNNING

    def stop(self, new_status: Status) -> None:
        """Neither child goes on without it."""
        for child in self.children:
            if child.status is Status.RUNNING or new_status is Status.INVALID:
                child.stop(Status.INVALID)
        super().stop(new_status)
