"""Faults of the recorder: killed at any moment, its file cut anywhere, its disk slow or full."""

import asyncio
import errno
import itertools
import random
import time
from pathlib import Path

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import CMD_VEL, SCAN, STATE
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.stopping import TICK_MS
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.recording.bag_reader import MAGIC, Bag, Sample
from gigabrain_zenoh.recording.bag_writer import BagWriter, ReceivedMessage
from gigabrain_zenoh.recording.headers import header_of
from gigabrain_zenoh.recording.recorder import Recorder

ALL = ("router", "driver", "perception", "decision", "control", "safety", "recorder")
KILLS, LONG_KILLS = 3, 50
LIFE_S = (1.0, 2.0)  # between a start of the recorder and its death
CUTS, LONG_CUTS = 100, 5000  # of the last MB
MB = 1_000_000
SENT, SCAN_BYTES = 1500, 1440  # to a bad disk
TROUBLED_EVERY = 400  # messages, after which a disk is full for a moment
SLOW_S = 0.002  # for a scan of 2 kB: about 1 MB a second
PACE_S = 0.0005  # between two scans: faster than that
MARGIN_S = 0.1  # by which the suite and the recorder may differ about when something came
Seen = dict[tuple[str, int, int], int]  # key, boot, number: when it came [ns, Unix]


async def recorder_killed(rig: Rig) -> Measured:
    """Again and again while a robot drives; then its files and its disk are treated badly."""
    await rig.give_up()
    folder, chance = rig.fresh_folder(), random.Random(0)
    recorder = RecorderConfig(folder=str(folder), keep_free_mb=0)
    deployment = msgspec.structs.replace(
        deployment_of(rig.options, "sim"), hosts={"robot": ALL}, recorder=recorder
    )
    lost_s, unreadable, late_ms = 0.0, 0, 0.0
    async with rig.new(deployment) as subject:
        await subject.settle()
        seen = _listen(subject)
        for _ in range(LONG_KILLS if rig.long else KILLS):
            one = await _killed(subject, folder, seen, chance)
            lost_s, late_ms = max(lost_s, one[0]), max(late_ms, one[2])
            unreadable += one[1]
        await subject.check()
    cuts = LONG_CUTS if rig.long else CUTS
    unreadable += await asyncio.to_thread(_cut, _newest(folder), cuts, chance)
    for disk in (SlowDisk, FullDisk):
        unreadable += await asyncio.to_thread(_unaccounted, rig.fresh_folder(), disk)
    return {
        "lost": lost_s,
        "earlier messages unreadable": unreadable,
        "control delayed": late_ms,
    }


def _listen(subject: Subject) -> Seen:
    """What comes from now on, as the recorder should have it."""
    seen: Seen = {}

    def see(key: str, _encoding: str, payload: bytes) -> None:
        header = header_of(payload)
        seen[key, header.boot, header.seq] = time.time_ns()

    for topic in (STATE, CMD_VEL):
        subject.onlooker.bus.tap(topic.key, see)
    return seen


async def _killed(
    subject: Subject, folder: Path, seen: Seen, chance: random.Random
) -> tuple[float, int, float]:
    """(what the recording lacks at its end [s], or before it; how late control was [ms])."""
    onlooker = subject.onlooker
    await subject.drive(0.8)
    await asyncio.sleep(chance.uniform(*LIFE_S))
    newest, start = _newest(folder), onlooker.state
    pid, killed_ns = subject.kill("recorder"), time.time_ns()
    samples = list(Bag(newest))
    await subject.restarted("recorder", pid)
    ticks = [c.tick for c in onlooker.commands if c.boot == start.boot and c.tick >= start.tick]
    late_ms = (max(b - a for a, b in itertools.pairwise(ticks)) - 1) * TICK_MS
    if not samples:
        raise Failed("nothing has been recorded")
    return _short_s(samples, killed_ns), _absent(samples, seen), late_ms


def _newest(folder: Path) -> Path:
    """What is being recorded now."""
    return max(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)


def _short_s(samples: list[Sample], killed_ns: int) -> float:
    return (killed_ns - samples[-1].log_ns) / 1e9


def _absent(samples: list[Sample], seen: Seen) -> int:
    """How many messages that came between the first and the last recorded ones are not there."""
    there = {(s.key, s.header.boot, s.header.seq) for s in samples}
    first_ns, last_ns = samples[0].log_ns, samples[-1].log_ns
    margin_ns = round(MARGIN_S * 1e9)
    until_now = seen.copy().items()  # it goes on being written, by another thread
    due = (what for what, ns in until_now if first_ns + margin_ns < ns < last_ns - margin_ns)
    return sum(what not in there for what in due)


def _cut(path: Path, cuts: int, chance: random.Random) -> int:
    """Of a file that is cut off: how often what is left is not what it began with, or is less.

    Less than what a shorter piece of it still had.
    """
    whole, wrong, least = path.read_bytes(), 0, 0
    every = [sample.log_ns for sample in Bag(path)]
    piece = path.with_suffix(".cut")
    first = max(len(MAGIC), len(whole) - MB)
    for size in sorted(chance.sample(range(first, len(whole)), min(cuts, len(whole) - first))):
        piece.write_bytes(whole[:size])
        left = [sample.log_ns for sample in Bag(piece)]
        wrong += left != every[: len(left)] or len(left) < least
        least = len(left)
    piece.unlink()
    if not least:
        raise Failed("no cut has left anything")
    return wrong


class BadDisk(BagWriter):
    """A recording on a disk that takes 1 MB a second, or that is full now and then."""

    slow = full = False
    count = 0

    def add(self, message: ReceivedMessage, *, repeated: bool = False) -> None:
        """Append one message, if the disk will have it."""
        if self.slow:
            time.sleep(SLOW_S)
        self.count += 1
        super().add(message, repeated=repeated)
        if self.full and self.count % TROUBLED_EVERY == 0:
            raise OSError(errno.ENOSPC, "No space left on device")


class SlowDisk(BadDisk):
    """It takes 1 MB a second."""

    slow = True


class FullDisk(BadDisk):
    """It is full now and then."""

    full = True


def _unaccounted(folder: Path, disk: type[BadDisk]) -> int:
    """How many messages are neither on such a disk nor counted as dropped."""
    config = RecorderConfig(keep_free_mb=0, queue_mb=0.5, viewers=False, flush_s=0.05)

    def make(path: Path) -> BagWriter:
        return disk(path, viewers=False, notes={})

    example, chance = EXAMPLES[LaserScan.__name__], random.Random(0)
    assert isinstance(example, LaserScan)
    with Recorder(folder / "bad.mcap", config, make) as recorder:
        for seq in range(1, SENT + 1):
            ranges = chance.randbytes(SCAN_BYTES)
            recorder.intake.take(SCAN.key, "", encode(replace(example, seq=seq, ranges=ranges)))
            time.sleep(PACE_S)
    status = recorder.status()
    kept = sum(1 for path in folder.glob("*.mcap") for _ in Bag(path))
    if not status.dropped:
        raise Failed(f"{disk.__doc__} But nothing was dropped.")
    return abs(SENT - status.written - status.dropped) + abs(kept - status.written)
