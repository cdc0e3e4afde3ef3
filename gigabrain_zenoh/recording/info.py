"""What is in a bag: how much of what, at what rate, and what is missing."""

from collections import Counter
from pathlib import Path

from msgspec import Struct

from gigabrain_zenoh.recording.gaps import Gaps
from gigabrain_zenoh.recording.reading import Bag


class KeyInfo(Struct, frozen=True, kw_only=True):
    """One key of a recording."""

    key: str
    message: str  # its type
    messages: int
    bytes: int
    hz: float  # between the first and the last
    missing: int  # by the sender's count
    restarts: int  # of that count
    longest_gap_s: float  # between two messages


class Info(Struct, frozen=True, kw_only=True):
    """A whole recording."""

    path: str
    bytes: int  # of the file
    start_ns: int  # Unix time of the first message
    seconds: float
    messages: int
    finished: bool  # whether its writer came to the end
    damages: tuple[str, ...]
    keys: tuple[KeyInfo, ...]
    notes: dict[str, dict[str, str]]


class _Key:
    def __init__(self) -> None:
        self.messages = self.bytes = self.first_ns = self.last_ns = self.longest_ns = 0
        self.message = ""

    def info(self, key: str, gaps: Gaps) -> KeyInfo:
        seconds = (self.last_ns - self.first_ns) / 1e9
        return KeyInfo(
            key=key,
            message=self.message,
            messages=self.messages,
            bytes=self.bytes,
            hz=round((self.messages - 1) / seconds, 2) if seconds else 0.0,
            missing=gaps.missing[key],
            restarts=gaps.restarts[key],
            longest_gap_s=round(self.longest_ns / 1e9, 3),
        )


def info(path: Path) -> Info:
    """Read all of `path`. Raises ConfigError for a file that is no bag."""
    bag, gaps, keys = Bag(path), Gaps(), dict[str, _Key]()
    first_ns = last_ns = 0
    for sample in bag:
        gaps.see(sample.key, sample.header)
        key = keys.setdefault(sample.key, _Key())
        if key.messages:
            key.longest_ns = max(key.longest_ns, sample.log_ns - key.last_ns)
        key.first_ns = key.first_ns or sample.log_ns
        key.last_ns, key.message = sample.log_ns, sample.schema.removeprefix("gigabrain.")
        key.messages, key.bytes = key.messages + 1, key.bytes + len(sample.payload)
        first_ns, last_ns = first_ns or sample.log_ns, sample.log_ns
    told = tuple(keys[key].info(key, gaps) for key in sorted(keys))
    return Info(
        path=str(path),
        bytes=path.stat().st_size,
        start_ns=first_ns,
        seconds=round((last_ns - first_ns) / 1e9, 3),
        messages=sum(key.messages for key in told),
        finished=bag.finished and bag.index_ok,
        damages=tuple(f"byte {damage.offset}: {damage.what}" for damage in bag.damages),
        keys=told,
        notes={name: dict(values) for name, values in bag.notes.items()},
    )


def faults(of: Info) -> list[str]:
    """What is wrong with a recording, a sentence each; none where it is whole."""
    found = list(of.damages)
    if not of.finished and not of.damages:
        found.append("its index is damaged")
    missing = Counter({key.key: key.missing for key in of.keys if key.missing})
    found += [f"{key}: {count} messages are missing" for key, count in missing.items()]
    return found
