"""Faults of the recorder: killed at any time, with a truncated file, a slow or a full disk."""

import asyncio
import errno
import itertools
import random
import time
from pathlib import Path

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_MS
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import CMD_VEL, SCAN, STATE
from gigabrain_zenoh.bus.headers import header_of
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.judging import Failed
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.recording.bag_reader import MAGIC, Bag, Sample
from gigabrain_zenoh.recording.bag_writer import BagWriter, ReceivedMessage
from gigabrain_zenoh.recording.recorder import Recorder

PROCESSES = ("router", "driver", "perception", "decision", "control", "safety", "recorder")
KILLS, LONG_KILLS = 3, 50
LIFE_S = (1.0, 2.0)  # between a start of the recorder and its death
CUTS, LONG_CUTS = 100, 5000  # of the last MB
MB = 1_000_000
SENT, SCAN_BYTES = 1500, 1440  # number of scans for a bad disk, and their size
FULL_EVERY = 400  # messages between two moments of a full disk
SLOW_S = 0.002  # per scan of 2 kB: about 1 MB a second
PACE_S = 0.0005  # between two scans, faster than the slow disk
MARGIN_S = 0.1  # difference between suite and recorder about a time of arrival
ArrivalTimes = dict[tuple[str, int, int], int]  # by key, boot and number [ns, Unix]


async def kill_recorder(rig: Rig) -> tuple[float, int, float]:
    """Kill the recorder again and again, cut its file, and give it a bad disk.

    Returns the recording lost [s], earlier messages that cannot be read, and control's delay [ms].
    """
    folder, chance = rig.fresh_folder(), random.Random(0)
    recorder = RecorderConfig(folder=str(folder), keep_free_mb=0)
    deployment = msgspec.structs.replace(
        deployment_of(rig.options, "sim"), hosts={"robot": PROCESSES}, recorder=recorder
    )
    lost_s, unreadable, late_ms = 0.0, 0, 0.0
    async with rig.own_robot(deployment) as robot:
        arrivals = _watch(robot)
        for _ in range(LONG_KILLS if rig.long else KILLS):
            lost, absent, late = await _killed(robot, folder, arrivals, chance)
            lost_s, late_ms = max(lost_s, lost), max(late_ms, late)
            unreadable += absent
    cuts = LONG_CUTS if rig.long else CUTS
    unreadable += await asyncio.to_thread(_cut, _newest(folder), cuts, chance)
    for disk in (SlowDisk, FullDisk):
        unreadable += await asyncio.to_thread(_unaccounted, rig.fresh_folder(), disk)
    return lost_s, unreadable, late_ms


def _watch(robot: RobotUnderTest) -> ArrivalTimes:
    """Record the arrival of each message that the recorder should have."""
    arrivals: ArrivalTimes = {}

    def note(key: str, _encoding: str, payload: bytes) -> None:
        header = header_of(payload)
        arrivals[key, header.boot, header.seq] = time.time_ns()

    for topic in (STATE, CMD_VEL):
        robot.probe.bus.tap(topic.key, note)
    return arrivals


async def _killed(
    robot: RobotUnderTest, folder: Path, arrivals: ArrivalTimes, chance: random.Random
) -> tuple[float, int, float]:
    """Return recording lost at the end [s], earlier messages missing, control's delay [ms]."""
    probe = robot.probe
    await robot.until_driving(0.8)
    await asyncio.sleep(chance.uniform(*LIFE_S))
    newest, start = _newest(folder), probe.state
    pid, killed_ns = robot.kill("recorder"), time.time_ns()
    samples = list(Bag(newest))
    await robot.until_restarted("recorder", pid)
    ticks = [c.tick for c in probe.commands if c.boot == start.boot and c.tick >= start.tick]
    late_ms = (max(b - a for a, b in itertools.pairwise(ticks)) - 1) * TICK_MS
    if not samples:
        raise Failed("nothing has been recorded")
    lost_s = (killed_ns - samples[-1].log_ns) / 1e9
    return lost_s, _absent(samples, arrivals), late_ms


def _newest(folder: Path) -> Path:
    return max(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)


def _absent(samples: list[Sample], arrivals: ArrivalTimes) -> int:
    """Count messages that arrived between the first and last recorded ones, and are missing."""
    there = {(s.key, s.header.boot, s.header.seq) for s in samples}
    first_ns, last_ns = samples[0].log_ns, samples[-1].log_ns
    margin_ns = round(MARGIN_S * 1e9)
    until_now = arrivals.copy().items()  # another thread still writes
    due = (what for what, ns in until_now if first_ns + margin_ns < ns < last_ns - margin_ns)
    return sum(what not in there for what in due)


def _cut(path: Path, cuts: int, chance: random.Random) -> int:
    """Truncate a file at random places; count pieces with fewer messages than expected."""
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
    """A recording on a disk that is slow, or sometimes full."""

    slow = full = False
    count = 0

    def add(self, message: ReceivedMessage, *, repeated: bool = False) -> None:
        """Append one message, if the disk accepts it."""
        if self.slow:
            time.sleep(SLOW_S)
        self.count += 1
        super().add(message, repeated=repeated)
        if self.full and self.count % FULL_EVERY == 0:
            raise OSError(errno.ENOSPC, "No space left on device")


class SlowDisk(BadDisk):
    """A disk that takes 1 MB a second."""

    slow = True


class FullDisk(BadDisk):
    """A disk that is sometimes full."""

    full = True


def _unaccounted(folder: Path, disk: type[BadDisk]) -> int:
    """Count messages that are neither on a bad disk nor counted as dropped."""
    config = RecorderConfig(keep_free_mb=0, queue_mb=0.5, viewers=False, flush_s=0.05)

    def make(path: Path) -> BagWriter:
        return disk(path, viewers=False, notes={})

    example, chance = EXAMPLES[LaserScan.__name__], random.Random(0)
    assert isinstance(example, LaserScan)
    with Recorder(folder / "bad.mcap", config, make) as recorder:
        for seq in range(1, SENT + 1):
            ranges = chance.randbytes(SCAN_BYTES)
            recorder.intake.receive(SCAN.key, "", encode(replace(example, seq=seq, ranges=ranges)))
            time.sleep(PACE_S)
    status = recorder.status()
    kept = sum(1 for path in folder.glob("*.mcap") for _ in Bag(path))
    if not status.dropped:
        raise Failed(f"{disk.__name__}: nothing was dropped")
    return abs(SENT - status.written - status.dropped) + abs(kept - status.written)
