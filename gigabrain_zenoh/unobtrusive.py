"""How those who only look on disturb the robot least: few wake-ups.

A thread that wakes for each message does so with cold caches, which costs more than the message
itself, and takes the processor from the robot three hundred times a second.
"""

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

NAP_S = 0.04
LONGEST_S = 0.06  # until a message is taken that came while the thread slept, and a little more
IDLE_S = 0.0003  # since the last message: the thread that receives had nothing to do


class Nap:
    """Sleeps in the thread that receives; meanwhile the kernel's buffer takes what comes.

    Only a message that found the thread idle is slept after. So what has gathered is taken in one
    go, and a flood finds a thread that never sleeps.
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
        """`take` for the thread that receives, with a nap behind it where there is time for one."""

        def take_and_nap(sample: T) -> None:
            idle_s = self._now_s() - self._done_s
            take(sample)
            if idle_s > IDLE_S:
                self._sleep_s(self._nap_s)
            self._done_s = self._now_s()

        return take_and_nap
