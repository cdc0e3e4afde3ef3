"""At the end of a process its callback threads have ended: one that has not may abort it."""

import subprocess
import sys
import threading

import pytest
import zenoh

from gigabrain_zenoh.bus.zenoh import workarounds

PROGRAM = """
import sys, threading
from gigabrain_zenoh.bus.zenoh import workarounds
workarounds.await_callback_threads_at_exit()
workarounds.await_callback_threads_at_exit()

def work():
    ending.wait(0.2)
    print("the callback has ended", flush=True)

ending = threading.Event()
threading.Thread(target=work, name="Thread-1 (pyo3-closure)", daemon=True).start()
print("the program has ended", flush=True)
"""


def test_a_program_waits_for_the_threads_of_callbacks() -> None:
    done = subprocess.run((sys.executable, "-c", PROGRAM), capture_output=True, text=True)
    assert done.stdout.splitlines() == ["the program has ended", "the callback has ended"]
    assert done.returncode == 0


def test_it_does_not_wait_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workarounds, "ENDING_S", 0.01)
    ending = threading.Event()
    thread = threading.Thread(target=ending.wait, name="Thread-1 (pyo3-closure)", daemon=True)
    thread.start()
    workarounds._await_callback_threads()
    assert thread.is_alive()
    ending.set()
    thread.join()


def test_zenoh_still_calls_its_threads_so() -> None:
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        before = set(threading.enumerate())
        session.declare_subscriber("callback/thread", lambda _: None)
        (started,) = set(threading.enumerate()) - before
        assert workarounds.CALLBACK_THREAD in started.name
