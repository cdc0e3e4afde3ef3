"""Whether a body that reports by itself is heard on its line."""

import logging

from gigabrain_drivers.links.link import Link
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.logs import Fault

PATIENCE_NS = 500_000_000  # without a word from the body, before something is said about it


class Hearing:
    """Keeps when the body was heard last; says once that it is not, and once that it is again.

    `silent_ns` without a word, and it counts as lost. `senseless` is what to say where the line
    itself is in order. What is wrong for a moment only, the gate says.
    """

    def __init__(
        self, link: Link, clock: Clock, silent_ns: int, senseless: str, log: logging.Logger
    ) -> None:
        self._link, self._clock = link, clock
        self._silent_ns, self._senseless = silent_ns, senseless
        self._heard_ns: int | None = None  # None since the line was opened or lost
        self._hoping_ns = clock.now_ns()  # since when there is nothing
        self._fault = Fault(log)

    @property
    def heard(self) -> bool:
        """Whether there was a word since the line was opened."""
        return self._heard_ns is not None

    def hear(self) -> bool:
        """A word has come; whether it is the first on this line."""
        first, self._heard_ns = self._heard_ns is None, self._clock.now_ns()
        return first

    def forget(self) -> None:
        """The line is lost, or new: nothing from before counts."""
        if self._heard_ns is not None:
            self._heard_ns, self._hoping_ns = None, self._clock.now_ns()

    def alive(self) -> bool:
        """Whether the body has been heard lately."""
        silent_ns = self._clock.now_ns() - (self._heard_ns or self._hoping_ns)
        alive = self._heard_ns is not None and silent_ns <= self._silent_ns
        if alive:
            self._fault.end(f"{self._link}: heard again")
        elif silent_ns > PATIENCE_NS:
            self._fault.begin(self._problem())
        return alive

    def _problem(self) -> str:
        problem, name = self._link.problem or self._senseless, str(self._link)
        return problem if name in problem else f"{name}: {problem}"
