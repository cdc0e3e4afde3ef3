"""Process priorities: driver, control and safety stop the robot, so they have priority."""

import os
import subprocess
import sys

import pytest

from gigabrain_zenoh.host.this_process import HIGH_PRIORITY_NICE
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import Home, endpoint_of

NOBODY_UID = 65534
GO_FIRST = f"""
import os, sys
from gigabrain_zenoh.host.this_process import AUTOGROUP, go_first
if "nobody" in sys.argv:
    os.setuid({NOBODY_UID})
go_first()
print(os.getpriority(os.PRIO_PROCESS, 0))
print(AUTOGROUP.read_text() if AUTOGROUP.exists() else "")
"""

needs_rights = pytest.mark.skipif(os.geteuid() != 0, reason="only root may go first")


def going_first(*words: str, own_session: bool = True) -> tuple[int, str]:
    """Run a process that calls `go_first`; return its niceness and its session's autogroup line."""
    done = subprocess.run(
        (sys.executable, "-c", GO_FIRST, *words),
        start_new_session=own_session, capture_output=True, text=True, check=True,
    )  # fmt: skip
    nice, session = done.stdout.split("\n", 1)
    return int(nice), session.strip()


def session_has_nice(session: str, nice: int) -> bool:
    """Return whether a session has this niceness; True where sessions have none."""
    return not session or session.endswith(f" nice {nice}")


@needs_rights
def test_a_high_priority_includes_the_whole_session() -> None:
    nice, session = going_first()
    assert nice == HIGH_PRIORITY_NICE
    assert session_has_nice(session, HIGH_PRIORITY_NICE)


START_FIRST = """
from gigabrain_zenoh.host.this_process import AUTOGROUP, join_in, start_first
for change in (start_first, join_in):
    change()
    print(AUTOGROUP.read_text().strip() if AUTOGROUP.exists() else "")
"""


@needs_rights
def test_the_brain_has_priority_until_it_is_ready() -> None:
    done = subprocess.run(
        (sys.executable, "-c", START_FIRST),
        start_new_session=True, capture_output=True, text=True, check=True,
    )  # fmt: skip
    first, then = done.stdout.splitlines()
    assert session_has_nice(first, HIGH_PRIORITY_NICE)
    assert session_has_nice(then, 0)


@needs_rights
def test_the_priority_of_a_shared_session_is_not_changed() -> None:
    nice, session = going_first(own_session=False)
    assert nice == HIGH_PRIORITY_NICE
    assert session_has_nice(session, 0)


def test_without_the_rights_the_priority_stays_unchanged() -> None:
    nice, session = going_first("nobody" if os.geteuid() == 0 else "")
    assert nice == os.getpriority(os.PRIO_PROCESS, 0)
    assert session_has_nice(session, 0)


@needs_rights
async def test_driver_control_and_safety_of_a_robot_have_priority(home: Home) -> None:
    file = home.deployment()
    home.start("up", str(file))
    async with probing(endpoint_of(file)) as seen:
        found = {
            name: os.getpriority(os.PRIO_PROCESS, await seen.pid(name))
            for name in ("driver", "perception", "decision", "control", "safety")
        }
    assert found == {
        "driver": HIGH_PRIORITY_NICE, "perception": 0, "decision": 0,
        "control": HIGH_PRIORITY_NICE, "safety": HIGH_PRIORITY_NICE,
    }  # fmt: skip
