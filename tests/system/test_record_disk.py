"""The recorder never delays the robot: with a slow or full disk, or when it is killed."""

import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from gigabrain_schemas.examples import example
from gigabrain_schemas.topics import MAP
from gigabrain_zenoh import codec
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.recording import bag_writer
from gigabrain_zenoh.recording.bag_reader import read_info
from gigabrain_zenoh.recording.bag_writer import AppendOnlyFile
from gigabrain_zenoh.recording.recorder import Recorder
from tests.unit.recording import bags
from tests.unit.recording.bags import QUICK, kept, wait


class SlowTape(AppendOnlyFile):
    """A file on a disk that writes 1 MB a second."""

    def append(self, data: bytes) -> None:
        time.sleep(len(data) / 1e6)
        super().append(data)


class FullTape(AppendOnlyFile):
    """A file on a disk that is full while `full` is set."""

    full = False

    def append(self, data: bytes) -> None:
        if self.full:
            super().append(data[: len(data) // 2])
            self.size -= len(data) // 2
            os.ftruncate(self._fd, self.size)
            os.lseek(self._fd, self.size, os.SEEK_SET)
            raise OSError(28, "No space left on device")
        super().append(data)


def test_on_a_slow_disk_written_and_dropped_messages_add_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_writer, "AppendOnlyFile", SlowTape)
    path = tmp_path / "slow.mcap"
    config = RecorderConfig(viewers=False, flush_s=0.05, keep_free_mb=0, queue_mb=0.3)
    with Recorder(path, config) as recorder:
        count = 0
        while recorder.status().dropped < 500:  # messages of 1.5 kB that do not compress
            count += 1
            recorder.intake.receive("robot/scan", "", bags.scan(count))
    status = recorder.status()
    assert status.seen == count
    assert status.written + status.dropped == count
    assert kept(path)["robot/scan"] == status.written
    found = read_info(path)
    assert found.keys[0].missing == bags.seqs(path, "robot/scan")[-1] - status.written
    assert found.notes["gigabrain.recorded"]["dropped"] == str(status.dropped)


def test_the_bus_never_waits_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hung, gate = threading.Event(), threading.Event()

    class StuckTape(AppendOnlyFile):
        def append(self, data: bytes) -> None:
            if self.size > 1000:
                hung.set()
                gate.wait()
            super().append(data)

    monkeypatch.setattr(bag_writer, "AppendOnlyFile", StuckTape)
    config = RecorderConfig(viewers=False, flush_s=0.01, keep_free_mb=0, queue_mb=0.1)
    with Recorder(tmp_path / "stuck.mcap", config) as recorder:
        first = 0
        while not hung.wait(0.01):  # until the disk hangs
            first += 1
            recorder.intake.receive("robot/scan", "", bags.scan(first))
        for seq in range(first + 1, first + 1001):
            recorder.intake.receive("robot/scan", "", bags.scan(seq))
        stuck = recorder.status()
        gate.set()
    assert stuck.seen == first + 1000  # all are accepted while the disk hangs
    assert stuck.dropped > 850  # at most two full queues are kept
    status = recorder.status()
    assert status.written + status.dropped == first + 1000


def test_the_first_message_of_a_key_on_a_full_disk_counts_as_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_writer, "AppendOnlyFile", FullTape)
    with Recorder(tmp_path / "full.mcap", QUICK) as recorder:
        recorder.intake.receive("robot/state", "", bags.state(1))
        wait(recorder, lambda now: now.written == 1)
        monkeypatch.setattr(FullTape, "full", True)
        recorder.intake.receive("robot/scan", "", bags.scan(1))
        wait(recorder, lambda now: "the disk is full" in now.fault)
        monkeypatch.setattr(FullTape, "full", False)
    assert (recorder.status().written, recorder.status().dropped) == (1, 1)


def test_after_a_full_disk_recording_goes_on_in_a_new_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_writer, "AppendOnlyFile", FullTape)
    monkeypatch.setattr("gigabrain_zenoh.recording.recorder.RETRY_S", 0.02)
    path = tmp_path / "full.mcap"

    def send(first: int, count: int) -> None:
        for seq in range(first, first + count):
            recorder.intake.receive("robot/state", "", bags.state(seq))

    with Recorder(path, QUICK) as recorder:
        send(1, 100)
        wait(recorder, lambda now: now.written == 100)
        FullTape.full = True
        try:
            send(101, 100)
            wait(recorder, lambda now: now.written + now.dropped == 200)
            wait(recorder, lambda now: "the disk is full" in now.fault)  # it keeps retrying
        finally:
            FullTape.full = False
        time.sleep(0.05)
        send(201, 100)
        wait(recorder, lambda now: now.written >= 200)
    status = recorder.status()
    assert status.seen == 300 == status.written + status.dropped
    assert status.fault == ""
    second = tmp_path / "full_1.mcap"
    assert bags.seqs(path) == list(range(1, 101))
    assert bags.seqs(second)[-100:] == list(range(201, 301))
    assert read_info(second).finished


def test_the_reserved_disk_space_is_not_used(tmp_path: Path) -> None:
    config = RecorderConfig(viewers=False, flush_s=0.02, keep_free_mb=1e9)
    with Recorder(tmp_path / "a.mcap", config) as recorder:
        recorder.intake.receive("robot/state", "", bags.state(1))
        wait(recorder, lambda now: "less than 1e+09 MB are free" in now.fault)
    assert recorder.status().dropped == 1
    assert recorder.status().written == 0
    assert list(tmp_path.iterdir()) == []


def test_a_recording_is_split_by_size_and_each_part_has_the_map(tmp_path: Path) -> None:
    config = RecorderConfig(viewers=False, flush_s=0, keep_free_mb=0, split_mb=0.08, queue_mb=0.1)
    grid = codec.encode(example(MAP.type))
    with Recorder(tmp_path / "s.mcap", config) as recorder:
        recorder.intake.receive("robot/map", "", grid)
        for seq in range(1, 301):
            recorder.intake.receive("robot/scan", "", bags.scan(seq))
            if seq % 20 == 0:  # 30 kB, over a quarter of the queue, are written at once
                wait(recorder, lambda now, seq=seq: now.written > seq - 10)
    paths = [tmp_path / name for name in ("s.mcap", "s_1.mcap", "s_2.mcap", "s_3.mcap")]
    assert recorder.status().files >= 4
    assert recorder.status().written == 301
    for path in paths[: recorder.status().files]:
        assert read_info(path).finished
        assert kept(path)["robot/map"] == 1
    seqs = [seq for path in sorted(tmp_path.iterdir()) for seq in bags.seqs(path, "robot/scan")]
    assert sorted(seqs) == list(range(1, 301))


def test_a_recording_is_split_by_time(tmp_path: Path) -> None:
    config = RecorderConfig(viewers=False, flush_s=0.01, keep_free_mb=0, split_s=0.2)
    with Recorder(tmp_path / "s.mcap", config) as recorder:
        for seq in range(1, 61):
            recorder.intake.receive("robot/scan", "", bags.scan(seq))
            time.sleep(0.01)
    assert recorder.status().files >= 3
    assert sum(kept(path)["robot/scan"] for path in tmp_path.iterdir()) == 60


WRITER = """
import sys, time
from pathlib import Path
from gigabrain_zenoh.recording.recorder import Recorder
from gigabrain_zenoh.config.settings import RecorderConfig
from tests.unit.recording import bags
with Recorder(Path(sys.argv[1]), RecorderConfig(viewers=False, keep_free_mb=0)) as recorder:
    for seq in range(1, 10_000):
        recorder.intake.receive("robot/state", "", bags.state(seq))
        print(seq, flush=True)
        time.sleep(0.005)
"""


@pytest.mark.parametrize("seed", range(4))
def test_a_killed_recorder_loses_less_than_half_a_second(tmp_path: Path, seed: int) -> None:
    """The messages are 5 ms apart, or more on a busy machine."""
    path = tmp_path / "killed.mcap"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        (sys.executable, "-c", WRITER, str(path)), stdout=subprocess.PIPE, env=environment
    ) as process:
        assert process.stdout
        stop = 150 + random.Random(seed).randrange(100)
        for line in process.stdout:
            newest = int(line)
            if newest == stop:
                process.send_signal(signal.SIGKILL)
    seqs = bags.seqs(path)
    assert seqs == list(range(1, seqs[-1] + 1))
    assert newest - seqs[-1] <= 100


LIMITED = """
import resource, sys
from pathlib import Path
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
from gigabrain_zenoh.recording import recorder as module
from gigabrain_zenoh.recording.recorder import Recorder
from gigabrain_zenoh.config.settings import RecorderConfig
from tests.unit.recording import bags
module.RETRY_S = 1e9  # no second file
config = RecorderConfig(viewers=False, keep_free_mb=0, flush_s=0)
with Recorder(Path(sys.argv[1]), config) as recorder:
    for seq in range(1, 101):
        recorder.intake.receive("robot/scan", "", bags.scan(seq))
        if seq % 25 == 0:
            bags.wait(recorder, lambda now: now.written + now.dropped == seq)
now = recorder.status()
print(now.seen, now.written, now.dropped)
"""


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="no limit on file sizes here")
def test_a_file_size_limit_of_the_system_is_handled_as_a_full_disk(tmp_path: Path) -> None:
    path = tmp_path / "limited.mcap"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        (sys.executable, "-c", LIMITED, str(path)),
        capture_output=True, text=True, env=environment,
    )  # fmt: skip
    assert "cannot write" in done.stderr
    seen, written, dropped = map(int, done.stdout.split())
    assert seen == 100 == written + dropped
    assert 20 < len(bags.seqs(path, "robot/scan")) == written < 100
