import asyncio
import errno
import os
from pathlib import Path

import pytest

from gigabrain_drivers.driver import gatekeeper
from gigabrain_drivers.driver.gatekeeper import Latched, LatchFile
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.errors import ConfigError, DiskFull
from gigabrain_zenoh.gate.causes import NAN_STORM, estop


def test_nothing_is_latched_before_anything_was(tmp_path: Path) -> None:
    assert LatchFile(tmp_path / "new").read() == Latched()


def test_what_was_latched_is_there_after_a_restart(tmp_path: Path) -> None:
    file = LatchFile(tmp_path)
    file.read()
    file.write(Latched(causes=(estop("ann"), NAN_STORM), estop_generation=3))

    again = LatchFile(tmp_path).read()
    assert [cause.code for cause in again.causes] == ["estop", "nan_storm"]
    assert again.estop_generation == 3


def test_a_release_is_remembered_too(tmp_path: Path) -> None:
    file = LatchFile(tmp_path)
    file.read()
    file.write(Latched(causes=(estop("ann"),), estop_generation=1))
    file.write(Latched(estop_generation=1))
    assert LatchFile(tmp_path).read() == Latched(causes=(), estop_generation=1)


@pytest.mark.parametrize("content", [b"", b"{", b'{"causes": 3}', b"\xff\xfe", b"[" * 100_000])
def test_a_file_that_cannot_be_read_counts_as_latched(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "latch.json").write_bytes(content)
    causes = LatchFile(tmp_path).read().causes
    assert [(cause.code, cause.latching) for cause in causes] == [("latch_unreadable", True)]


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"cannot write .*file/state: a part of the path"):
        LatchFile(tmp_path / "file" / "state").read()


def test_on_a_full_disk_what_was_latched_is_read_and_a_first_start_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    was = Latched(causes=(estop("ann"),), estop_generation=1)
    LatchFile(tmp_path).write(was)

    def full(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(gatekeeper, "replace_file", full)
    assert LatchFile(tmp_path).read() == was
    with pytest.raises(DiskFull, match=r"cannot write .*new: the disk is full; [^\n]*$"):
        LatchFile(tmp_path / "new").read()


@pytest.mark.parametrize("content", [b"", None])
async def test_a_driver_that_cannot_keep_its_latch_waits_until_there_is_space(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    content: bytes | None,
) -> None:
    clock = FakeClock()
    folder = tmp_path if content is None else tmp_path / "robot"
    if content is not None:
        folder.mkdir()
        (folder / "latch.json").write_bytes(content)

    def full(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as before:
        before.setattr(gatekeeper, "replace_file", full)
        waiting = asyncio.ensure_future(gatekeeper.wait_for_disk(folder, clock))
        await clock.advance(60_000_000_000)
        assert not waiting.done()
    await clock.advance(1_000_000_000)
    await waiting
    assert (folder / "latch.json").stat().st_size
    ((line, data),) = ((one.getMessage(), vars(one)["data"]) for one in caplog.records)
    assert data == {"event": "disk full"}  # by which a demo knows it
    assert line.startswith(f"cannot write {folder}: the disk is full; free some space")
