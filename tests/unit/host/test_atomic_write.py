"""Atomic writes: a file that was reported as written survives a power cut, always whole."""

import os
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gigabrain_drivers.driver.gatekeeper import Latched, LatchFile
from gigabrain_zenoh.config.map_image import SavedMap
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskFile
from gigabrain_zenoh.gate.causes import estop
from gigabrain_zenoh.host import files
from gigabrain_zenoh.mapping import map_file
from gigabrain_zenoh.security.authority import write_list
from gigabrain_zenoh.security.identity_files import LIST


class Disk:
    """A disk as a power cut would leave it: only synced contents and synced names remain."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._contents: dict[int, bytes] = {}
        self._names: dict[int, dict[str, int]] = {}
        self._root = root
        self.full = False
        real = os.fsync

        def fsync(fd: int) -> None:
            if self.full:
                raise OSError(28, "No space left on device")
            real(fd)
            about = os.fstat(fd)
            place = Path(f"/proc/self/fd/{fd}").resolve()
            if stat.S_ISDIR(about.st_mode):
                self._names[about.st_ino] = {e.name: e.inode() for e in os.scandir(place)}
            else:
                self._contents[about.st_ino] = place.read_bytes()

        monkeypatch.setattr(os, "fsync", fsync)
        folder = os.open(root, os.O_RDONLY)
        fsync(folder)
        os.close(folder)

    def left(self, path: Path) -> bytes | None:
        """The content of a file after a power cut now; None where it has no name."""
        inode: int | None = self._root.stat().st_ino
        for part in path.relative_to(self._root).parts:
            inode = self._names.get(inode or 0, {}).get(part)
        return None if inode is None else self._contents.get(inode, b"")


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(tmp_path, monkeypatch)


def test_what_replace_file_has_written_survives_a_power_cut(tmp_path: Path, disk: Disk) -> None:
    path = tmp_path / "note"
    for content in (b"one", b"two"):
        files.replace_file(path, content)
        assert disk.left(path) == content
    assert [file.name for file in tmp_path.iterdir()] == ["note"]


def test_on_a_full_disk_the_old_content_stays_and_no_draft(tmp_path: Path, disk: Disk) -> None:
    path = tmp_path / "note"
    files.replace_file(path, b"one")
    disk.full = True
    with pytest.raises(OSError, match="No space left"):
        files.replace_file(path, b"two")
    assert path.read_bytes() == b"one"
    assert [file.name for file in tmp_path.iterdir()] == ["note"]


def test_a_file_is_created_once_whole_and_private(tmp_path: Path, disk: Disk) -> None:
    path = tmp_path / "tokens"
    files.create_file(path, b"secret")
    assert disk.left(path) == b"secret"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with pytest.raises(FileExistsError):
        files.create_file(path, b"other")
    assert path.read_bytes() == b"secret"
    assert [file.name for file in tmp_path.iterdir()] == ["tokens"]


def test_a_new_folder_survives_with_all_its_parents(tmp_path: Path, disk: Disk) -> None:
    path = tmp_path / "a" / "b" / "note"
    files.make_folder(path.parent)
    files.replace_file(path, b"one")
    assert disk.left(path) == b"one"


def write_latch(folder: Path) -> Path:
    file = LatchFile(folder / "state")
    file.read()
    file.write(Latched(causes=(estop("ann"),), estop_generation=1))
    return folder / "state" / "latch.json"


def write_tasks(folder: Path) -> Path:
    assert TaskFile(str(folder / "state")).write([Saved()]) == ""
    return folder / "state" / "tasks.json"


def write_revoked(folder: Path) -> Path:
    write_list(folder, {"robot": 2})
    return folder / LIST


def write_map(folder: Path) -> Path:
    cells = np.zeros((100, 120), np.int8)
    cells[0] = 100
    path = folder / "maps" / "room.yaml"
    map_file.save(path, SavedMap(cells, 0.05, 0.0, 0.0), {})
    return path


@pytest.mark.parametrize("write", [write_latch, write_tasks, write_revoked, write_map])
def test_every_file_that_must_survive_does(
    write: Callable[[Path], Path], tmp_path: Path, disk: Disk
) -> None:
    path = write(tmp_path)
    assert disk.left(path) == path.read_bytes()
