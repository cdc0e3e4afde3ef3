"""A calibration takes a person's time: what would lose it is found before it begins."""

import os
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.feetech.calibrate import calibrate
from gigabrain_zenoh.cli.calibrating import Terminal
from gigabrain_zenoh.errors import ConfigError
from tests.unit.drivers.feetech import OPTIONS, ROBOT


@pytest.mark.parametrize(
    ("name", "reason"),
    [("file/so101.yaml", "Not a directory"), ("folder", "Is a directory")],
)
async def test_a_file_that_cannot_be_written_is_refused_before_an_arm_is_touched(
    tmp_path: Path, name: str, reason: str
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    options, path = replace(OPTIONS, port=str(tmp_path / "no_port")), tmp_path / name
    with pytest.raises(ConfigError, match=f"cannot write {path}: {reason}"):
        await calibrate(ROBOT, options, path, Terminal())


async def test_a_refused_calibration_leaves_the_one_before(tmp_path: Path) -> None:
    options, path = replace(OPTIONS, port=str(tmp_path / "no_port")), tmp_path / "so101.yaml"
    path.write_text("joints: {}\n")
    with pytest.raises(ConfigError, match="no_port"):
        await calibrate(ROBOT, options, path, Terminal())
    assert os.listdir(tmp_path) == ["so101.yaml"]
    assert path.read_text() == "joints: {}\n"
