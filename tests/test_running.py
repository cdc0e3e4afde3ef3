"""Which robots run here: the notes that supervisors leave, and who reads them."""

import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from gigabrain_zenoh.errors import BusError, ConfigError
from gigabrain_zenoh.running import Running, announced, find_endpoint, folder, running
from gigabrain_zenoh.settings import Endpoint

HERE = Endpoint(connect=("tcp/127.0.0.1:7001",), namespace="alpha")


@pytest.fixture(autouse=True)
def notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return folder()


def leave_note(folder: Path, pid: int, namespace: str) -> Path:
    endpoint = Endpoint(connect=(f"tcp/127.0.0.1:{pid}",), namespace=namespace)
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / f"{pid}.json"
    note.write_bytes(msgspec.json.encode(Running(pid=pid, label=namespace, endpoint=endpoint)))
    return note


def test_a_robot_is_found_for_as_long_as_its_supervisor_says(notes: Path) -> None:
    with announced("waffle in arena", HERE):
        assert running() == [Running(pid=os.getpid(), label="waffle in arena", endpoint=HERE)]
        assert find_endpoint(None) == HERE
        assert [path.name for path in notes.iterdir()] == [f"{os.getpid()}.json"]
    assert running() == []
    assert list(notes.iterdir()) == []


def test_the_note_of_a_dead_supervisor_is_taken_away(notes: Path) -> None:
    dead = subprocess.Popen((sys.executable, "-c", ""))
    dead.wait()
    note = leave_note(notes, dead.pid, "ghost")
    assert running() == []
    assert not note.exists()


def test_a_note_that_cannot_be_read_is_taken_away(notes: Path) -> None:
    notes.mkdir(parents=True)
    (notes / "1.json").write_text("{")
    assert running() == []
    assert list(notes.iterdir()) == []


def test_of_several_robots_the_namespace_chooses(notes: Path) -> None:
    leave_note(notes, os.getpid(), "alpha")
    leave_note(notes, os.getppid(), "beta")
    assert find_endpoint(None, "beta").namespace == "beta"
    with pytest.raises(BusError, match=r"several robots run here; choose one with --connect: "):
        find_endpoint(None)
    with pytest.raises(BusError, match="no robot runs here"):
        find_endpoint(None, "gamma")


def test_who_is_told_where_it_is_does_not_look() -> None:
    assert find_endpoint("tcp/10.0.0.1:7447", "beta") == Endpoint(
        connect=("tcp/10.0.0.1:7447",), namespace="beta"
    )


def test_a_folder_that_cannot_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "file"))
    with pytest.raises(ConfigError, match=r"cannot write .*; set XDG_RUNTIME_DIR$"):  # noqa: SIM117
        with announced("waffle", HERE):
            pass
