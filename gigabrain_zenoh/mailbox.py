"""The newest samples of one subscription, on their way to the loop."""

from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from gigabrain_zenoh.bridge import Bridge

T = TypeVar("T")


class Mailbox(Generic[T]):
    """Holds `depth` samples while the loop is busy; the oldest give way to newer ones."""

    def __init__(self, bridge: Bridge, on_sample: Callable[[T], None], depth: int) -> None:
        self._bridge, self._on_sample = bridge, on_sample
        self._samples: deque[T] = deque(maxlen=depth)
        self._posted = False

    def put(self, sample: T) -> None:
        """Take a sample. From any thread; never blocks."""
        self._samples.append(sample)
        if not self._posted:
            self._posted = True
            self._bridge.post(Mailbox._deliver, self)

    def _deliver(self) -> None:
        self._posted = False  # before emptying: what comes now is posted again
        for _ in range(len(self._samples)):
            self._on_sample(self._samples.popleft())
