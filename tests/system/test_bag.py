"""Light commands start without the libraries for recordings."""

import subprocess
import sys


def test_the_command_line_starts_without_importing_mcap() -> None:
    code = "import sys, gigabrain_zenoh.cli.app; print([m for m in sys.modules if 'mcap' in m])"
    done = subprocess.run((sys.executable, "-c", code), capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
