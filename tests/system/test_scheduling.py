"""Process priorities: driver, control and safety, which stop the robot, go first."""

import os
import subprocess
import sys

import pytest

from gigabrain_zenoh.host.this_process import HIGH_PRIORITY_NICE
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import Home, endpoint_of

NOBODY = 65534
ALONE = f"""
import os, sys
from gigabrain_zenoh.host.this_process import AUTOGROUP, go_first
if "nobody" in sys.argv:
    os.setuid({NOBODY})
go_first()
print(os.getpriority(os.PRIO_PROCESS, 0))
print(AUTOGROUP.read_text() if AUTOGROUP.exists() else "")
"""

needs_rights = pytest.mark.skipif(os.geteuid() != 0, reason="only root may go first")


def going_first(*words: str, of_its_own: bool = True) -> tuple[int, str]:
    """The niceness, and what is told of the session, of a process that has asked to go first."""
    done = subprocess.run(
        (sys.executable, "-c", ALONE, *words),
        start_new_session=of_its_own, capture_output=True, text=True, check=True,
    )  # fmt: skip
    nice, session = done.stdout.split("\n", 1)
    return int(nice), session.strip()


def told_of(session: str, nice: int) -> bool:
    """Return whether a session has this niceness; True where sessions have none."""
    return not session or session.endswith(f" nice {nice}")


@needs_rights
def test_whoever_goes_first_does_so_with_all_of_its_session() -> None:
    nice, session = going_first()
    assert nice == HIGH_PRIORITY_NICE
    assert told_of(session, HIGH_PRIORITY_NICE)


STARTING = """
from gigabrain_zenoh.host.this_process import AUTOGROUP, join_in, start_first
for change in (start_first, join_in):
    change()
    print(AUTOGROUP.read_text().strip() if AUTOGROUP.exists() else "")
"""


@needs_rights
def test_the_brain_goes_first_until_it_is_ready() -> None:
    done = subprocess.run(
        (sys.executable, "-c", STARTING),
        start_new_session=True, capture_output=True, text=True, check=True,
    )  # fmt: skip
    first, then = done.stdout.splitlines()
    assert told_of(first, HIGH_PRIORITY_NICE)
    assert told_of(then, 0)


@needs_rights
def test_a_session_that_it_shares_with_others_stays_as_it_is() -> None:
    nice, session = going_first(of_its_own=False)
    assert nice == HIGH_PRIORITY_NICE
    assert told_of(session, 0)


def test_without_the_rights_it_goes_on_as_it_is() -> None:
    nice, session = going_first("nobody" if os.geteuid() == 0 else "")
    assert nice == os.getpriority(os.PRIO_PROCESS, 0)
    assert told_of(session, 0)


@needs_rights
async def test_of_a_robot_what_stops_it_goes_first(home: Home) -> None:
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
