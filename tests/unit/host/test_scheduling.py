"""Priorities of processes: those that can stop the robot go first, and observers step aside."""

import os

import pytest

from gigabrain_zenoh.host.this_process import step_aside
from gigabrain_zenoh.launch.processes import PROCESSES
from gigabrain_zenoh.testing.waiting import start_thread


@pytest.mark.skipif(not hasattr(os, "SCHED_BATCH"), reason="only Linux has it")
def test_whoever_steps_aside_does_so_for_all_threads_that_it_starts() -> None:
    found = []

    def work() -> None:
        step_aside()
        start_thread(lambda: found.append(os.sched_getscheduler(0))).join()

    before = os.sched_getscheduler(0)
    start_thread(work).join()
    assert found == [os.SCHED_BATCH]
    assert os.sched_getscheduler(0) == before


def test_only_those_without_whom_the_robot_drives_look_on() -> None:
    looks_on = {name for name, process in PROCESSES.items() if process.looks_on}
    assert looks_on == {"recorder", "page", "foxglove"}


def test_commands_and_stops_pass_those_who_go_first() -> None:
    stops = {name for name, process in PROCESSES.items() if process.stops}
    assert stops == {"router", "relay", "driver", "emulator", "button", "control", "safety"}
