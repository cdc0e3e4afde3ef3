"""Runs the Dockerfile's steps without Docker, for minutes: `python -m tests.qa.dockerfile_steps`.

COPY and RUN of the build stage go into a new folder. Then the final stage's command runs with only
its ENV, until its HEALTHCHECK succeeds. The base image, users, and removals of the final stage are
left out.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.places import ROOT

DOCKERFILE = ROOT / "deploy" / "docker" / "Dockerfile"
HEALTHY_TIMEOUT_S = 300.0  # the first start compiles
END_TIMEOUT_S = 10.0

Step = tuple[str, str]  # instruction, and its arguments


def stages() -> list[list[Step]]:
    """Return the instructions of each stage."""
    text = re.sub(r"^#.*\n", "", DOCKERFILE.read_text(), flags=re.MULTILINE)
    lines = text.replace("\\\n", " ").splitlines()
    found: list[list[Step]] = []
    for line in filter(None, lines):
        word, _, rest = line.partition(" ")
        if word == "FROM":
            found.append([])
        found[-1].append((word, rest.strip()))
    return found


def only(steps: list[Step], word: str) -> str:
    """Return the arguments of the only instruction of a kind."""
    (rest,) = (rest for each, rest in steps if each == word)
    return rest


def extras() -> set[str]:
    """Return the names of the extras that the image installs."""
    (named,) = re.findall(r"pip install .*'\.\[(.*)\]'", only(stages()[0], "RUN"))
    return set(named.split(","))


def command() -> list[str]:
    """Return the default command of the image: its ENTRYPOINT and CMD."""
    final = stages()[-1]
    return [*json.loads(only(final, "ENTRYPOINT")), *json.loads(only(final, "CMD"))]


class Image:
    """The image's folders, each in its own place."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._places = {
            "/opt/gigabrain": folder / "opt",
            "/var/lib": folder / "lib",
            "/run/gigabrain": folder / "run",
        }

    def build(self) -> None:
        """Run the build stage."""
        source, python = self._folder / "src", self._folder / "bin" / "python"
        source.mkdir()
        python.parent.mkdir()
        python.symlink_to(sys.executable)
        for word, rest in stages()[0]:
            if word == "COPY":
                self._copy(source, *rest.split())
            elif word == "RUN":
                path = f"{python.parent}:{os.environ['PATH']}"
                run = ("sh", "-ec", self._here(rest))
                subprocess.run(run, cwd=source, env=os.environ | {"PATH": path}, check=True)

    def start(self) -> subprocess.Popen[bytes]:
        """Start the final stage's command, like a user without a home directory."""
        work = self._folder / "lib" / "gigabrain"
        for folder in (work, self._folder / "run"):
            folder.mkdir(mode=0o700, parents=True)
        return subprocess.Popen(command(), cwd=work, env=self._env(), start_new_session=True)

    def healthy(self) -> bool:
        """Run the HEALTHCHECK, and return whether it succeeds."""
        check = only(stages()[-1], "HEALTHCHECK").partition("CMD ")[2]
        return not subprocess.run(
            ("sh", "-c", self._here(check)), stdout=subprocess.DEVNULL
        ).returncode

    def _env(self) -> dict[str, str]:
        pairs = re.findall(r"(\w+)=(\S+)", self._here(only(stages()[-1], "ENV")))
        env = {"HOME": "/nonexistent", "PATH": "/usr/bin:/bin"}
        for name, value in pairs:
            env[name] = value.replace("$PATH", env["PATH"])
        return env

    def _here(self, text: str) -> str:
        for path, place in self._places.items():
            text = re.sub(rf"(?<![\w/]){path}(?![\w-])", str(place), text)
        return text

    @staticmethod
    def _copy(to: Path, *words: str) -> None:
        *names, target = words
        for name in names:
            at = ROOT / name
            if at.is_dir():
                shutil.copytree(at, to / target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(at, to / target)


def fault_of(image: Image, started: subprocess.Popen[bytes]) -> str:
    """Wait until it is healthy, then stop it. Return the fault; empty without one."""
    end_s = time.monotonic() + HEALTHY_TIMEOUT_S
    while not image.healthy():
        if started.poll() is not None:
            return f"ended with {started.returncode}"
        if time.monotonic() > end_s:
            return f"was not healthy within {HEALTHY_TIMEOUT_S:.0f} s"
        time.sleep(1.0)
    started.send_signal(getattr(signal, only(stages()[-1], "STOPSIGNAL")))
    try:
        code = started.wait(END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return f"did not end within {END_TIMEOUT_S:.0f} s of its STOPSIGNAL"
    return f"ended with {code} after its STOPSIGNAL" if code else ""


def main() -> int:
    """Build, start, and end it; return 1 if one of these fails."""
    with tempfile.TemporaryDirectory(prefix="img-") as folder:
        image = Image(Path(folder))
        image.build()
        started = image.start()
        try:
            fault = fault_of(image, started)
        finally:
            if started.poll() is None:
                os.killpg(started.pid, signal.SIGKILL)
                started.wait()
    print(*command(), fault or "is healthy, and ends when it is told to")
    return bool(fault)


if __name__ == "__main__":
    sys.exit(main())
