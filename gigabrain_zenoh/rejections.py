"""What was dropped because it was not valid: counted, and told once when it begins and ends."""

import logging
from collections import Counter

from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

QUIET_NS = 1_000_000_000  # a fault has ended when nothing bad has come for this long


class Rejections:
    """Dropped messages by key."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._faults: dict[str, tuple[Fault, int]] = {}  # with the time of the last bad message
        self.counts: Counter[str] = Counter()

    def reject(self, key: str, error: ValueError) -> None:
        """A message on `key` was not valid."""
        self.counts[key] += 1
        fault, _ = self._faults.get(key, (Fault(log), 0))
        self._faults[key] = fault, self._clock.now_ns()
        about = {"event": "rejected", "key": key}
        fault.begin(f"dropped a message on {key}: {error}", about)

    def accept(self, key: str) -> None:
        """A message on `key` was valid. With a good and a bad sender on it the fault goes on."""
        if key not in self._faults:
            return
        fault, last_ns = self._faults[key]
        if self._clock.now_ns() - last_ns >= QUIET_NS:
            del self._faults[key]
            fault.end(f"{key} is valid again")
