"""Runs the commands and programs of README.md and docs/: `python -m tests.qa.documentation`.

A block of `sh` or `python` is run in a folder of its page, a line of `sh` at a time. An HTML
comment before it changes that:

    <!-- run: robot -->       beside a robot that drives
    <!-- run: 5 s -->         each line is ended by Ctrl-C after 5 s
    <!-- run: robot, 5 s -->  both
    <!-- file: NAME -->       the block is such a file, for the blocks of the page
    <!-- not run: REASON -->  it needs hardware, other hosts, hours, ...

Blocks without a language, and of other languages, are output or a part of a file. Pages may be
named behind the command. Ends with 1 where something fails.
"""

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from tests.places import ROOT

BLOCK = re.compile(
    r"^(?:<!-- (?P<mark>[^\n]*) -->\n)?```(?P<language>\w*)\n(?P<text>.*?)^```",
    re.MULTILINE | re.DOTALL,
)
LINE_S = 180.0  # for a line or a program
JUDGES = ("gigabrain why", "gigabrain doctor")  # their exit code says what is wrong
USAGE, INTERRUPTED = 2, 130
MODE = "gigabrain topic echo state -n 1 --fields gate.mode"


class Block(NamedTuple):
    """A fenced block of a page."""

    line: int
    language: str
    text: str
    verb: str  # "run", "not run", "file" or ""
    value: str


def blocks(page: Path) -> Iterator[Block]:
    """Yield the blocks of a page with what their comments say."""
    text = page.read_text("utf-8")
    for found in BLOCK.finditer(text):
        verb, _, value = (found["mark"] or "").partition(": ")
        line = text.count("\n", 0, found.start("language")) + 1
        verb = verb if verb in ("run", "not run", "file") else ""
        yield Block(line, found["language"], found["text"], verb, value)


class Place:
    """The folder of a page, and a robot in it once one is asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "deploy").symlink_to(ROOT / "deploy")
        self._robot: subprocess.Popen[bytes] | None = None

    @property
    def _environment(self) -> dict[str, str]:
        return os.environ | {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "XDG_STATE_HOME": str(self.folder / "state"),
            "XDG_RUNTIME_DIR": str(self.folder / "run"),
            "XDG_DATA_HOME": str(self.folder / "data"),
            "XDG_CONFIG_HOME": str(self.folder / "config"),
        }

    def start(
        self, words: str | Sequence[str], out: int = subprocess.PIPE
    ) -> subprocess.Popen[bytes]:
        """Start a line of a shell, or a program, in a process group of its own."""
        return subprocess.Popen(
            words,
            shell=isinstance(words, str),
            executable="/bin/bash" if isinstance(words, str) else None,
            cwd=self.folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    def robot(self) -> None:
        """Start a robot, unless it runs, and wait until it may drive."""
        if self._robot:
            return
        self._robot = self.start("exec gigabrain demo --headless", subprocess.DEVNULL)
        end_s = time.monotonic() + LINE_S
        while b"enabled" not in self.start(MODE).communicate()[0]:
            if time.monotonic() > end_s:
                raise TimeoutError("no robot drives")
            time.sleep(0.5)

    def close(self) -> None:
        """End the robot."""
        if self._robot:
            self._robot.send_signal(signal.SIGINT)
            self._robot.wait(60)


def run(place: Place, words: str | Sequence[str], after_s: float) -> str:
    """Run something, to its end or until Ctrl-C; return what is wrong, or an empty text."""
    process = place.start(words)
    judges = isinstance(words, str) and words.startswith(JUDGES)
    good = {*range(INTERRUPTED)} - {USAGE} if judges else {0}
    try:
        out, _ = process.communicate(timeout=after_s or LINE_S)
    except subprocess.TimeoutExpired:
        good = {0, INTERRUPTED} if after_s else set()
        os.killpg(process.pid, signal.SIGINT)
        try:
            out, _ = process.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, _ = process.communicate()
    if process.returncode in good and b"Traceback" not in out:
        return ""
    return f"exit code {process.returncode}\n{out.decode(errors='replace')[-1500:]}"


def try_block(place: Place, block: Block) -> str:
    """Run a block; return what is wrong, or an empty text."""
    if "robot" in block.value:
        place.robot()
    ended = re.search(r"(\d+) s", block.value)
    after_s = float(ended[1]) if ended else 0.0
    if block.language == "python":
        (place.folder / "program.py").write_text(block.text)
        return run(place, (sys.executable, "program.py"), after_s)
    for line in block.text.splitlines():
        if line.startswith("pip install"):
            continue  # this is installed
        if problem := run(place, line, after_s):
            return f"{line}\n{problem}"
    return ""


def judge(page: Path, folder: Path, counts: Counter[str]) -> list[str]:
    """Run what is to be run of a page; return what is wrong."""
    wrong, place = [], Place(folder)
    with contextlib.closing(place):
        for block in sorted(blocks(page), key=lambda block: block.verb != "file"):
            if block.verb == "file":
                path = folder / block.value
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(block.text)
                counts["file"] += 1
            elif block.verb == "not run":
                counts[f"not run: {block.value}"] += 1
            elif block.language not in ("sh", "python"):
                counts["output, or a part of a file"] += 1
            elif problem := try_block(place, block):
                counts["FAILED"] += 1
                wrong.append(f"{page.name}:{block.line}: {problem}")
            else:
                counts["run"] += 1
    return wrong


def main() -> None:
    """Run all pages, print the counts and what failed."""
    pages = [ROOT / name for name in sys.argv[1:]]
    counts: Counter[str] = Counter()
    wrong = []
    for page in pages or [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        with tempfile.TemporaryDirectory(prefix="docs-") as name:
            found = judge(page, Path(name), counts)
        print(f"{page.name}: {len(found)} failed", *found, sep="\n", flush=True)
        wrong += found
    for kind, count in sorted(counts.items()):
        print(f"{count:4} {kind}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
