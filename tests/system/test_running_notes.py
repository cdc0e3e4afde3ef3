"""Notes of running robots, which supervisors write on this machine."""

import subprocess
import sys
from pathlib import Path

import pytest

from gigabrain_zenoh.runtime.running import folder, running


@pytest.fixture(autouse=True)
def notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return folder()


def test_the_note_of_a_dead_supervisor_is_removed(notes: Path) -> None:
    program = (
        "import os\nfrom gigabrain_zenoh.runtime.running import announced, Endpoint\n"
        "with announced('ghost', Endpoint(connect=('tcp/127.0.0.1:1',))): os.kill(os.getpid(), 9)"
    )
    subprocess.run((sys.executable, "-c", program), check=False)
    (note,) = notes.iterdir()
    assert running() == []
    assert not note.exists()
