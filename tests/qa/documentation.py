"""Runs the commands and programs of README.md and docs/: `python -m tests.qa.documentation`.

A block of `sh` or `python` runs in a folder of its page, with `sh` line by line. `blocks.py`
describes the comments before blocks. A line that ends in `&` runs until the end of its block. Pages
share a robot, which is stopped before a block that starts one: two robots would delay each other.
Other blocks are checked. Arguments are the names of pages; the default is all. It prints the number
of blocks by kind, and exits with 1 if one fails.
"""

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.places import ROOT
from tests.qa.blocks import RUN, Block, blocks, pages, problem

LINE_TIMEOUT_S = 180.0  # for a line or a program
JUDGES = ("gigabrain why", "gigabrain doctor")  # their exit codes are results
USAGE, INTERRUPTED = 2, 130
MODE = "gigabrain topic echo state -n 1 --fields gate.mode"
BODIES = {"robot": "turtlebot3_waffle", "arm": "so101"}  # of the robot beside a block
STARTS_ROBOT = re.compile(r"^gigabrain (bench|demo|faults|up)\b", re.MULTILINE)
Words = str | Sequence[str]


class Home:
    """The folders of a user, and a robot in them if a block needs one."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._body = ""
        self._robot: subprocess.Popen[bytes] | None = None

    def environment(self, place: Path, body: str) -> dict[str, str]:
        """Return the environment of a page in `place`; with `body`, that robot is found in it."""
        run = self.folder / f"run-{body}" if body else place / "run"
        run.mkdir(exist_ok=True, mode=0o700)
        return os.environ | {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONPATH": str(place / "site"),
            "XDG_RUNTIME_DIR": str(run),
            "XDG_STATE_HOME": str(self.folder / "state"),
            "XDG_DATA_HOME": str(self.folder / "data"),
            "XDG_CONFIG_HOME": str(self.folder / "config"),
        }

    def robot(self, body: str) -> None:
        """Replace the robot by one with this body, unless it runs; wait until it may drive."""
        environment = self.environment(self.folder, body)
        running = self._robot is not None and self._body == body
        if not running:
            self.close()
            words = f"exec gigabrain demo --headless --no-page --world arena --body {body}"
            self._robot = start(words, self.folder, environment, subprocess.DEVNULL)
            self._body = body
        until_enabled(self.folder, environment, driven=running)

    def close(self) -> None:
        """End the robot, if there is one."""
        if self._robot is not None:
            self._robot.send_signal(signal.SIGINT)
            self._robot.wait(60)
            self._robot = None


def start(
    words: Words, folder: Path, environment: dict[str, str], out: int = subprocess.PIPE
) -> subprocess.Popen[bytes]:
    """Start a shell line or a program in its own process group."""
    return subprocess.Popen(
        words,
        shell=isinstance(words, str),
        executable="/bin/bash" if isinstance(words, str) else None,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=out,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


def start_behind(
    words: str, folder: Path, environment: dict[str, str], behind: contextlib.ExitStack
) -> None:
    """Start a shell line that runs until Ctrl-C at the end of `behind`."""
    process = start(words, folder, environment, subprocess.DEVNULL)
    behind.callback(_end_of, process)
    behind.callback(os.killpg, process.pid, signal.SIGINT)


def until_enabled(folder: Path, environment: dict[str, str], *, driven: bool = False) -> None:
    """Wait until a robot may drive; if it was `driven` before, enable it again.

    Raises TimeoutError.
    """
    end_s = time.monotonic() + LINE_TIMEOUT_S
    while b"enabled" not in start(MODE, folder, environment).communicate()[0]:
        if time.monotonic() > end_s:
            raise TimeoutError("no robot drives")
        if driven:
            start("gigabrain release; gigabrain enable", folder, environment).wait()
        time.sleep(0.5)


def run(words: Words, folder: Path, environment: dict[str, str], after_s: float) -> str:
    """Run words to their end, or until Ctrl-C; return the fault, empty without one."""
    process = start(words, folder, environment)
    judges = isinstance(words, str) and words.startswith(JUDGES)
    good = {*range(INTERRUPTED)} - {USAGE} if judges else {0}
    try:
        out, _ = process.communicate(timeout=after_s or LINE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        good = {0, INTERRUPTED} if after_s else set()
        os.killpg(process.pid, signal.SIGINT)
        out = _end_of(process)
    if process.returncode in good and b"Traceback" not in out:
        return ""
    return f"exit code {process.returncode}\n{out.decode(errors='replace')[-1500:]}"


def _end_of(process: subprocess.Popen[bytes]) -> bytes:
    try:
        return process.communicate(timeout=30)[0]
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return process.communicate()[0]


def as_installed(line: str) -> str:
    """Change a line of `pip install` to install into the page's folder, or to a dry run."""
    words = shlex.split(line, comments=True)
    if words[:2] != ["pip", "install"]:
        return line
    what = shlex.join(word for word in words[2:] if word != "-e")
    pip = "python -m pip --disable-pip-version-check"
    if Path(words[-1]).name == words[-1] and "[" not in words[-1]:
        return f"{pip} install --quiet --no-deps --target site ./{what}"
    return f"{pip} install --dry-run --no-index {what}"


def run_block(home: Home, folder: Path, block: Block, page: contextlib.ExitStack) -> str:
    """Run a block, at most until the end of `page`; return the fault, empty without one."""
    body = next((known for word, known in BODIES.items() if word in block.value), "")
    if body:
        home.robot(body)
    elif STARTS_ROBOT.search(block.text):
        home.close()
    environment = home.environment(folder, body)
    ended = re.search(r"(\d+) s", block.value)
    after_s = float(ended[1]) if ended else 0.0
    if block.value == "stays":
        start_behind(block.text, folder, environment, page)
        until_enabled(folder, environment)
        return ""
    if block.language == "python":
        (folder / "program.py").write_text(block.text)
        return run((sys.executable, "program.py"), folder, environment, after_s)
    with contextlib.ExitStack() as behind:
        for line in block.text.splitlines():
            if line.endswith("&"):
                start_behind(line[:-1], folder, environment, behind)
                time.sleep(3)
            elif wrong := run(as_installed(line), folder, environment, after_s):
                return f"{line}\n{wrong}"
    return ""


def data_of(block: Block) -> Path | None:
    """Return the folder of the data that a block needs; None if it is missing."""
    root = os.environ.get("GIGABRAIN_DATA")
    folder = Path(root or "", block.value.partition(",")[0])
    return folder if root and folder.is_dir() else None


def judge(
    home: Home, page: Path, folder: Path, behind: contextlib.ExitStack
) -> Iterator[tuple[str, str]]:
    """Run the blocks of a page; yield the kind and the fault of each."""
    (folder / "deploy").symlink_to(ROOT / "deploy")
    found = list(blocks(page))
    for block in found:
        if block.verb == "file":
            path = folder / block.value
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text)
    for block in found:
        if wrong := problem(block):
            yield "FAILED", f"{page.name}:{block.line}: {wrong}"
        elif block.verb == "not run":
            yield f"not run: {block.value}", ""
        elif block.language == "text":
            yield "output", ""
        elif block.verb == "file" or block.language not in RUN:
            yield f"checked: {block.language}", ""
        elif block.verb == "data" and not data_of(block):
            yield "not run: data that is not here", ""
        else:
            if source := block.verb == "data" and data_of(block):
                for path in source.iterdir():
                    with contextlib.suppress(FileExistsError):
                        (folder / path.name).symlink_to(path)
            began_s = time.monotonic()
            wrong = run_block(home, folder, block, behind)
            print(f"{page.name}:{block.line}: {time.monotonic() - began_s:.0f} s", flush=True)
            yield "FAILED" if wrong else "run", wrong and f"{page.name}:{block.line}: {wrong}"


def main() -> None:
    """Run all pages; print the counts and the failures."""
    chosen = [ROOT / name for name in sys.argv[1:]] or pages()
    counts: Counter[str] = Counter()
    wrong = []
    with tempfile.TemporaryDirectory(prefix="docs-") as name:
        home = Home(Path(name))
        with contextlib.closing(home):
            for number, page in enumerate(chosen):
                folder = Path(name, f"page{number}")
                folder.mkdir()
                with contextlib.ExitStack() as behind:
                    for kind, text in judge(home, page, folder, behind):
                        counts[kind] += 1
                        if text:
                            print(text, flush=True)
                            wrong.append(text)
                shutil.rmtree(folder, ignore_errors=True)
    for kind, count in sorted(counts.items()):
        print(f"{count:4} {kind}")
    hardware = sum(count for kind, count in counts.items() if "hardware" in kind)
    print(f"{hardware} blocks need hardware; {len(wrong)} failed", *wrong, sep="\n")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
