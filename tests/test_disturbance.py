"""A test that failed while the machine stood still is run again alone, and no other."""

import asyncio
import fcntl
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from tests.stack import ROOT, SOURCES, until
from tests.turns import Turns

CONFTEST = """
from pathlib import Path
import pytest
from tests import disturbance
from tests.conftest import pytest_runtest_protocol, pytest_terminal_summary
from tests.turns import Turns
disturbance.STALL_S = {stall_s}
disturbance.TURNS = Turns(Path(__file__), Path(__file__).with_name("test_it.py"))
"""
FRAGILE = """
from pathlib import Path
import pytest
RUNS = Path(__file__).with_name("runs")

@pytest.fixture(scope="module")
def run():
    number = int(RUNS.read_text()) + 1 if RUNS.exists() else 1
    RUNS.write_text(str(number))
    return number

{marker}
def test_fragile(run):
    assert run > {good_after}

def test_firm(run):
    assert run
"""


def outcome(folder: Path, stall_s: float, good_after: int, marker: str = "") -> tuple[str, str]:
    """What is said at the end, and how often the module's fixture was made."""
    (folder / "conftest.py").write_text(CONFTEST.format(stall_s=stall_s))
    (folder / "test_it.py").write_text(FRAGILE.format(good_after=good_after, marker=marker))
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = once\n")
    command = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(folder))
    path = ":".join(map(str, SOURCES))
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, env={"PYTHONPATH": path}
    )
    return done.stdout, (folder / "runs").read_text()


def test_what_fails_while_the_machine_stands_still_is_run_again_from_the_start(
    tmp_path: Path,
) -> None:
    said, made = outcome(tmp_path, stall_s=0.0, good_after=2)
    assert "2 passed" in said
    assert "the machine had stood still: test_it.py::test_fragile" in said.replace("\n", "")
    assert made == "3"


def test_what_fails_three_times_has_failed(tmp_path: Path) -> None:
    said, _ = outcome(tmp_path, stall_s=0.0, good_after=3)
    assert "1 failed, 1 passed" in said


@pytest.mark.parametrize(("stall_s", "marker"), [(1e9, ""), (0.0, "@pytest.mark.once")])
def test_what_fails_on_a_machine_that_keeps_time_or_sees_to_it_itself_has_failed(
    tmp_path: Path, stall_s: float, marker: str
) -> None:
    said, made = outcome(tmp_path, stall_s, good_after=1, marker=marker)
    assert "1 failed, 1 passed" in said
    assert "stood still" not in said
    assert made == "1"


async def test_who_wants_to_be_alone_waits_for_the_others_and_they_for_him(tmp_path: Path) -> None:
    door, room = tmp_path / "door", tmp_path / "room"
    door.touch()
    room.touch()
    said: list[str] = []

    async def begin(turn: Callable[[], None], name: str) -> None:
        await asyncio.to_thread(turn)
        said.append(name)

    with ExitStack() as stack:
        one, two, wants = (stack.enter_context(closing(Turns(door, room))) for _ in range(3))
        one.beside()
        two.beside()  # not in the way of one another
        alone = asyncio.create_task(begin(wants.alone, "alone"))
        one.leave()
        await until(lambda: shut(door), "the door is shut")
        late = asyncio.create_task(begin(one.beside, "late"))
        assert not said
        two.leave()
        await alone
        assert said == ["alone"]
        wants.leave()
        await late
        assert said == ["alone", "late"]


def shut(door: Path) -> bool:
    """Whether nobody may begin."""
    with door.open() as mine:
        try:
            fcntl.flock(mine, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
