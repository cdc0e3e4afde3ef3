"""Send signals to every command at random moments of its life: `python -m tests.qa.signal_sweep`.

Results go line by line into a file; a second call goes on where the first was stopped. A trial is
fixed by its seed and number: `--only "topic echo" --first 17 --moments 1` repeats one.
"""

import argparse
import contextlib
import itertools
import os
import random
import signal
import subprocess
import sys
import time
import uuid
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
from msgspec import Struct

from gigabrain_zenoh.testing.processes import GIGABRAIN, Home, free_port
from tests.places import ROOT
from tests.qa.signal_commands import CALLS, OWN_CODES

LIMIT_S = 2.0  # from the signal to the end, without the time without a processor
PATIENCE_S = 20.0
MAX_LIFE_S = 5.0  # of a command, for the moments of signals
MARK = "GIGABRAIN_SIGNAL_SWEEP"
NOISE = ("Traceback", "Exception ignored", "Error in", "never awaited", "Fatal")


class Trial(Struct, frozen=True, kw_only=True):
    """One signal to one command."""

    command: str
    number: int
    signal: str
    at_s: float
    code: int
    took_s: float  # from the signal to the end
    waited_s: float  # part of it without a processor
    problem: str = ""


class Stage:
    """The environment of the commands: a robot, a bare router, files and folders.

    Without `robot` there is only a router, which tools use like a robot.
    """

    def __init__(self, folder: Path, *, robot: bool = True) -> None:
        self.folder, self.home = folder, Home(folder / "home")
        self._names = itertools.count()
        self._elsewhere = Home(folder / "elsewhere") if robot else self.home  # its note is hidden
        self.router = self.robot = f"tcp/127.0.0.1:{free_port()}"
        self._elsewhere.start("router", "--listen", self.router)
        if robot:
            self._start_robot()
        (folder / "patrol.yaml").write_text("points: [[0.5, 0], [0, 0]]\n")
        (folder / "mission.yaml").write_text("do: [{wait: 3000}]\n")
        self._run("keys", "new", "fleet", "--dir", str(folder / "fleet"))

    def _start_robot(self) -> None:
        deployment = {"body": "mock", "link": "sim", "resume": "auto"}
        hosts = {"robot": ["router", "driver", "perception", "decision", "control", "safety"]}
        brain = {"behaviour": "navigate", "settings": {"start": "wait"}}
        values = deployment | {"hosts": hosts, "decision": brain, "perception": {"mapping": "slam"}}
        path = self.home.deployment(**values)
        self.robot = msgspec.json.decode(path.read_bytes())["router"]
        self.home.start("up", str(path))

    def _run(self, *words: str) -> None:
        done = subprocess.run((*GIGABRAIN, *words), env=self.home.environment, capture_output=True)
        if done.returncode:
            raise RuntimeError(done.stderr.decode())

    def words(self, command: str) -> list[str]:
        """Return the words of a command line, with a new name and a free port."""
        name = f"new_{next(self._names)}"
        places = {
            "robot": self.robot,
            "router": self.router,
            "port": free_port(),
            "file": self.folder / name,
            "name": name,
            "fleet": self.folder / "fleet",
            "patrol": self.folder / "patrol.yaml",
            "mission": self.folder / "mission.yaml",
            "bag": ROOT / "tests" / "recordings" / "arena.mcap",
            "deployment": self.home.deployment(body="mock", hosts={"robot": ["router", "driver"]}),
        }
        return CALLS[command].format(**places).split()

    def temporary(self, mark: str) -> Path:
        """Return the folder for the temporary files of a marked command."""
        folder = self.folder / f"tmp-{mark}"
        folder.mkdir(exist_ok=True)
        return folder

    def start(self, command: str, mark: str) -> subprocess.Popen[bytes]:
        """Start a command; it and its children have the mark in their environment."""
        terminal = command in ("teleop", "top")
        return subprocess.Popen(
            (*GIGABRAIN, *self.words(command)),
            stdin=os.openpty()[1] if terminal else subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=self.home.environment | {MARK: mark, "TMPDIR": str(self.temporary(mark))},
            start_new_session=True,
            cwd=self.folder,
        )

    def close(self) -> None:
        """End all processes."""
        self.home.close()
        self._elsewhere.close()


def handled(pid: int, number: int) -> bool:
    """Return whether a process has a handler for a signal (proc(5): SigCgt)."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("SigCgt:"):
                return bool(int(line.split()[1], 16) >> (number - 1) & 1)
    return False


def without_processor_s(pid: int) -> float:
    """Return the time that a process's threads waited for a processor [s] (schedstat)."""
    waited_ns = 0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError):
            waited_ns += int(path.read_text().split()[1])
    return waited_ns / 1e9


def left_behind(mark: str) -> list[int]:
    """Return the pids of processes with this mark in their environment."""
    pids = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if f"{MARK}={mark}".encode() in path.read_bytes():
                pids.append(int(path.parent.name))
    return pids


def life_s(stage: Stage, command: str) -> tuple[float, int | None]:
    """Run a command without a signal; return its duration [s] and its exit code.

    A command that runs for MAX_LIFE_S is killed; its exit code is None.
    """
    began_s, mark = time.monotonic(), uuid.uuid4().hex
    process = stage.start(command, mark)
    try:
        _, errors = process.communicate(timeout=MAX_LIFE_S)
        if b"Usage" in errors or process.returncode == 2:
            raise RuntimeError(f"{command}: {errors.decode()}")
        return time.monotonic() - began_s, process.returncode
    except subprocess.TimeoutExpired:
        return MAX_LIFE_S, None
    finally:
        _kill(process, mark)


def _kill(process: subprocess.Popen[bytes], mark: str) -> None:
    for pid in left_behind(mark):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()


def attempt(
    stage: Stage, command: str, number: int, name: str, at_s: float, own: set[int]
) -> Trial:
    """Start a command, send it the signal after `at_s`, and judge its end."""
    mark, wanted = uuid.uuid4().hex, signal.Signals[name]
    process = stage.start(command, mark)
    time.sleep(at_s)
    ready = handled(process.pid, signal.SIGTERM)  # Python always handles SIGINT
    before_s = waited_s = without_processor_s(process.pid)
    sent_s = time.monotonic()
    os.kill(process.pid, wanted)  # works also if it has ended, as it is not reaped yet
    while not _over(process.pid) and time.monotonic() < sent_s + PATIENCE_S:
        waited_s = max(waited_s, without_processor_s(process.pid))
        time.sleep(0.005)
    took_s = time.monotonic() - sent_s
    time.sleep(0.05)  # for children that die with their parent
    left = [_name(pid) for pid in left_behind(mark) if pid != process.pid]
    left += [path.name for path in stage.temporary(mark).iterdir()]
    _kill(process, mark)
    assert process.stderr
    with process.stderr as pipe:
        errors = pipe.read().decode(errors="replace")
    trial = Trial(
        command=command,
        number=number,
        signal=name,
        at_s=round(at_s, 4),
        code=process.returncode,
        took_s=round(took_s, 3),
        waited_s=round(waited_s - before_s, 3),
    )
    problem = _problem(trial, ready, errors, left, own)
    return msgspec.structs.replace(trial, problem=problem)


def _over(pid: int) -> bool:
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None


def _name(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()[:200]
    return str(pid)


def _problem(trial: Trial, ready: bool, errors: str, left: Sequence[str], own: set[int]) -> str:
    wanted = signal.Signals[trial.signal]
    if trial.took_s - trial.waited_s > LIMIT_S:
        return f"did not end in time, {'ready' if ready else 'not ready'}: {errors[-800:]}"
    if left:
        return f"left behind: {left}"
    # before a command's first line, the signal kills Python or interrupts its start
    codes = own | {128 + wanted} | (set() if ready else {-wanted, 1})
    if trial.code not in codes:
        return f"exit code {trial.code}, expected one of {sorted(codes)}: {errors[-800:]}"
    if ready and any(word in errors for word in NOISE):
        return f"complains: {errors[-800:]}"
    return ""


def sweep(commands: Sequence[str], moments: range, seed: int, results: Path) -> Counter[str]:
    """Run the trials that are not in `results` yet; return the number of problems by command."""
    done = {(t.command, t.number, t.signal) for t in read(results)}
    with TemporaryDirectory(prefix="signals-") as folder, results.open("ab", buffering=0) as out:
        stage = Stage(Path(folder))
        try:
            for command in commands:
                wanted = set(itertools.product([command], moments, ("SIGINT", "SIGTERM")))
                if wanted <= done:
                    continue
                life, code = life_s(stage, command)
                own = {0, *OWN_CODES.get(command, ()), *(() if code is None else (code,))}
                for number, name in itertools.product(moments, ("SIGINT", "SIGTERM")):
                    if (command, number, name) not in done:
                        at_s = random.Random(f"{seed} {command} {number} {name}").random() * life
                        trial = attempt(stage, command, number, name, at_s, own)
                        out.write(msgspec.json.encode(trial) + b"\n")
                        if trial.problem:
                            print(trial, flush=True)
        finally:
            stage.close()
    return Counter(t.command for t in read(results) if t.problem)


def read(results: Path) -> list[Trial]:
    """Return the trials of earlier calls; none if the file is missing."""
    lines = results.read_bytes().splitlines() if results.exists() else []
    return [msgspec.json.decode(line, type=Trial) for line in lines]


def main() -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--moments", type=int, default=100, help="for each command and signal")
    parser.add_argument("--first", type=int, default=0, help="number of the first moment")
    parser.add_argument("--only", action="append", choices=CALLS, help="this command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=Path("signals.jsonl"))
    given = parser.parse_args()
    moments = range(given.first, given.first + given.moments)
    problems = sweep(given.only or list(CALLS), moments, given.seed, given.results)
    trials = read(given.results)
    slowest = max((t.took_s - t.waited_s for t in trials), default=0.0)
    print(f"{len(trials)} signals, {problems.total()} problems, slowest end {slowest:.2f} s")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
