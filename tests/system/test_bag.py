"""Recordings on disk: written, read back, damaged, cut off, recovered."""

import subprocess
import sys


def test_the_light_commands_do_not_need_the_recorder() -> None:
    code = "import sys, gigabrain_zenoh.cli.app; print([m for m in sys.modules if 'mcap' in m])"
    told = subprocess.run((sys.executable, "-c", code), capture_output=True, text=True, check=True)
    assert told.stdout == "[]\n"
