"""The page that `gigabrain demo` shows in a terminal, and Ctrl-C typed there."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator

import pytest
from rich.cells import cell_len

from gigabrain_zenoh.testing.processes import AVOID, GIGABRAIN, Home
from gigabrain_zenoh.testing.waiting import until

# make this process the leader of the terminal's session, as a shell does, then run the command
AT_TERMINAL = "import os, sys; os.login_tty(0); os.execv(sys.argv[1], sys.argv[1:])"
COLUMNS, ROWS = 80, 24
HOME = "\x1b[H"
EXPECTED_LINES = [
    r"\d\.\d\d m in \d+ of 600 s",
    r"\d+ %  1\d\.\d V",
    *(
        rf"│  {name} +ready +\d+ +\d+\.\d % +\d+ MB  \S"
        for name in ("router", "driver", "perception", "decision", "control", "safety")
    ),
    r"decision .* \d+% · (forward|turning right)",
    r"control .* [+-]\d\.\d\d m/s  [+-]\d\.\d\d rad/s",
]
CONTROL = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]")


class Terminal:
    """A terminal of 80 x 24 in which a `gigabrain` command runs."""

    def __init__(self, home: Home, *arguments: str) -> None:
        self._screen, tty = pty.openpty()
        fcntl.ioctl(tty, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        os.set_blocking(self._screen, False)
        environment = {
            k: v for k, v in home.environment.items() if k not in ("COLUMNS", "NO_COLOR")
        }
        self._process = subprocess.Popen(
            (sys.executable, "-c", AT_TERMINAL, *GIGABRAIN, *arguments),
            stdin=tty, stdout=tty, stderr=tty,
            env=environment | {"TERM": "xterm-256color"},
        )  # fmt: skip
        os.close(tty)
        self.shown = ""

    @property
    def running(self) -> bool:
        """Return whether the command still runs. Also reads its new output."""
        try:
            while data := os.read(self._screen, 65536):
                self.shown += data.decode()
        except BlockingIOError:
            pass
        except OSError:  # Linux's error when no process has the terminal open
            return False
        return self._process.poll() is None

    def shows(self, text: str) -> bool:
        """Return whether the command runs and its newest page contains `text`."""
        return self.running and any(text in line for line in self.page())

    def page(self) -> list[str]:
        """Return the lines of the newest complete page."""
        pages = self.shown.split(HOME)
        return CONTROL.sub("", pages[-2] if len(pages) > 2 else "").splitlines()

    def text(self) -> str:
        """Return the newest complete page."""
        return "\n".join(self.page())

    def type(self, keys: str) -> None:
        """Press keys."""
        os.write(self._screen, keys.encode())

    async def ended(self) -> int:
        """Wait for the command's end; return its exit code."""
        await until(lambda: not self.running, "the end of the command")
        return self._process.wait(5.0)

    def close(self) -> None:
        """Kill the command and close the terminal."""
        self._process.kill()
        self._process.wait(5.0)
        os.close(self._screen)


@pytest.fixture
def terminal(home: Home) -> Iterator[Terminal]:
    place = Terminal(home, *AVOID, "--world", "house", "--seconds", "600")
    yield place
    place.close()


@pytest.mark.slow
async def test_the_page_shows_the_whole_robot_and_ctrl_c_ends_it(
    home: Home, terminal: Terminal
) -> None:
    await until(lambda: terminal.shows("enabled") and terminal.shows(" ms (p99 "), "driving")
    for pattern in EXPECTED_LINES:  # processes appear as they start
        await until(
            lambda pattern=pattern: terminal.running and re.search(pattern, terminal.text()),
            pattern,
        )
    page = terminal.page()
    assert len(page) <= ROWS
    assert {cell_len(line) for line in page if line.strip()} == {COLUMNS}
    assert "turtlebot3_waffle · house · seed 0" in page[0]
    terminal.type("\x03")
    assert await terminal.ended() == 0
    assert home.processes() == []
    last = CONTROL.sub("", terminal.shown.rpartition("\x1b[?1049l")[2])
    assert "Ctrl-C ends it" in last  # the last page stays, with the result below
    assert re.search(r"\d\.\d\d m in \d+ s, \d+ turns?, 0 contacts, closest", last)
    assert "Traceback" not in terminal.shown
