"""The newest samples of one subscription, on their way to the loop."""

from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from gigabrain_zenoh.bridge import Bridge

T = TypeVar("T")


SPARE = 8  # samples from which the newest that can be read is taken


class Mailbox(Generic[T]):
    """Holds `depth` samples while the loop is busy; the oldest give way to newer ones.

    Where only the newest counts it is the newest that can be read (`on_sample` does not say False):
    whoever sends nonsense must not push out what is good.
    """

    def __init__(self, bridge: Bridge, on_sample: Callable[[T], bool | None], depth: int) -> None:
        self._bridge, self._on_sample = bridge, on_sample
        self._newest_only = depth == 1
        self._samples: deque[T] = deque(maxlen=SPARE if self._newest_only else depth)
        self._posted = False

    def put(self, sample: T) -> None:
        """Take a sample. From any thread; never blocks."""
        self._samples.append(sample)
        if not self._posted:
            self._posted = True
            self._bridge.post(Mailbox._deliver, self)

    def _deliver(self) -> None:
        self._posted = False  # before emptying: what comes now is posted again
        if self._newest_only:
            self._deliver_newest()
            return
        for _ in range(len(self._samples)):
            self._on_sample(self._samples.popleft())

    def _deliver_newest(self) -> None:
        waiting = [self._samples.popleft() for _ in range(len(self._samples))]
        for sample in reversed(waiting):
            if self._on_sample(sample) is not False:
                break
