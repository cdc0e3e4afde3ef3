"""Recordings that were cut off are recovered in place when the next one starts."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.records import Channel, Message, Schema
from mcap.writer import Writer

from gigabrain_zenoh.recording import recovery
from gigabrain_zenoh.recording.bag_reader import ZSTD_NAME, Bag, read_info
from gigabrain_zenoh.recording.bag_writer import BagWriter
from gigabrain_zenoh.recording.recovery import Recovered, recover, recover_all
from tests.unit.recording import bags


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    path = tmp_path / "cut.mcap"
    bags.write(path, bags.drive(100), end=False)
    return path


def test_a_file_whose_copy_would_fill_the_disk_stays_as_it_is(
    cut: Path, caplog: pytest.LogCaptureFixture
) -> None:
    inode, free_mb = cut.stat().st_ino, shutil.disk_usage(cut.parent).free / 1e6
    recover_all(cut.parent, keep_free_mb=free_mb + 1e6)
    assert (cut.stat().st_ino, list(cut.parent.iterdir())) == (inode, [cut])
    (text,) = caplog.messages
    assert text.startswith(f"{cut} was cut off, and is not recovered: a copy of 0.")
    assert text.endswith(f"; make space, or: gigabrain bag recover {cut} -o FILE")
    recover_all(cut.parent, keep_free_mb=0)
    assert read_info(cut).finished


def test_a_file_that_another_program_writes_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "ros.mcap"
    with path.open("wb") as file:
        foreign = Writer(file, use_chunking=False)
        foreign.start("ros2", "libmcap 1.4.0")
        channel = foreign.register_channel("/chatter", "cdr", 0)
        foreign.add_message(channel, 1, b"first", 1)
        file.flush()
        recover_all(tmp_path, keep_free_mb=0)
        foreign.add_message(channel, 2, b"second", 2)
        foreign.finish()
    assert [each.data for _, _, each in Bag(path).messages()] == [b"first", b"second"]


def test_a_file_that_is_being_copied_stays_as_it_is(
    cut: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, content = cut.with_name("copy.mcap"), cut.read_bytes()
    cut.unlink()
    with path.open("wb", buffering=0) as copying:
        copying.write(content[:-500])

        def recover_meanwhile(source: Path, to: Path) -> Recovered:
            done = recover(source, to)
            copying.write(content[-500:])
            return done

        monkeypatch.setattr(recovery, "recover", recover_meanwhile)
        recover_all(path.parent, keep_free_mb=0)
    assert (path.stat().st_size, list(path.parent.iterdir())) == (len(content), [path])


def test_two_recorders_that_start_at_once_recover_a_file_once(
    cut: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recovered: list[Path] = []

    def recover_twice(source: Path, to: Path) -> Recovered:
        recovered.append(source)
        if len(recovered) == 1:
            recover_all(cut.parent, keep_free_mb=0)
        return recover(source, to)

    monkeypatch.setattr(recovery, "recover", recover_twice)
    recover_all(cut.parent, keep_free_mb=0)
    assert recovered == [cut]
    assert bags.seqs(cut) == list(range(1, 101))


def _damage_first_chunk(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[content.index(ZSTD_NAME) + 100] ^= 0x10  # in what is compressed
    path.write_bytes(content)


def test_a_cut_file_whose_first_chunk_is_damaged_loses_that_chunk_alone(cut: Path) -> None:
    _damage_first_chunk(cut)
    assert bags.seqs(cut) == list(range(11, 101))  # two scans are lost as well
    recover_all(cut.parent, keep_free_mb=0)
    assert bags.seqs(cut) == list(range(11, 101))


def test_messages_of_keys_whose_declaration_is_lost_are_reported(
    cut: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = cut.with_name("old.mcap")
    monkeypatch.setattr(BagWriter, "_declare_again", lambda *_: None)
    bags.write(path, bags.drive(100), end=False)
    _damage_first_chunk(path)
    lost = "108 messages of keys that only damaged parts declare cannot be read"
    assert lost in [damage.partition(": ")[2] for damage in read_info(path).damages]


def test_a_recovery_that_is_interrupted_leaves_no_file(
    cut: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def messages(_: Bag) -> Iterator[tuple[Channel, Schema | None, Message]]:
        raise KeyboardInterrupt  # as Ctrl-C does in a command
        yield

    monkeypatch.setattr(Bag, "messages", messages)
    with pytest.raises(KeyboardInterrupt):
        recover(cut, cut.with_name("recovered.mcap"))
    assert list(cut.parent.iterdir()) == [cut]


def test_drawings_for_viewers_are_copied_but_not_counted(tmp_path: Path) -> None:
    file = BagWriter(tmp_path / "drawn.mcap", viewers=True, notes={})
    for each in bags.drive(20):
        file.add(each)
    file.finish()
    file.close()
    done = recover(file.path, tmp_path / "copy.mcap")
    assert (done.messages, read_info(done.path).messages) == (24, 24)
    assert len(list(Bag(done.path).messages())) == len(list(Bag(file.path).messages())) > 24
