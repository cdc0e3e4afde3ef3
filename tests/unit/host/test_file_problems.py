"""Errors of files say in words what is wrong and what to do, without the system's text."""

import errno
import os
from pathlib import Path

import pytest

from gigabrain_zenoh.cli.app import _call
from gigabrain_zenoh.errors import ConfigError, DiskFull
from gigabrain_zenoh.host.files import cannot_read, cannot_write, check_new_file
from tests.places import ROOT

BAG = ROOT / "tests/recordings/arena.mcap"
WRITING = (
    "schema export {}",
    f"bag recover {BAG} -o {{}}",
    f"bag plot {BAG} cmd_vel.linear_x -o {{}}.png",
    f"bag convert {BAG} --csv {{}}",
    "driver new myrobot --folder {}",
    "process new lamp --folder {}",
    "keys new home --dir {}",
    "foxglove --layout {}",
    "param save {}",
)
READING = (
    "bag info {}",
    "bag check {}",
    "bag play {}",
    "replay --check {} --process safety",
    "mission {}",
    "patrol {}",
    "config demo --settings {}",
    "ros2 topics --types {}",
    "faults --only 1 --into {}",
)


def error(code: int) -> OSError:
    return OSError(code, os.strerror(code))


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        (errno.EACCES, "no permission; change its rights, or choose another place"),
        (errno.EEXIST, "that name is taken; choose another"),
        (errno.EISDIR, "it is a folder; name a file"),
        (errno.ENOENT, "no such file or folder; check the path"),
        (errno.ENOTDIR, "a part of the path is a file, not a folder; check the path"),
        (errno.EROFS, "the disk is read-only; choose another place"),
        (errno.ENOSPC, "the disk is full; free some space"),
        (errno.EIO, f"{os.strerror(errno.EIO)}; choose another file"),
    ],
)
def test_a_problem_is_named_with_its_remedy(code: int, problem: str) -> None:
    assert str(cannot_write("x", error(code))) == f"cannot write x: {problem}"
    assert str(cannot_read("x", error(code))) == f"cannot read x: {problem}"


def test_only_space_helps_a_full_disk() -> None:
    full, closed = (cannot_write("x", error(code), "set XDG") for code in (errno.ENOSPC, 13))
    assert (type(full), str(full)) == (
        DiskFull,
        "cannot write x: the disk is full; free some space",
    )
    assert (type(closed), str(closed)) == (ConfigError, "cannot write x: no permission; set XDG")


@pytest.mark.parametrize("line", [*WRITING, *READING])
@pytest.mark.parametrize("path", ["file/x", "/proc/none/x"])
def test_a_command_names_the_problem_of_its_file(
    line: str, path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "no robots"))
    (tmp_path / "file").write_text("")
    code, shown = _call(line.format(path).split()), capsys.readouterr().err
    assert code == 2
    assert shown.startswith("gigabrain: ")
    assert shown.count("\n") == 1
    assert path.split("/x")[0] in shown
    assert not any(os.strerror(number) in shown for number in errno.errorcode), shown
    assert "Errno" not in shown


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("file", "file exists; choose another file"),
        ("file/x", "file is not a folder; choose another path"),
        ("closed/x", "closed; choose another folder"),
    ],
)
def test_a_new_file_is_refused_where_it_cannot_be_created(
    name: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "closed").mkdir()
    monkeypatch.setattr(os, "access", lambda folder, _: Path(folder).name != "closed")
    check_new_file(tmp_path / "new" / "x")
    with pytest.raises(ConfigError) as caught:
        check_new_file(tmp_path / name)
    assert str(caught.value).endswith(problem)
