"""The file of `gigabrain render` and `view --picture`, without drawing."""

import contextlib
import errno
import os
from pathlib import Path

import numpy as np
import pytest

from gigabrain_zenoh.errors import ConfigError

pytest.importorskip("mujoco")
from gigabrain_drivers.sim import picture


@pytest.mark.parametrize(
    ("number", "problem"),
    [
        ("ENOSPC", "the disk is full; free some space"),
        ("EACCES", "no permission; change its rights, or choose another place"),
    ],
)
def test_a_picture_that_cannot_be_written_is_named_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: str, problem: str
) -> None:
    def write(*_: object) -> int:
        raise OSError(code, os.strerror(code))

    code = getattr(errno, number)
    monkeypatch.setattr(picture, "_graphics", lambda *_: contextlib.nullcontext())
    monkeypatch.setattr(picture, "_draw", lambda *_: np.zeros((1440, 2560, 3), np.uint8))
    monkeypatch.setattr(Path, "write_bytes", write)
    with pytest.raises(ConfigError) as error:
        picture.portray("turtlebot3_waffle", "arena", 0, tmp_path / "x.png")
    assert str(error.value) == f"cannot write {tmp_path / 'x.png'}: {problem}"
