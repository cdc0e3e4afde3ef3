"""What the nodes of a mission go by while they are ticked, and where they leave what they want."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from gigabrain_zenoh.decision.tasks.conditions import Read
from gigabrain_zenoh.decision.tasks.mission import Script
from gigabrain_zenoh.decision.tasks.orders import Order, Outcome


class Running(Protocol):
    """A program of the host that was started."""

    @property
    def result(self) -> tuple[bool, str] | None:
        """Whether it went well and what it came to, in words; None while it runs."""
        ...

    def stop(self) -> None:
        """End it, if it still runs."""
        ...


Start = Callable[[Script], Running]


@dataclass
class Moment:
    """One tick as the nodes see it. Time passes only while the mission is being carried out."""

    read: Read
    start: Start
    numbers: Iterator[int]  # of orders, none of them twice
    now_s: float = 0.0
    held_s: float = 0.0  # of that, while the body did not follow an order
    outcome: Outcome | None = None  # of the order of the tick before
    order: Order | None = None  # what the node that is at work wants
    doing: str = ""  # what it is at, in words
    problem: str = ""  # what went wrong last, in words
    progress: float | None = None  # of a step that is not driving
    left_s: float | None = None  # until such a step is done, where that is known

    @property
    def free_s(self) -> float:
        """How long the mission has been carried out while nobody held the body."""
        return self.now_s - self.held_s

    def begin(self, seconds: float, outcome: Outcome | None) -> None:
        """The next tick, `seconds` after the last."""
        self.now_s += seconds
        if outcome and outcome.held:
            self.held_s += seconds
        self.outcome, self.order, self.doing = outcome, None, ""
        self.progress = self.left_s = None
