"""Old run folders are removed, but never one that is in use."""

import errno
import os
import time
from pathlib import Path

import pytest

from gigabrain_zenoh.host import run_folders


def runs(base: Path, count: int, size: int = 10) -> list[Path]:
    made = [base / f"2026010{i}T000000Z-demo-{i}" for i in range(count)]
    for path in made:
        (path / "state").mkdir(parents=True)
        (path / "state" / "driver.jsonl").write_bytes(bytes(size))
    return made


def test_a_new_run_removes_the_oldest_beyond_the_number_that_is_kept(tmp_path: Path) -> None:
    made = runs(tmp_path, 6)
    run_folders.prune(tmp_path, max_runs=4)
    assert sorted(tmp_path.iterdir()) == made[3:]  # and the new one makes four


def test_a_new_run_removes_the_oldest_beyond_the_bytes_that_are_kept(tmp_path: Path) -> None:
    made = runs(tmp_path, 6, size=100)
    run_folders.prune(tmp_path, max_bytes=250)
    assert sorted(tmp_path.iterdir()) == made[4:]


def test_each_new_run_tidies_up_and_is_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_folders.prune, "__defaults__", (3, 10**9))
    made = runs(tmp_path, 5)
    new = run_folders.new_run_dir(tmp_path, "demo")
    assert sorted(tmp_path.iterdir()) == [*made[3:], new]
    run_folders.prune(tmp_path, max_runs=1)
    assert sorted(tmp_path.iterdir()) == [new]


def test_runs_are_in_order_also_where_the_clock_has_stepped_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (old,) = runs(tmp_path, 1)  # of an earlier version, in 2026
    made = []
    for stamp in ("20260301T000000Z", "20000101T000000Z", "20000101T000000Z"):
        monkeypatch.setattr(time, "strftime", lambda *_, stamp=stamp: stamp)
        made.append(run_folders.new_run_dir(tmp_path, "demo"))
    assert run_folders.past_runs(tmp_path) == [old, *made]
    monkeypatch.setattr(run_folders, "_in_use", lambda _: False)
    run_folders.prune(tmp_path, max_runs=3)
    assert run_folders.past_runs(tmp_path) == made[1:]


def test_a_run_has_its_folder_where_a_full_disk_takes_no_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    assert run_folders.past_runs(tmp_path) == []
    new = run_folders.new_run_dir(tmp_path, "demo")
    assert run_folders.past_runs(tmp_path) == [new]


@pytest.mark.skipif(os.getuid() == 0, reason="root may remove anything")
def test_what_cannot_be_removed_stays(tmp_path: Path) -> None:
    (made,) = runs(tmp_path, 1)
    made.chmod(0o500)
    run_folders.prune(tmp_path, max_runs=1)
    assert made.exists()
    made.chmod(0o700)
