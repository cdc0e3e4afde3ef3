"""Between the bus and the disk: a bounded queue that never makes the bus wait."""

import threading
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from gigabrain_zenoh.bus.zenoh.unobtrusive import LONGEST_S
from gigabrain_zenoh.recording.gaps import Gaps, Header, header_of

MOST_PLACES = 1000  # keys and encodings; anybody may make up another
OTHERS = "others"  # counts messages on keys beyond those
WAITED_NS = round(LONGEST_S * 1e9)  # a message's own stamp says when in this time it came


class Arrival(NamedTuple):
    """One message as it came."""

    log_ns: int  # Unix time of its arrival, which never goes back
    key: str
    encoding: str  # Zenoh's
    payload: bytes
    header: Header


def _nobody() -> None:
    """Nobody has to hurry."""


class Intake:
    """Takes messages from any thread, and hands them to one writer, who looks into them.

    What does not fit is dropped and counted: a slow disk costs messages, never time; so is what
    comes on more keys, or in more encodings, than any robot has. `hurry` is called when a quarter
    of the room is full.
    """

    def __init__(
        self, room_bytes: int, unix_ns: Callable[[], int], hurry: Callable[[], None] = _nobody
    ) -> None:
        self._room, self._unix_ns, self._hurry = room_bytes, unix_ns, hurry
        self._lock = threading.Lock()
        self._waiting: list[tuple[int, str, str, bytes]] = []
        self._looked: list[Arrival] = []  # the oldest of what waits, with their headers
        self._held = 0  # [bytes], of what waits and of what is being written
        self._newest_ns = 0
        self.gaps = Gaps()
        self._places: set[tuple[str, str]] = set()  # keys and encodings
        self.seen: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()

    def take(self, key: str, encoding: str, payload: bytes) -> None:
        """One message. Waits for nobody but others who take or hand over."""
        now_ns, size = self._unix_ns(), len(payload)
        with self._lock:
            if not self._knows(key, encoding):
                self.seen[OTHERS] += 1
                self.dropped[OTHERS] += 1
                return
            self.seen[key] += 1
            if self._held + size > self._room:
                self._look()  # what came before it is counted before it
                self.gaps.see(key, header_of(payload))
                self.dropped[key] += 1
                return
            before, self._held = self._held, self._held + size
            self._waiting.append((now_ns, key, encoding, payload))
        if before < self._room // 4 <= before + size:
            self._hurry()

    def _knows(self, key: str, encoding: str) -> bool:
        """Return whether a key is recorded in an encoding; the first MOST_PLACES are."""
        place = key, encoding
        if place not in self._places and len(self._places) < MOST_PLACES:
            self._places.add(place)
        return place in self._places

    def hand_over(self) -> list[Arrival]:
        """All that waits, oldest first; it keeps its room until `written` is called."""
        with self._lock:
            self._look()
            batch, self._looked = self._looked, []
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

    def _look(self) -> None:
        """Read the headers of what waits: late, and of many in a row, which costs less."""
        newest_ns, looked, see = self._newest_ns, self._looked, self.gaps.see
        for taken_ns, key, encoding, payload in self._waiting:
            header = header_of(payload)
            see(key, header)
            came_ns = header.stamp_ns if 0 < taken_ns - header.stamp_ns < WAITED_NS else taken_ns
            newest_ns = came_ns if came_ns > newest_ns else newest_ns + 1
            looked.append(Arrival(newest_ns, key, encoding, payload, header))
        self._newest_ns = newest_ns
        self._waiting.clear()
