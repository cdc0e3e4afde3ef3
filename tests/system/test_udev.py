"""The udev rules are well-formed."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

RULES = Path(__file__).parents[2] / "deploy" / "70-gigabrain.rules"


@pytest.mark.skipif(not shutil.which("udevadm"), reason="no udevadm on this machine")
def test_udevadm_accepts_the_rules() -> None:
    version = subprocess.run(["udevadm", "--version"], capture_output=True, text=True, check=True)
    if int(re.findall(r"\d+", version.stdout)[0]) < 254:
        pytest.skip("udevadm verify came with systemd 254")
    subprocess.run(["udevadm", "verify", "--no-style", str(RULES)], check=True)
