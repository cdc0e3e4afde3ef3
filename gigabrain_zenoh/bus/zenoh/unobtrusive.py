"""Reduces the load of processes that only observe the robot, by waking up less often.

A thread that wakes for each message runs with cold caches, which costs more than the message
itself. It also takes the processor from the robot 300 times a second.
"""

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

NAP_S = 0.04
LONGEST_S = 0.06  # upper bound of the delay of a message that arrives during a nap
IDLE_S = 0.0003  # since the last message; after that the receiving thread counts as idle


class Nap:
    """Sleeps in the receiving thread, while the kernel's buffer collects messages.

    The thread sleeps only after a message that found it idle. Collected messages are thus processed
    in one batch, and during a flood the thread never sleeps.
    """

    def __init__(
        self,
        nap_s: float,
        now_s: Callable[[], float] = time.monotonic,
        sleep_s: Callable[[float], None] = time.sleep,
    ) -> None:
        self._nap_s, self._now_s, self._sleep_s = nap_s, now_s, sleep_s
        self._done_s = now_s()

    def after_each(self, take: Callable[[T], None]) -> Callable[[T], None]:
        """Wrap `take` for the receiving thread: nap after a call that found the thread idle."""

        def take_and_nap(sample: T) -> None:
            idle_s = self._now_s() - self._done_s
            take(sample)
            if idle_s > IDLE_S:
                self._sleep_s(self._nap_s)
            self._done_s = self._now_s()

        return take_and_nap
