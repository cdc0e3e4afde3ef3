"""The path of a result is checked before a long run, and nothing is left there."""

import os
from pathlib import Path

import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import check_result_path


def test_a_path_that_can_be_written_is_left_as_it_was(tmp_path: Path) -> None:
    there, link = tmp_path / "there", tmp_path / "link"
    there.write_text("kept")
    link.symlink_to(tmp_path / "later")
    os.mkfifo(tmp_path / "pipe")
    for name in ("there", "new", "link", "pipe"):
        check_result_path(tmp_path / name)
    assert {file.name for file in tmp_path.iterdir()} == {"there", "link", "pipe"}
    assert there.read_text() == "kept"
    check_result_path(None)


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("none/x", "no such folder; create it first"),
        (".", "it is a folder; name a file"),
        ("x" * 300, "the name is too long; choose a shorter one"),
        ("/proc/x.json", "no such file or folder; check the path"),
    ],
)
def test_a_path_that_cannot_be_written_is_refused(tmp_path: Path, name: str, fault: str) -> None:
    with pytest.raises(ConfigError) as error:
        check_result_path(tmp_path / name)
    assert str(error.value) == f"cannot write {tmp_path / name}: {fault}"
