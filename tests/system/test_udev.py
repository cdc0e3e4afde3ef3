"""The udev rules are well-formed, and know the devices that the robots' files name."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

RULES = Path(__file__).parents[2] / "deploy" / "70-gigabrain.rules"


@pytest.mark.skipif(not shutil.which("udevadm"), reason="no udevadm on this machine")
def test_udev_itself_finds_nothing_wrong() -> None:
    version = subprocess.run(["udevadm", "--version"], capture_output=True, text=True, check=True)
    if int(re.findall(r"\d+", version.stdout)[0]) < 254:
        pytest.skip("udevadm verify came with systemd 254")
    subprocess.run(["udevadm", "verify", "--no-style", str(RULES)], check=True)
