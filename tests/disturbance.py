"""Whether this machine stood still while a test ran: then a failure says nothing of the robot.

The fault suite throws such runs away; here the rest of the tests do the same. A test that failed
while the machine stood still is run again with everything set up anew, twice at most, then while no
other process runs a test, and the summary says so. What fails on a machine that keeps time has
failed.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from _pytest.runner import call_and_report

from tests.turns import TURNS

STALL_S = 0.05  # longer than anybody waits for two idle cores, and half of what stops a robot
TRIES = 3
LOOK_S = 0.01
AGAIN = "run again"


class Watch:
    """Sleeps a moment again and again, and notes by how much it overslept."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self.over = threading.Event()

    def look(self) -> None:
        """Until it is over."""
        while not self.over.is_set():
            due_s = time.monotonic() + LOOK_S
            time.sleep(LOOK_S)
            self.longest_s = max(self.longest_s, time.monotonic() - due_s)


@contextmanager
def watching() -> Iterator[Watch]:
    """Look at the machine from a thread of its own."""
    watch = Watch()
    thread = threading.Thread(target=watch.look, name="disturbance", daemon=True)
    thread.start()
    try:
        yield watch
    finally:
        watch.over.set()
        thread.join()


def run_test(item: pytest.Item, nextitem: pytest.Item | None) -> list[pytest.TestReport]:
    """The reports of a test, of its last try if it was run again."""
    once = item.get_closest_marker("once") is not None
    for tried in range(TRIES):
        if tried:
            TURNS.alone()
        else:
            TURNS.beside()
        with watching() as watch:
            reports = _try(item)
        disturbed = watch.longest_s >= STALL_S and any(report.failed for report in reports)
        last = once or not disturbed or tried == TRIES - 1
        reports.append(
            call_and_report(item, "teardown", False, nextitem=nextitem if last else None)
        )
        TURNS.leave()
        if last:
            break
    if tried:
        for report in reports:
            report.user_properties.append((AGAIN, watch.longest_s))
    return reports


def _try(item: pytest.Item) -> list[pytest.TestReport]:
    if hasattr(item, "_initrequest"):  # what the last try has left is not used again
        item._initrequest()
    reports = [call_and_report(item, "setup", False)]
    if reports[0].passed:
        reports.append(call_and_report(item, "call", False))
    return reports
