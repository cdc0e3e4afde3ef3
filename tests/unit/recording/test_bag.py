"""Recordings on disk: written, read back, damaged, cut off, recovered."""

import dataclasses
import json
import random
import shutil
import sys
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import TOPICS
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.headers import Header, SequenceGaps, header_of
from gigabrain_zenoh.cli.app import make_app
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording import message_tables
from gigabrain_zenoh.recording.bag_reader import (
    HEAD,
    MAGIC,
    ZSTD_NAME,
    Bag,
    Sample,
    faults,
    read_info,
    samples,
)
from gigabrain_zenoh.recording.bag_writer import BagWriter, ReceivedMessage
from gigabrain_zenoh.recording.drawn import flat_schema
from gigabrain_zenoh.recording.recovery import is_unfinished, recover, recover_all
from tests.unit.recording import bags


def call(*arguments: str) -> object:
    return make_app(arguments)(
        arguments, exit_on_error=False, print_error=False, result_action="return_value"
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "whole.mcap"
    assert bags.write(path, bags.drive(500)) == 600
    return path


def test_messages_are_read_byte_for_byte_with_key_encoding_and_schema(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.mcap"
    told = [*bags.drive(20), bags.arrival(10**9, "strange/key", b"\xc1 no message")]
    twist = bags.arrival(10**9 + 1, "robot/teleop", b'{"linear_x": 0.2}')
    told.append(twist._replace(encoding="application/json"))
    bags.write(path, iter(told))
    read = list(Bag(path))
    assert [(s.log_ns, s.key, s.encoding, s.payload) for s in read] == [
        (a.log_ns, a.key, a.encoding, a.payload) for a in told
    ]
    assert [s.schema for s in read[-3:]] == ["gigabrain.LaserScan", "", "gigabrain.Twist"]


def test_a_key_that_only_one_body_obeys_has_the_schema_of_its_encoding(tmp_path: Path) -> None:
    path, command = tmp_path / "a.mcap", codec.encode(CmdVel(linear_x=0.2, source="control"))
    told = bags.arrival(0, "base/cmd", command)._replace(encoding=codec.encoding_of(CmdVel))
    bags.write(path, iter([told]))
    (read,) = Bag(path)
    with path.open("rb") as file:
        ((schema, _, _),) = make_reader(file).iter_messages()
    assert schema
    assert (read.schema, schema.name) == ("gigabrain.CmdVel", "gigabrain.CmdVel")


def test_other_programs_read_it_by_its_index(whole: Path) -> None:
    with whole.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary
        assert summary.statistics
        assert summary.statistics.message_count == 600
        messages = list(reader.iter_messages(topics=["robot/scan"]))
    assert len(messages) == 100
    schema, channel, message = messages[0]
    assert schema
    assert (schema.name, schema.encoding) == ("gigabrain.LaserScan", "jsonschema")
    assert (channel.message_encoding, message.sequence) == ("msgpack", 1)


def test_info_lists_the_keys_with_their_figures(
    whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = read_info(whole)
    assert (found.messages, found.seconds, found.finished) == (600, 9.981, True)
    scan, state = found.keys
    assert (scan.key, scan.message, scan.messages, scan.hz) == (
        "robot/scan", "LaserScan", 100, 10.0,
    )  # fmt: skip
    assert (state.messages, state.hz, state.missing, state.longest_gap_s) == (500, 50.0, 0, 0.02)
    assert call("bag", "info", str(whole), "--json") is None
    assert json.loads(capsys.readouterr().out)["keys"][1]["hz"] == 50.0
    assert call("bag", "check", str(whole)) == 0
    assert "complete, 600 messages in 9.981 s" in capsys.readouterr().out


def test_missing_messages_are_counted_and_make_the_check_fail(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gap.mcap"
    kept = [a for a in bags.drive(100) if not 30 <= a.header.seq <= 39]
    bags.write(path, iter(kept))
    assert {key.key: key.missing for key in read_info(path).keys} == {
        "robot/scan": 0,
        "robot/state": 10,
    }
    assert call("bag", "check", str(path)) == 1
    assert "robot/state: 10 messages are missing" in capsys.readouterr().out


def test_a_restarted_sender_is_not_a_gap() -> None:
    gaps = SequenceGaps()
    for seq, boot in ((5, 1), (6, 1), (9, 1), (2, 2), (3, 2), (9, 3)):
        gaps.count("robot/state", Header(seq=seq, boot=boot))
    assert gaps.missing["robot/state"] == 2 + 1 + 8
    assert gaps.restarts["robot/state"] == 2
    for seq, boot in ((5, 1), (6, 2), (7, 2), (1, 2)):
        gaps.count("robot/intent", Header(seq=seq, boot=boot))  # decision lives on
    assert (gaps.missing["robot/intent"], gaps.restarts["robot/intent"]) == (0, 1)


def test_a_count_that_jumps_too_far_is_a_restart() -> None:
    gaps = SequenceGaps()
    most = 2**63 - 1
    for seq in (5, most, 6, most - 1, 7, 1_000_008, 1_000_009, 2_000_011):
        gaps.count("robot/intent", Header(seq=seq))
    assert gaps.missing["robot/intent"] == 5 + 6 + 1_000_000
    assert gaps.restarts["robot/intent"] == 5


def test_two_senders_on_one_key_have_a_count_each() -> None:
    gaps = SequenceGaps()
    for seq, source in ((100, "control"), (1, "script"), (101, "control"), (2, "script")):
        gaps.count("robot/cmd_vel", Header(seq=seq, source=source))
    assert gaps.missing.total() == 0
    assert gaps.restarts.total() == 0


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"{", b"\x81\xa3seq\xa1x", b"[]", b"{}" * 9])
def test_an_invalid_message_has_an_empty_header(payload: bytes) -> None:
    assert header_of(payload) == Header()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "is empty"),
        (b"PNG and so on", "not a recording; expected an MCAP file"),
        (b"\x89MCAP1\r\n" + bytes(40), "is MCAP of version 1; version 0 can be read"),
    ],
)
def test_a_file_that_is_not_a_bag_is_refused_in_one_line(
    tmp_path: Path, content: bytes, complaint: str
) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    for command in (["info"], ["check"], ["recover"], ["plot", "state.pose.x"]):
        with pytest.raises(ConfigError, match=r"^[^\n]+$") as error:
            call("bag", command[0], str(path), *command[1:])
        assert str(error.value).endswith(complaint)
    with pytest.raises(ConfigError, match=r"cannot read .*: no such file"):
        call("bag", "info", str(tmp_path / "none.mcap"))


def test_a_flipped_byte_costs_its_chunk_and_no_other(
    whole: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = tmp_path / "flipped.mcap"
    content = bytearray(whole.read_bytes())
    content[content.index(ZSTD_NAME, len(content) // 2) + 100] ^= 0x10  # in what is compressed
    path.write_bytes(content)
    found = read_info(path)
    assert found.messages == 600 - 12
    assert len(found.damages) == 1
    assert faults(found)
    assert call("bag", "check", str(path)) == 1
    assert f"repair it with: gigabrain bag recover {path}\n" in capsys.readouterr().out
    call("bag", "convert", str(path), "--csv", str(tmp_path / "tables"))
    damage = found.damages[0].partition(": ")[2]
    assert caplog.messages == [f"{path}: {damage}; repair it with: gigabrain bag recover {path}"]
    mended = tmp_path / "mended.mcap"
    assert recover(path, mended).messages == 588
    assert bags.seqs(mended) == bags.seqs(path)
    assert read_info(mended).finished


def _record(kind: Opcode, content: bytes) -> bytes:
    return HEAD.pack(kind, len(content)) + content


@pytest.mark.parametrize(
    "malformed",
    [
        _record(Opcode.MESSAGE, bytes(10)),  # shorter than its fixed fields
        _record(Opcode.CHANNEL, bytes(4) + b"\xff" * 8),  # a topic longer than the record
        _record(Opcode.SCHEMA, bytes(10) + b"\xff\0\0\0x"),  # likewise its data
    ],
    ids=["message", "channel", "schema"],
)
def test_a_malformed_record_costs_no_other_of_its_chunk(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], malformed: bytes
) -> None:
    source, path = tmp_path / "source.mcap", tmp_path / "malformed.mcap"
    bags.write(source, bags.drive(4), flush_every=99)
    with source.open("rb") as file:
        records = StreamReader(file, emit_chunks=True).records
        chunk = next(each for each in records if isinstance(each, Chunk))
    content = zstandard.decompress(chunk.data, chunk.uncompressed_size)
    last = content.rindex(HEAD.pack(Opcode.MESSAGE, len(bags.state(4)) + 22))
    content = content[:last] + malformed + content[last:]
    inside = RecordBuilder()
    dataclasses.replace(
        chunk,
        data=content,
        compression="",
        uncompressed_size=len(content),
        uncompressed_crc=zlib.crc32(content),
    ).write(inside)
    end = _record(Opcode.DATA_END, bytes(4)) + _record(Opcode.FOOTER, bytes(20))
    path.write_bytes(MAGIC + inside.end() + end + MAGIC)
    assert bags.seqs(path) == [1, 2, 3, 4]
    found = read_info(path)
    assert found.damages == (f"byte 8: a record of {len(malformed) - 9} bytes is malformed",)
    call("bag", "check", str(path))
    assert f"repair it with: gigabrain bag recover {path}\n" in capsys.readouterr().out
    assert recover(path, tmp_path / "repaired.mcap").messages == 4


def test_a_file_without_messages_is_reported_by_recover(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "stub.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(12))
    assert call("bag", "recover", str(path)) == 1
    assert capsys.readouterr().out.endswith(f"{path}: nothing could be recovered\n")
    assert list(tmp_path.iterdir()) == [path]
    call("bag", "info", str(path))
    assert "\nempty\n" in capsys.readouterr().out


def test_flipped_bytes_anywhere_never_break_the_reader(whole: Path, tmp_path: Path) -> None:
    chance, content = random.Random(1), whole.read_bytes()
    path = tmp_path / "flipped.mcap"
    for _ in range(60):
        damaged = bytearray(content)
        at = chance.randrange(8, len(content))
        damaged[at] ^= 1 << chance.randrange(8)
        path.write_bytes(damaged)
        assert len(list(Bag(path))) >= 588 - 12, at


@pytest.mark.long
def test_a_file_cut_anywhere_can_be_read_up_to_the_cut(tmp_path: Path) -> None:
    path, cut = tmp_path / "open.mcap", tmp_path / "cut.mcap"
    bags.write(path, bags.drive(200), end=False)
    content = path.read_bytes()
    everything = bags.seqs(path)
    assert everything == list(range(1, 201))
    ends = sorted({*range(len(content) - 300, len(content)), *range(9, len(content), 499)})
    before = 0
    for end in ends:
        cut.write_bytes(content[:end])
        read = bags.seqs(cut)
        assert read == everything[: len(read)]
        assert len(read) >= before - 12, end  # a torn chunk gives what is whole of it
        before = max(before, len(read))
    assert before > 185


def test_a_cut_recording_is_recovered_into_one_with_an_index(tmp_path: Path) -> None:
    path = tmp_path / "open.mcap"
    bags.write(path, bags.drive(200), end=False)
    path.write_bytes(path.read_bytes()[:-50])
    left = bags.seqs(path)
    assert is_unfinished(path)
    assert call("bag", "recover", str(path)) == 0
    mended = tmp_path / "open_recovered.mcap"
    assert bags.seqs(mended) == left
    with mended.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert len(list(reader.iter_messages(topics="robot/state"))) == len(left) > 180
    with pytest.raises(ConfigError, match="exists; choose another file"):
        call("bag", "recover", str(path))


def test_the_next_start_recovers_only_files_that_were_cut_off(whole: Path, tmp_path: Path) -> None:
    cut, good, other = (tmp_path / name for name in ("cut.mcap", "good.mcap", "text.mcap"))
    bags.write(cut, bags.drive(100), end=False)
    shutil.copy(whole, good)
    other.write_text("no bag at all")
    busy = BagWriter(tmp_path / "busy.mcap", viewers=False, notes={})
    before = {path: path.read_bytes() for path in (good, other, busy.path)}
    recover_all(tmp_path, keep_free_mb=0)
    assert read_info(cut).finished
    assert bags.seqs(cut) == list(range(1, 101))
    assert {path: path.read_bytes() for path in before} == before
    assert len(list(tmp_path.iterdir())) == 4
    busy.close()


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
def test_every_schema_is_flat_enough_for_the_viewers(topic: object) -> None:
    def walk(part: object) -> None:
        assert isinstance(part, dict)
        assert not {"$ref", "$defs", "anyOf"} & part.keys()
        assert "type" in part
        for inner in part.get("properties", {}).values():
            walk(inner)
        if part["type"] == "array":
            assert part["items"]["type"] != "array"
            walk(part["items"])

    schema = json.loads(flat_schema(topic.type))  # type: ignore[attr-defined]
    assert schema["title"] == topic.type.__name__  # type: ignore[attr-defined]
    walk(schema)


def test_tables_have_a_row_per_message(whole: Path, tmp_path: Path) -> None:
    assert call("bag", "convert", str(whole), "--csv", str(tmp_path / "csv")) is None
    rows = (tmp_path / "csv" / "robot_state.csv").read_text().splitlines()
    assert len(rows) == 501
    names, first = rows[0].split(","), rows[1].split(",")
    assert first[names.index("velocity.linear_x")] == "0.01"
    scans = (tmp_path / "csv" / "robot_scan.csv").read_text().splitlines()
    assert scans[0].split(",")[-1] == "ranges.359"


def test_tables_of_a_recording_that_grows_meanwhile_are_those_of_its_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, folder = tmp_path / "grows.mcap", tmp_path / "csv"
    file = BagWriter(path, viewers=False, notes={})

    def grow(more: Iterable[ReceivedMessage]) -> None:
        for each in more:
            file.add(each)
        file.flush()

    def read(path: Path) -> Iterator[Sample]:
        yield from samples(path)
        grow(bags.arrival(10**9 + n, f"robot/{key}", getattr(bags, key)(n))
             for n in range(1, 9) for key in ("state", "scan"))  # fmt: skip

    grow(bags.arrival(n, "robot/state", bags.state(n)) for n in range(1, 21))
    monkeypatch.setattr(message_tables, "samples", read)
    assert message_tables.write_csv(path, folder) == [folder / "robot_state.csv"]
    file.close()
    assert len((folder / "robot_state.csv").read_text().splitlines()) == 21


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_named_in_one_line(whole: Path, tmp_path: Path) -> None:
    (tmp_path / ".robot_scan.csv.new").symlink_to("/dev/full")
    with pytest.raises(ConfigError, match=r"^cannot write \S+: the disk is full; free some space$"):
        message_tables.write_csv(whole, tmp_path)


def test_tables_need_no_package_for_datasets(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "gigabrain_zenoh.recording.lerobot", raising=False)
    assert call("bag", "convert", str(whole), "--csv", str(tmp_path / "csv")) is None
    with pytest.raises(ConfigError, match="datasets need pyarrow: pip install"):
        call("bag", "convert", str(whole), "--lerobot", str(tmp_path / "dataset"))


def test_a_plot_is_a_picture_and_an_unknown_field_names_the_nearest(
    whole: Path, tmp_path: Path
) -> None:
    picture = tmp_path / "p.png"
    assert (
        call("bag", "plot", str(whole), "robot/state.velocity.linear_x", "-o", str(picture)) is None
    )
    assert picture.read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(ConfigError, match=r"did you mean 'state.velocity.linear_y'\?"):
        call("bag", "plot", str(whole), "state.velocity.linear_z")
    with pytest.raises(ConfigError, match=r"no topic 'stat.pose.x'; did you mean 'state'\?"):
        call("bag", "plot", str(whole), "stat.pose.x")


def test_a_plot_does_not_replace_its_recording(whole: Path, tmp_path: Path) -> None:
    path, link = tmp_path / "a.mcap", tmp_path / "link.mcap"
    shutil.copy(whole, path)
    link.symlink_to(path)
    for output in (path, link):
        with pytest.raises(ConfigError, match=f"^{output} is the recording; name another file"):
            call("bag", "plot", str(path), "state.pose.x", "-o", str(output))
    assert len(bags.seqs(path)) == 500


def test_settings_are_kept_for_a_replay(tmp_path: Path) -> None:
    notes = {"decision": msgspec.json.encode({"turn": "left"}).decode()}
    BagWriter(tmp_path / "n.mcap", viewers=False, notes=notes).close()
    bag = Bag(tmp_path / "n.mcap")
    assert list(bag) == []
    assert bag.notes["gigabrain"] == notes
