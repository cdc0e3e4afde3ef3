"""Between the bus and the disk: a bounded queue that never makes the bus wait."""

import threading
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from gigabrain_zenoh.recording.gaps import Gaps, Header, header_of


class Arrival(NamedTuple):
    """One message as it came."""

    log_ns: int  # Unix time of its arrival, which never goes back
    key: str
    encoding: str  # Zenoh's
    payload: bytes
    header: Header


class Intake:
    """Takes messages from any thread, and hands them to one writer.

    What does not fit is dropped and counted: a slow disk costs messages, never time.
    """

    def __init__(self, room_bytes: int, unix_ns: Callable[[], int]) -> None:
        self._room, self._unix_ns = room_bytes, unix_ns
        self._lock = threading.Lock()
        self._waiting: list[Arrival] = []
        self._held = 0  # [bytes], of what waits and of what is being written
        self._newest_ns = 0
        self.gaps = Gaps()
        self.seen: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()

    def take(self, key: str, encoding: str, payload: bytes) -> None:
        """One message. Never waits longer than another one takes to be taken."""
        header = header_of(payload)
        with self._lock:
            self._newest_ns = max(self._newest_ns + 1, self._unix_ns())
            self.seen[key] += 1
            self.gaps.see(key, header)
            if self._held + len(payload) > self._room:
                self.dropped[key] += 1
                return
            self._held += len(payload)
            self._waiting.append(Arrival(self._newest_ns, key, encoding, payload, header))

    def hand_over(self) -> list[Arrival]:
        """All that waits, oldest first; it keeps its room until `written` is called."""
        with self._lock:
            batch, self._waiting = self._waiting, []
        return batch

    def written(self, batch: list[Arrival]) -> None:
        """The writer is done with `batch`."""
        with self._lock:
            self._held -= sum(len(arrival.payload) for arrival in batch)

    def lose(self, lost: Counter[str]) -> None:
        """Count what the writer could not bring to the disk."""
        with self._lock:
            self.dropped += lost

    def counts(self) -> tuple[int, int, int]:
        """How many were seen, were dropped here, and are missing from what came."""
        with self._lock:
            return self.seen.total(), self.dropped.total(), self.gaps.missing.total()
