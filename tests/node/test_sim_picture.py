"""Pictures: the file format, and the error where nothing can be drawn."""

import struct
import sys
import zlib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from gigabrain_drivers.sim.body import SimBody
from gigabrain_drivers.sim.picture import png, render
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import ConfigError


def waffle() -> SimBody:
    model = files("gigabrain_drivers") / "bodies/turtlebot3_waffle/model.xml"
    return SimBody(model=model.read_text(), wheel_radius=0.033, wheel_separation=0.287)


def test_a_png_contains_the_given_pixels() -> None:
    pixels = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3) * 13
    data = png(pixels)
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">IIBB", data[16:26]) == (3, 2, 8, 2)
    length = struct.unpack(">I", data[33:37])[0]
    rows = np.frombuffer(zlib.decompress(data[41 : 41 + length]), np.uint8).reshape(2, 10)
    assert rows[:, 0].tolist() == [2, 2]
    assert np.array_equal(np.cumsum(rows[:, 1:], axis=0, dtype=np.uint8), pixels.reshape(2, 9))


def test_the_error_without_opengl_names_the_packages_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.setitem(sys.modules, "mujoco.cgl", None)
    with pytest.raises(ConfigError, match="apt-get install libegl1"):
        render(waffle(), load_world("arena", 0), 0, tmp_path / "robot.png", 32, 24)
    assert list(tmp_path.iterdir()) == []


def test_a_robot_is_drawn_with_opengl(tmp_path: Path) -> None:
    path = tmp_path / "pictures" / "robot.png"
    try:
        render(waffle(), load_world("house", 1), 1, path, 160, 90)
    except ConfigError as error:
        pytest.skip(str(error))
    data = path.read_bytes()
    assert struct.unpack(">II", data[16:24]) == (160, 90)
    assert len(data) > 3000
