"""Contents of a bag per key: counts, rates, sizes, and what is missing."""

import time
from pathlib import Path

from msgspec import Struct

from gigabrain_zenoh.bus.headers import SequenceGaps
from gigabrain_zenoh.recording.bag_reader import Bag

TABLE_HEAD = (
    f"{'key':<28} {'message':<14} {'messages':>8} {'hz':>7} {'kB':>9} {'missing':>8} "
    f"{'restarts':>9} {'longest gap':>11}"
)


class KeyInfo(Struct, frozen=True, kw_only=True):
    """Figures of one key of a recording."""

    key: str
    message: str  # name of its type
    messages: int
    bytes: int
    hz: float  # between the first and the last
    missing: int  # by the sender's count
    restarts: int  # of that count
    longest_gap_s: float  # between two messages


class BagInfo(Struct, frozen=True, kw_only=True):
    """Figures of a whole recording."""

    path: str
    bytes: int  # of the file
    start_ns: int  # Unix time of the first message
    seconds: float
    messages: int
    finished: bool  # its writer came to the end, and its index is intact
    damages: tuple[str, ...]
    keys: tuple[KeyInfo, ...]
    notes: dict[str, dict[str, str]]


class _KeyCounts:
    def __init__(self) -> None:
        self.messages = self.bytes = self.first_ns = self.last_ns = self.longest_ns = 0
        self.message = ""

    def info(self, key: str, gaps: SequenceGaps) -> KeyInfo:
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


def read_info(path: Path) -> BagInfo:
    """Read all of `path`. Raises ConfigError if the file is not a bag."""
    bag, gaps, keys = Bag(path), SequenceGaps(), dict[str, _KeyCounts]()
    first_ns = last_ns = 0
    for sample in bag:
        gaps.see(sample.key, sample.header)
        key = keys.setdefault(sample.key, _KeyCounts())
        if key.messages:
            key.longest_ns = max(key.longest_ns, sample.log_ns - key.last_ns)
        key.first_ns = key.first_ns or sample.log_ns
        key.last_ns, key.message = sample.log_ns, sample.schema.removeprefix("gigabrain.")
        key.messages, key.bytes = key.messages + 1, key.bytes + len(sample.payload)
        first_ns, last_ns = first_ns or sample.log_ns, sample.log_ns
    infos = tuple(keys[key].info(key, gaps) for key in sorted(keys))
    return BagInfo(
        path=str(path),
        bytes=path.stat().st_size,
        start_ns=first_ns,
        seconds=round((last_ns - first_ns) / 1e9, 3),
        messages=sum(key.messages for key in infos),
        finished=bag.finished and bag.index_ok,
        damages=tuple(f"byte {damage.offset}: {damage.text}" for damage in bag.damages),
        keys=infos,
        notes={name: dict(values) for name, values in bag.notes.items()},
    )


def faults(info: BagInfo) -> list[str]:
    """Describe everything wrong with a recording, a sentence each; empty if it is whole."""
    found = list(info.damages)
    if not info.finished and not info.damages:
        found.append("its index is damaged")
    missing = [(key.key, key.missing) for key in info.keys if key.missing]
    return found + [f"{key}: {count} messages are missing" for key, count in missing]


def print_info(info: BagInfo) -> None:
    """Print the figures of a recording as a table."""
    when = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(info.start_ns / 1e9))
    state = "finished" if info.finished else "unfinished or damaged"
    notes = "  ".join(
        f"{k} {v}" for k, v in info.notes.get("gigabrain", {}).items() if v[:1] != "{"
    )
    print(f"{info.path}: {info.bytes / 1e6:.2f} MB, {state}  {notes}".rstrip())
    print(f"{when}, {info.seconds:.1f} s, {info.messages} messages" if info.messages else "empty")
    print(TABLE_HEAD)
    for key in info.keys:
        gap = f"{key.longest_gap_s:.2f} s"
        print(
            f"{key.key:<28} {key.message:<14} {key.messages:>8} {key.hz:>7.1f} "
            f"{key.bytes / 1e3:>9.1f} {key.missing:>8} {key.restarts:>9} {gap:>11}"
        )
    for damage in info.damages:
        print(damage)
