"""Bounded mailbox that carries the newest samples of one subscription to the event loop."""

from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from gigabrain_zenoh.bus.bridge import Bridge

T = TypeVar("T")


SPARE = 8  # samples kept at depth 1, of which the newest readable one is delivered


class Mailbox(Generic[T]):
    """Queue of at most `depth` samples for a busy event loop; new samples replace the oldest.

    With `depth` 1, only the newest readable sample is delivered. A sample is unreadable if
    `on_sample` returns False. The mailbox keeps a few spares, so that invalid samples do not
    displace a valid one.
    """

    def __init__(self, bridge: Bridge, on_sample: Callable[[T], bool | None], depth: int) -> None:
        self._bridge, self._on_sample = bridge, on_sample
        self._newest_only = depth == 1
        self._samples: deque[T] = deque(maxlen=SPARE if self._newest_only else depth)
        self._posted = False

    def put(self, sample: T) -> None:
        """Store a sample and wake the event loop. Never blocks; may be called from any thread."""
        self._samples.append(sample)
        if not self._posted:
            self._posted = True
            self._bridge.post(Mailbox._deliver, self)

    def _deliver(self) -> None:
        self._posted = False  # before emptying, so that samples arriving from now on post again
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
