"""Takes the machine's time and memory away from others. For tests only.

Started as `python -m gigabrain_zenoh.qa.faults.hogs KIND`.
"""

import itertools
import json
import sys
from collections.abc import Callable

from gigabrain_zenoh.host import this_process

MEMORY_MB = 256
OBJECTS = 1_000_000
JSON_NUMBERS = 6_000_000  # about 50 MB of text


def spin() -> None:
    """All of a core."""
    for _ in itertools.count():
        pass


def fill() -> None:
    """Memory, written to again and again."""
    held = bytearray(MEMORY_MB * 1_000_000)
    for turn in itertools.count():
        held[::4096] = bytes([turn % 256]) * len(held[::4096])


def litter() -> None:
    """Objects for the garbage collector, a million at a time."""
    for _ in itertools.count():
        ring: list[object] = []
        ring.extend([ring] for _ in range(OBJECTS))


def parse() -> None:
    """50 MB of JSON, as a careless page might."""
    text = json.dumps(list(range(JSON_NUMBERS)))
    for _ in itertools.count():
        json.loads(text)


KINDS: dict[str, Callable[[], None]] = {
    "spin": spin, "fill": fill, "litter": litter, "parse": parse,
}  # fmt: skip


def main() -> None:
    """Entry of the process."""
    this_process.die_with_supervisor()
    KINDS[sys.argv[1]]()


if __name__ == "__main__":
    main()
