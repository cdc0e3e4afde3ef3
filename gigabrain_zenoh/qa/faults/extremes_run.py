"""All extremes, to one robot after the other.

Started as `python -m gigabrain_zenoh.qa.faults.extremes_run FILE`.

Each result is a line of FILE; what is in it already is not tried again, so that a run that was
ended goes on where it was. With numbers behind the file only those are tried, again if need be.
"""

import asyncio
import contextlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import msgspec

from gigabrain_zenoh.host.files import read_bounded
from gigabrain_zenoh.qa.faults.errand import waiting_robot
from gigabrain_zenoh.qa.faults.extremes import Case, cases
from gigabrain_zenoh.qa.faults.one_message import Outcome, sending
from gigabrain_zenoh.qa.faults.rig import Options, Rig

MOST_BYTES = 100_000_000
BATCH = 100  # to one robot; then a new one begins


def main(words: list[str]) -> int:
    """The exit code: 1 where a message has done harm."""
    path, numbers = Path(words[0]), {int(word) for word in words[1:]}
    path.parent.mkdir(parents=True, exist_ok=True)
    known = {one.number for one in read(path)}
    left = [c for c in cases() if (c.number in numbers if numbers else c.number not in known)]
    with contextlib.suppress(KeyboardInterrupt):  # it goes on from here the next time
        asyncio.run(_try(left, path))
    outcomes = {one.number: one for one in read(path)}
    wrong = [one for one in outcomes.values() if one.wrong]
    for one in sorted(wrong, key=lambda one: one.number):
        print(f"{one.what}: {one.wrong}")
    print(f"{len(outcomes) - len(wrong)} of {len(cases())} cases did no harm")
    return 1 if wrong else 0


def read(path: Path) -> Iterator[Outcome]:
    """What is in the file; a line that was cut off is no result."""
    for line in read_bounded(path, MOST_BYTES).splitlines() if path.exists() else ():
        try:
            yield msgspec.json.decode(line, type=Outcome)
        except msgspec.DecodeError:
            continue


async def _try(left: list[Case], path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        async with Rig(Options(), Path(folder)) as rig:
            for first in range(0, len(left), BATCH):
                await _batch(rig, left[first : first + BATCH], path)


async def _batch(rig: Rig, batch: list[Case], path: Path) -> None:
    async with rig.new(waiting_robot(rig.options)) as subject, sending(subject) as sender:
        for case in batch:
            outcome = await sender.tried(case)
            with path.open("ab") as file:
                file.write(msgspec.json.encode(outcome) + b"\n")
            if outcome.wrong or outcome.ended:
                ended = f" ended: {', '.join(outcome.ended)}" if outcome.ended else ""
                print(f"{case}: {outcome.wrong}{ended}", flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
