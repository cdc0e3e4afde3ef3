"""The recorder: it keeps up, counts what it cannot keep, and never makes the robot wait."""

import asyncio
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_schemas.examples import EXAMPLES, example
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import IMAGE, INTENT, MAP, SCAN, STATE, TOPICS
from gigabrain_zenoh import codec
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording import bagfile, tape
from gigabrain_zenoh.recording.bagfile import BagFile
from gigabrain_zenoh.recording.info import info
from gigabrain_zenoh.recording.intake import Intake
from gigabrain_zenoh.recording.node import chosen, listening, run
from gigabrain_zenoh.recording.reading import Bag
from gigabrain_zenoh.recording.recorder import Recorder, Status
from gigabrain_zenoh.settings import RecorderConfig
from tests import bag_rig
from tests.bus_rig import Net, until

QUICK = RecorderConfig(viewers=False, flush_s=0.05, keep_free_mb=0)


class SlowTape(tape.Tape):
    """A disk that takes 1 MB a second."""

    def write(self, data: bytes) -> int:
        time.sleep(len(data) / 1e6)
        return super().write(data)


class FullTape(tape.Tape):
    """A disk that is full from time to time."""

    full = False

    def write(self, data: bytes) -> int:
        if self.full:
            super().write(data[: len(data) // 2])
            self.size -= len(data) // 2
            os.ftruncate(self._fd, self.size)
            os.lseek(self._fd, self.size, os.SEEK_SET)
            raise OSError(28, "No space left on device")
        return super().write(data)


def kept(*paths: Path) -> Counter[str]:
    """How many messages can be read from some files."""
    return Counter(sample.key for path in paths for sample in Bag(path))


async def test_what_comes_over_the_bus_is_in_the_file_as_it_came(tmp_path: Path) -> None:
    net, path = Net(), tmp_path / "a.mcap"
    with Recorder(path, QUICK) as recorder, listening(net.one, recorder, ()):
        for _ in range(3):
            for topic in TOPICS:
                net.two.publish(topic, example(topic.type), name="one" if topic.many else "")
        sent = list(net.network.sent)
    assert [(sample.key, sample.payload) for sample in Bag(path)] == sent
    assert recorder.status().written == 3 * len(TOPICS)
    await net.one.close()
    await net.two.close()


async def test_only_the_topics_that_were_asked_for_are_recorded(tmp_path: Path) -> None:
    net, path = Net(), tmp_path / "a.mcap"
    with Recorder(path, QUICK) as recorder, listening(net.one, recorder, ("scan", "image")):
        for topic in (SCAN, STATE, IMAGE):
            net.two.publish(topic, example(topic.type), name="front" if topic.many else "")
    assert kept(path) == {"robot/scan": 1, "robot/image/front": 1}
    assert chosen(("robot/im*", "pose"))("robot/imu")
    assert not chosen(("pose",))("robot/imu")
    with pytest.raises(ConfigError, match="no topic 'scam'; did you mean 'scan'"):
        chosen(("scam",))
    await net.one.close()
    await net.two.close()


async def test_a_map_from_before_the_recording_is_in_it(tmp_path: Path) -> None:
    net, path = Net(), tmp_path / "a.mcap"
    net.two.publish(MAP, example(MAP.type))
    with Recorder(path, QUICK) as recorder, listening(net.one, recorder, ()):
        await until(lambda: recorder.intake.seen["robot/map"])
    assert kept(path) == {"robot/map": 1}
    await net.one.close()
    await net.two.close()


async def test_the_process_records_and_tells_how_it_is_doing(tmp_path: Path) -> None:
    net = Net()
    config = RecorderConfig(folder=str(tmp_path), keep_free_mb=0, flush_s=0.05)
    process = asyncio.ensure_future(run(config, net.one, lambda: None))
    await net.clock.advance(0)
    for _ in range(50):
        net.two.publish(STATE, example(STATE.type))

    async def counted() -> None:
        while net.one.counters["recorded"] < 50:
            await net.clock.advance(500_000_000)
            await asyncio.sleep(0.01)

    await asyncio.wait_for(counted(), 20)
    process.cancel()
    await asyncio.wait((process,))
    (name,) = os.listdir(tmp_path)
    assert info(tmp_path / name).finished
    assert kept(tmp_path / name) == {"robot/state": 50}
    await net.one.close()
    await net.two.close()


def test_viewers_find_something_to_draw_of_every_kind(tmp_path: Path) -> None:
    file = BagFile(tmp_path / "v.mcap", viewers=True, notes={})
    for n, topic in enumerate(TOPICS):
        payload = codec.encode(EXAMPLES[topic.type.__name__])
        file.add(bag_rig.arrival(n, topic.at("front"), payload))
    jpeg = Image(frame_id="camera", encoding="jpeg", height=1, width=1, data=b"\xff\xd8")
    file.add(bag_rig.arrival(99, "robot/image/rear", codec.encode(jpeg)))
    file.finish()
    file.close()
    drawn = {
        channel.topic: schema.name
        for channel, schema, _ in Bag(file.path).messages()
        if schema and channel.metadata["kind"] == "view"
    }
    assert drawn == {
        "/viz/scan": "foxglove.LaserScan",
        "/viz/map": "foxglove.Grid",
        "/viz/pose": "foxglove.PoseInFrame",
        "/viz/path": "foxglove.PosesInFrame",
        "/viz/image/front": "foxglove.RawImage",
        "/viz/image/rear": "foxglove.CompressedImage",
        "/viz/obstacles": "foxglove.SceneUpdate",
        "/viz/way": "foxglove.PosesInFrame",
        "/viz/log": "foxglove.Log",
        "/viz/tf": "foxglove.FrameTransform",
        "/viz/state_numbers": "gigabrain.RobotState",
        "/viz/world_numbers": "gigabrain.WorldModel",
        "/viz/intent_numbers": "gigabrain.Intent",
        "/viz/cmd_vel_numbers": "gigabrain.CmdVel",
        "/viz/safety_numbers": "gigabrain.SafetyState",
    }
    assert kept(file.path).total() == len(TOPICS) + 1


def test_on_a_slow_disk_what_is_written_and_what_was_dropped_is_what_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bagfile, "Tape", SlowTape)
    path = tmp_path / "slow.mcap"
    config = RecorderConfig(viewers=False, flush_s=0.05, keep_free_mb=0, queue_mb=0.3)
    with Recorder(path, config) as recorder:
        for seq in range(1, 1501):  # 2.3 MB that do not compress, at once
            recorder.intake.take("robot/scan", "", bag_rig.scan(seq))
    status = recorder.status()
    assert status.seen == 1500
    assert status.dropped > 500
    assert status.written + status.dropped == 1500
    assert kept(path)["robot/scan"] == status.written
    found = info(path)
    assert found.keys[0].missing == bag_rig.seqs(path, "robot/scan")[-1] - status.written
    assert found.notes["gigabrain.recorded"]["dropped"] == str(status.dropped)


def test_whoever_hands_messages_over_never_waits_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stood, gate = threading.Event(), threading.Event()

    class StuckTape(tape.Tape):
        def write(self, data: bytes) -> int:
            if self.size > 1000:
                stood.set()
                gate.wait()
            return super().write(data)

    monkeypatch.setattr(bagfile, "Tape", StuckTape)
    config = RecorderConfig(viewers=False, flush_s=0.01, keep_free_mb=0, queue_mb=0.1)
    with Recorder(tmp_path / "stuck.mcap", config) as recorder:
        first = 0
        while not stood.wait(0.01):  # until the disk stands still
            first += 1
            recorder.intake.take("robot/scan", "", bag_rig.scan(first))
        for seq in range(first + 1, first + 1001):
            recorder.intake.take("robot/scan", "", bag_rig.scan(seq))
        stuck = recorder.status()
        gate.set()
    assert stuck.seen == first + 1000  # all were taken while the disk stood still
    assert stuck.dropped > 850  # twice the queue's room at most was not
    status = recorder.status()
    assert status.written + status.dropped == first + 1000


def test_a_full_disk_costs_what_comes_meanwhile_and_recording_goes_on_in_a_new_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bagfile, "Tape", FullTape)
    monkeypatch.setattr("gigabrain_zenoh.recording.recorder.RETRY_S", 0.02)
    path = tmp_path / "full.mcap"

    def send(first: int, count: int) -> None:
        for seq in range(first, first + count):
            recorder.intake.take("robot/state", "", bag_rig.state(seq))

    def wait(condition: Callable[[Status], bool]) -> None:
        for _ in range(2000):
            if condition(recorder.status()):
                return
            time.sleep(0.01)
        raise AssertionError(recorder.status())

    with Recorder(path, QUICK) as recorder:
        send(1, 100)
        wait(lambda now: now.written == 100)
        FullTape.full = True
        try:
            send(101, 100)
            wait(lambda now: now.written + now.dropped == 200)
            wait(lambda now: "No space left on device" in now.fault)  # it tries again and again
        finally:
            FullTape.full = False
        time.sleep(0.05)
        send(201, 100)
        wait(lambda now: now.written >= 200)
    status = recorder.status()
    assert status.seen == 300 == status.written + status.dropped
    assert status.fault == ""
    second = tmp_path / "full_1.mcap"
    assert bag_rig.seqs(path) == list(range(1, 101))
    assert bag_rig.seqs(second)[-100:] == list(range(201, 301))
    assert info(second).finished


def test_what_must_stay_free_of_the_disk_stays_free(tmp_path: Path) -> None:
    config = RecorderConfig(viewers=False, flush_s=0.02, keep_free_mb=1e9)
    with Recorder(tmp_path / "a.mcap", config) as recorder:
        recorder.intake.take("robot/state", "", bag_rig.state(1))
        for _ in range(1000):
            if recorder.status().dropped:
                break
            time.sleep(0.01)
        assert "less than 1e+09 MB are free" in recorder.status().fault
    assert recorder.status().written == 0
    assert list(tmp_path.iterdir()) == []


def test_a_recording_is_split_by_size_and_each_part_has_the_map(tmp_path: Path) -> None:
    config = RecorderConfig(viewers=False, flush_s=0.01, keep_free_mb=0, split_mb=0.1)
    grid = codec.encode(example(MAP.type))
    with Recorder(tmp_path / "s.mcap", config) as recorder:
        recorder.intake.take("robot/map", "", grid)
        for seq in range(1, 301):
            recorder.intake.take("robot/scan", "", bag_rig.scan(seq))
            if seq % 20 == 0:
                time.sleep(0.06)
    paths = [tmp_path / name for name in ("s.mcap", "s_1.mcap", "s_2.mcap", "s_3.mcap")]
    assert recorder.status().files >= 4
    assert recorder.status().written == 301
    for path in paths[: recorder.status().files]:
        assert info(path).finished
        assert kept(path)["robot/map"] == 1
    seqs = [seq for path in sorted(tmp_path.iterdir()) for seq in bag_rig.seqs(path, "robot/scan")]
    assert sorted(seqs) == list(range(1, 301))


def test_a_recording_is_split_by_time(tmp_path: Path) -> None:
    config = RecorderConfig(viewers=False, flush_s=0.01, keep_free_mb=0, split_s=0.2)
    with Recorder(tmp_path / "s.mcap", config) as recorder:
        for seq in range(1, 61):
            recorder.intake.take("robot/scan", "", bag_rig.scan(seq))
            time.sleep(0.01)
    assert recorder.status().files >= 3
    assert sum(kept(path)["robot/scan"] for path in tmp_path.iterdir()) == 60


WRITER = """
import sys, time
from collections.abc import Callable
from pathlib import Path
from gigabrain_zenoh.recording.recorder import Recorder, Status
from gigabrain_zenoh.settings import RecorderConfig
from tests import bag_rig
with Recorder(Path(sys.argv[1]), RecorderConfig(viewers=False, keep_free_mb=0)) as recorder:
    for seq in range(1, 10_000):
        recorder.intake.take("robot/state", "", bag_rig.state(seq))
        print(seq, time.monotonic_ns(), flush=True)
        time.sleep(0.005)
"""


@pytest.mark.parametrize("seed", range(4))
def test_killed_at_any_moment_it_loses_less_than_half_a_second(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "killed.mcap"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        (sys.executable, "-c", WRITER, str(path)), stdout=subprocess.PIPE, env=environment
    ) as process:
        assert process.stdout
        told: dict[int, int] = {}
        stop = 150 + random.Random(seed).randrange(100)
        for line in process.stdout:
            seq, at_ns = map(int, line.split())
            told[seq] = at_ns
            if seq == stop:
                process.send_signal(signal.SIGKILL)
    seqs = bag_rig.seqs(path)
    assert seqs == list(range(1, seqs[-1] + 1))
    assert max(told.values()) - told[seqs[-1]] <= 500_000_000


LIMITED = """
import resource, sys, time
from collections.abc import Callable
from pathlib import Path
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
from gigabrain_zenoh.recording.recorder import Recorder, Status
from gigabrain_zenoh.settings import RecorderConfig
from tests import bag_rig
config = RecorderConfig(viewers=False, keep_free_mb=0, flush_s=0.02)
with Recorder(Path(sys.argv[1]), config) as recorder:
    for seq in range(1, 101):
        recorder.intake.take("robot/scan", "", bag_rig.scan(seq))
        time.sleep(0.01)
now = recorder.status()
print(now.seen, now.written, now.dropped)
"""


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="no limit on file sizes here")
def test_a_disk_that_truly_takes_no_more_is_survived(tmp_path: Path) -> None:
    path = tmp_path / "limited.mcap"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    told = subprocess.run(
        (sys.executable, "-c", LIMITED, str(path)),
        capture_output=True, text=True, env=environment,
    )  # fmt: skip
    assert "cannot write" in told.stderr
    seen, written, dropped = map(int, told.stdout.split())
    assert seen == 100 == written + dropped
    assert 20 < len(bag_rig.seqs(path, "robot/scan")) == written < 100


def test_a_file_that_exists_or_cannot_be_made_is_refused_before_anything_is_recorded(
    tmp_path: Path,
) -> None:
    there = tmp_path / "there.mcap"
    there.write_text("mine")
    with pytest.raises(ConfigError, match=r"there.mcap exists; choose another file"):
        Recorder(there, QUICK).begin()
    assert there.read_text() == "mine"
    with pytest.raises(ConfigError, match=r"there.mcap exists; choose another"):
        Recorder(there / "x.mcap", QUICK).begin()


def test_messages_that_gathered_bear_the_times_of_their_own_stamps() -> None:
    intake = Intake(1 << 20, lambda: 1_000_000_000)
    for ago_ms in (50, 30, 10, 70, -5):
        state = replace(example(STATE.type), stamp_ns=(1_000 - ago_ms) * 1_000_000)
        intake.take("robot/state", "", codec.encode(state))
    times = [arrival.log_ns for arrival in intake.hand_over()]
    assert times == [950_000_000, 970_000_000, 990_000_000, 1_000_000_000, 1_000_000_001]


def test_what_is_dropped_is_not_missing_nor_a_new_sender() -> None:
    intake = Intake(5000, lambda: 1)
    for seq in range(1, 6):  # of 1.5 kB each: three fit
        intake.take("robot/scan", "", bag_rig.scan(seq))
    assert (intake.counts(), len(intake.hand_over())) == ((5, 2, 0), 3)
    assert not intake.gaps.restarts


def test_viewers_get_every_second_state_and_each_thought_once(tmp_path: Path) -> None:
    file = BagFile(tmp_path / "a.mcap", viewers=True, notes={})
    for tick in range(50):  # one second
        for topic in (STATE, INTENT):
            said = replace(example(topic.type), seq=tick + 1, tick=tick, basis=tick // 5)
            file.add(bag_rig.arrival(tick * 20_000_000, topic.key, codec.encode(said)))
    file.finish()
    file.close()
    drawn = Counter(channel.topic for channel, _, _ in Bag(file.path).messages())
    assert {name: drawn[name] for name in ("robot/state", "/viz/tf", "/viz/state_numbers")} == {
        "robot/state": 50, "/viz/tf": 25, "/viz/state_numbers": 25,
    }  # fmt: skip
    assert (drawn["robot/intent"], drawn["/viz/path"]) == (50, 10)


def test_the_writer_is_told_to_hurry_once_a_quarter_of_the_room_is_full() -> None:
    told: list[int] = []
    intake = Intake(4000, lambda: 1, lambda: told.append(1))
    for expected in (0, 0, 1, 1):
        intake.take("robot/scan", "", bytes(400))
        assert len(told) == expected
    intake.written(intake.hand_over())
    for expected in (1, 1, 2):
        intake.take("robot/scan", "", bytes(400))
        assert len(told) == expected
