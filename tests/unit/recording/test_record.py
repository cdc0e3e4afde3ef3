"""The recorder writes messages as they arrive, and counts them."""

import asyncio
import functools
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from gigabrain_schemas.examples import EXAMPLES, example
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import IMAGE, INTENT, MAP, POSE, SCAN, STATE, TOPICS
from gigabrain_zenoh import codec
from gigabrain_zenoh.cli.app import make_app
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording import recorder as recorder_module
from gigabrain_zenoh.recording.bag_reader import Bag, read_info
from gigabrain_zenoh.recording.bag_writer import BagWriter
from gigabrain_zenoh.recording.node import _key_line, key_filter, listening, run
from gigabrain_zenoh.recording.recorder import MAX_CHANNELS, OTHER_KEYS, Intake, Recorder, Status
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.waiting import until
from tests.unit.recording import bags
from tests.unit.recording.bags import QUICK, kept


async def test_messages_are_recorded_byte_for_byte(tmp_path: Path) -> None:
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
    assert key_filter(("robot/im$*", "pose"))("robot/imu")
    assert not key_filter(("robot/*", "pose"))("robot/image/front")
    await net.one.close()
    await net.two.close()


@pytest.mark.parametrize("topics", [(), ("map",), ("robot/*",), ("**", "scan")])
async def test_a_map_from_before_the_recording_is_in_it(
    tmp_path: Path, topics: tuple[str, ...]
) -> None:
    net, path = Net(), tmp_path / "a.mcap"
    net.two.publish(MAP, example(MAP.type))
    with Recorder(path, QUICK) as recorder, listening(net.one, recorder, topics):
        await until(lambda: recorder.intake.seen["robot/map"])
    assert kept(path) == {"robot/map": 1}
    await net.one.close()
    await net.two.close()


async def test_the_process_records_and_reports_its_counts(tmp_path: Path) -> None:
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
    assert read_info(tmp_path / name).finished
    assert kept(tmp_path / name) == {"robot/state": 50}
    await net.one.close()
    await net.two.close()


def test_every_kind_of_message_is_drawn_for_viewers(tmp_path: Path) -> None:
    file = BagWriter(tmp_path / "v.mcap", viewers=True, notes={})
    for n, topic in enumerate(TOPICS):
        payload = codec.encode(EXAMPLES[topic.type.__name__])
        file.add(bags.arrival(n, topic.at("front"), payload))
    jpeg = Image(frame_id="camera", encoding="jpeg", height=2, width=4, data=bags.jpeg_head(4, 2))
    file.add(bags.arrival(99, "robot/image/rear", codec.encode(jpeg)))
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
        "/viz/zones": "foxglove.SceneUpdate",
        "/viz/pose": "foxglove.PoseInFrame",
        "/viz/path": "foxglove.PosesInFrame",
        "/viz/image/front": "foxglove.RawImage",
        "/viz/image/rear": "foxglove.CompressedImage",
        "/viz/depth/front": "foxglove.RawImage",
        "/viz/calibration/front": "foxglove.CameraCalibration",
        "/viz/annotations/front": "foxglove.ImageAnnotations",
        "/viz/contours": "foxglove.SceneUpdate",
        "/viz/objects": "foxglove.SceneUpdate",
        "/viz/solids": "foxglove.SceneUpdate",
        "/viz/arm": "foxglove.SceneUpdate",
        "/viz/arm_plan": "foxglove.SceneUpdate",
        "/viz/perceived/front": "foxglove.SceneUpdate",
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


def test_a_message_from_after_the_year_2106_is_recorded_but_not_drawn(tmp_path: Path) -> None:
    file = BagWriter(tmp_path / "late.mcap", viewers=True, notes={})
    for n, topic in enumerate(TOPICS):
        late = replace(example(topic.type), stamp_ns=2**63 - 1)
        file.add(bags.arrival(n, topic.at("front"), codec.encode(late)))
    last = replace(example(POSE.type), stamp_ns=2**32 * 10**9 - 1)
    file.add(bags.arrival(99, "robot/pose", codec.encode(last)))
    file.finish()
    file.close()
    drawn = {channel.topic for channel, _, _ in Bag(file.path).messages()} - {*kept(file.path)}
    assert (drawn, kept(file.path).total()) == ({"/viz/pose", "/viz/tf"}, len(TOPICS) + 1)


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


@pytest.mark.parametrize(
    ("topic", "complaint"),
    [("scam", "no topic 'scam'"), ("robot/sc*an", "expected a key expression, got 'robot/sc*an'")],
)
def test_a_wrong_topic_is_refused_before_a_file_is_made(
    tmp_path: Path, topic: str, complaint: str
) -> None:
    command = ("record", "-o", str(tmp_path / "a.mcap"), "--topics", topic)
    with pytest.raises(ConfigError, match=re.escape(complaint)):
        make_app(command)(command, exit_on_error=False, print_error=False)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_of_several_files_skips_names_that_exist(tmp_path: Path) -> None:
    (tmp_path / "s_1.mcap").write_text("mine")
    with Recorder(tmp_path / "s.mcap", replace(QUICK, split_mb=1e-6)) as recorder:
        for seq in (1, 2, 3):  # each fills a file
            recorder.intake.receive("robot/state", "", bags.state(seq))
    parts = {path.name: bags.seqs(path) for path in tmp_path.iterdir() if path.stem != "s_1"}
    assert parts == {"s.mcap": [1], "s_2.mcap": [2], "s_3.mcap": [3]}
    assert (tmp_path / "s_1.mcap").read_text() == "mine"


def test_kept_values_that_begin_each_file_do_not_count_as_its_size(tmp_path: Path) -> None:
    with Recorder(tmp_path / "s.mcap", replace(QUICK, split_mb=1)) as recorder:
        recorder.intake.receive("robot/map", "", os.urandom(2_000_000))
        for _ in range(4):
            recorder.intake.receive("robot/scan", "", os.urandom(600_000))
    parts = [dict(kept(path)) for path in sorted(tmp_path.iterdir())]
    assert parts == [{"robot/map": 1}, *[{"robot/map": 1, "robot/scan": 2}] * 2]


def test_a_file_that_is_deleted_meanwhile_is_followed_by_another(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = tmp_path / "drives" / "a.mcap", tmp_path / "drives" / "a_1.mcap"
    with Recorder(first, QUICK) as recorder:
        recorder.intake.receive("robot/state", "", bags.state(1))
        bags.wait(recorder, functools.partial(is_written, 1))
        shutil.rmtree(first.parent)
        bags.wait(recorder, lambda _: bool(caplog.messages))
        recorder.intake.receive("robot/state", "", bags.state(2))
    assert caplog.messages == [f"{first} was deleted; recording continues in another file"]
    assert bags.seqs(second) == [2]


def is_written(count: int, now: Status) -> bool:
    return now.written == count


def test_a_new_file_begins_before_the_index_of_the_old_one_fills_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "MAX_INDEX_ENTRIES", 3)
    config = replace(QUICK, flush_s=1e-9)  # a chunk for each batch
    with Recorder(tmp_path / "long.mcap", config) as recorder:
        for seq in range(1, 6):
            recorder.intake.receive("robot/state", "", bags.state(seq))
            bags.wait(recorder, functools.partial(is_written, seq))
    parts = {path.name: bags.seqs(path) for path in tmp_path.iterdir()}
    assert parts == {"long.mcap": [1, 2, 3, 4], "long_1.mcap": [5]}


def test_messages_received_in_a_batch_have_the_times_of_their_stamps() -> None:
    intake = Intake(1 << 20, lambda: 1_000_000_000)
    for ago_ms in (50, 30, 10, 70, -5):
        state = replace(example(STATE.type), stamp_ns=(1_000 - ago_ms) * 1_000_000)
        intake.receive("robot/state", "", codec.encode(state))
    times = [arrival.log_ns for arrival in intake.take_batch()]
    assert times == [950_000_000, 970_000_000, 990_000_000, 1_000_000_000, 1_000_000_001]


def test_a_dropped_message_is_neither_missing_nor_a_restart() -> None:
    intake = Intake(5000, lambda: 1)
    for seq in range(1, 6):  # of 1.5 kB each: three fit
        intake.receive("robot/scan", "", bags.scan(seq))
    assert (intake.counts(), len(intake.take_batch())) == ((5, 2, 0), 3)
    assert not intake.gaps.restarts


def test_the_number_of_recorded_channels_is_bounded() -> None:
    intake = Intake(1 << 30, lambda: 1)
    intake.receive("robot/scan", "", bags.scan(1))
    for n in range(10_000):
        intake.receive(f"robot/{n}", "", b"x")
        intake.receive("robot/state", f"text/{n}", b"x")
    intake.receive("robot/scan", "", bags.scan(2))
    arrivals = intake.take_batch()
    assert len({(one.key, one.encoding) for one in arrivals}) == MAX_CHANNELS
    assert arrivals[-1].header.seq == 2
    assert len(intake.seen) <= MAX_CHANNELS + 1
    assert intake.dropped == {OTHER_KEYS: 20_002 - len(arrivals)}


def test_viewers_get_every_second_state_and_each_intent_once(tmp_path: Path) -> None:
    file = BagWriter(tmp_path / "a.mcap", viewers=True, notes={})
    for tick in range(50):  # one second
        for topic in (STATE, INTENT):
            said = replace(example(topic.type), seq=tick + 1, tick=tick, basis=tick // 5)
            file.add(bags.arrival(tick * 20_000_000, topic.key, codec.encode(said)))
    file.finish()
    file.close()
    drawn = Counter(channel.topic for channel, _, _ in Bag(file.path).messages())
    assert {name: drawn[name] for name in ("robot/state", "/viz/tf", "/viz/state_numbers")} == {
        "robot/state": 50, "/viz/tf": 25, "/viz/state_numbers": 25,
    }  # fmt: skip
    assert (drawn["robot/intent"], drawn["/viz/path"]) == (50, 10)


def test_the_writer_is_woken_when_a_quarter_of_the_queue_is_full() -> None:
    told: list[int] = []
    intake = Intake(4000, lambda: 1, lambda: told.append(1))
    for expected in (0, 0, 1, 1):
        intake.receive("robot/scan", "", bytes(400))
        assert len(told) == expected
    intake.release(intake.take_batch())
    for expected in (1, 1, 2):
        intake.receive("robot/scan", "", bytes(400))
        assert len(told) == expected


def exposures(count: int, *, boot: int = 7, basis_step: int = 5) -> Iterator[tuple[str, bytes]]:
    """Yield depth and picture of a camera at 10 Hz, as it publishes them."""
    for seq in range(1, count + 1):
        header = {"seq": seq, "boot": boot, "basis": basis_step * seq, "tick": 5 * seq}
        header["stamp_ns"] = bags.BEGIN_NS + 100_000_000 * seq
        yield "robot/depth/front", msgspec.msgpack.encode(header | {"planes": b"d" * 100})
        yield "robot/image/front", msgspec.msgpack.encode(header | {"data": b"i" * 50})


def bases(path: Path, key: str) -> list[int]:
    return [sample.header.basis for sample in Bag(path) if sample.key == key]


@pytest.mark.parametrize(
    ("hz", "kept_bases"), [(2.0, [5, 30, 55, 80]), (3.0, [5, 25, 40, 55, 75, 90]), (0.0, [])]
)
def test_pictures_are_thinned_to_the_wanted_rate_and_depth_stays_with_its_picture(
    tmp_path: Path, hz: float, kept_bases: list[int]
) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, replace(QUICK, pictures=hz)) as recorder:
        for key, payload in exposures(20):
            recorder.intake.receive(key, "", payload)
        recorder.intake.receive("robot/state", "", bags.state(1))
    assert bases(path, "robot/image/front") == kept_bases
    assert bases(path, "robot/depth/front") == kept_bases
    assert recorder.intake.left_out["robot/image/front"] == 20 - len(kept_bases)
    assert recorder.intake.bytes["robot/depth/front"] >= 100 * len(kept_bases)
    assert recorder.status().missing == recorder.status().dropped == 0
    found = read_info(path)
    assert [key.missing for key in found.keys] == [0] * len(found.keys)
    assert found.notes["gigabrain"] == {"pictures": f"{hz:g} Hz"}


def test_without_a_rate_all_pictures_are_recorded(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, QUICK) as recorder:
        for key, payload in exposures(20):
            recorder.intake.receive(key, "", payload)
    assert len(bases(path, "robot/image/front")) == 20


def test_a_camera_whose_clock_stands_still_or_begins_again_is_thinned_too(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, replace(QUICK, pictures=2.0)) as recorder:
        for boot in (7, 8):
            for key, payload in exposures(20, boot=boot):
                recorder.intake.receive(key, "", payload)
        for _ in range(50):
            for key, payload in exposures(1, boot=9, basis_step=400):
                recorder.intake.receive(key, "", payload)
    assert bases(path, "robot/image/front") == [*[5, 30, 55, 80] * 2, 400]


def test_a_flood_of_eight_cameras_costs_pictures_and_no_memory(tmp_path: Path) -> None:
    """A second of 8 cameras at 100 Hz, 30 kB a picture, while the disk takes nothing.

    What is kept, 32 pictures and 100 states, is 1.05 MB.
    """
    path = tmp_path / "a.mcap"
    recorder = Recorder(path, replace(QUICK, pictures=2.0, queue_mb=1.1))
    body = bytes(30_000)
    for seq in range(1, 101):
        for camera in range(8):
            header = {"seq": seq, "boot": 7, "basis": seq, "stamp_ns": bags.BEGIN_NS}
            payload = msgspec.msgpack.encode(header | {"data": body})
            recorder.intake.receive(f"robot/image/cam{camera}", "", payload)
        recorder.intake.receive("robot/state", "", bags.state(seq))
    with recorder:
        pass
    assert kept(path)["robot/state"] == 100
    assert len(bases(path, "robot/image/cam3")) == 4  # of 100 ticks, which are 2 s
    assert recorder.status().dropped == 0
    assert recorder.intake.left_out["robot/image/cam3"] == 96


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"garbage",
        b"{",
        msgspec.msgpack.encode({"basis": -5, "boot": -1, "stamp_ns": 2**70 % 7}),
    ],
)
def test_pictures_that_are_no_messages_are_thinned_too(tmp_path: Path, payload: bytes) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, replace(QUICK, pictures=2.0)) as recorder:
        for _ in range(200):
            recorder.intake.receive("robot/image/front", "", payload)
    assert len(list(Bag(path))) < 5


def test_a_key_is_listed_with_control_characters_escaped(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap", QUICK) as recorder:
        recorder.intake.receive("robot/\x1b[2J\nx", "", b"{}")
    assert _key_line(recorder, "robot/\x1b[2J\nx").startswith("  robot/\\x1b[2J\\nx ")
