"""A picture is a PNG, so a command refuses a file whose name says another format."""

import os
from pathlib import Path

import pytest

from gigabrain_zenoh.cli.app import _call
from gigabrain_zenoh.host.files import check_picture_path


@pytest.mark.parametrize(
    "command",
    [
        "graph --png",
        "render",
        "view --picture",
        "bench plan --png",
        "bench slam --log none.npz --png",
        "bag plot drive.mcap state.pose.x -o",
    ],
)
@pytest.mark.parametrize("name", ["x.jpg", "x"])
def test_a_picture_needs_the_name_of_a_png(
    command: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / name
    assert _call([*command.split(), str(file)]) == 2
    said = f"gigabrain: cannot write {file}: it would be a PNG; expected a name like x.png\n"
    assert capsys.readouterr().err == said
    assert not file.exists()


def test_a_pipe_may_have_any_name(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    check_picture_path(tmp_path / "pipe")
