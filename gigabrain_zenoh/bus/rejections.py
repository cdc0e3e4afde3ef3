"""Counts dropped invalid messages, and logs once when such a fault begins and ends."""

import logging
from collections import Counter

from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

QUIET_NS = 1_000_000_000  # a fault ends after this long without an invalid message


class Rejections:
    """Counts and faults of dropped messages, by key."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._faults: dict[str, tuple[Fault, int]] = {}  # and the time of the last invalid message
        self.counts: Counter[str] = Counter()

    def reject(self, key: str, error: ValueError) -> None:
        """Count an invalid message on `key`, and log the fault if it is new."""
        self.counts[key] += 1
        fault, _ = self._faults.get(key, (Fault(log), 0))
        self._faults[key] = fault, self._clock.now_ns()
        about = {"event": "rejected", "key": key}
        fault.begin(f"dropped a message on {key}: {error}", about)

    def accept(self, key: str) -> None:
        """End the fault on `key` after a valid message, if no invalid one came within QUIET_NS.

        While a valid and an invalid sender share the key, the fault stays.
        """
        if key not in self._faults:
            return
        fault, last_ns = self._faults[key]
        if self._clock.now_ns() - last_ns >= QUIET_NS:
            del self._faults[key]
            fault.end(f"{key} is valid again")
