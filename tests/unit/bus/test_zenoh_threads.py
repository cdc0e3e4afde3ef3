"""At the end of a process Zenoh's threads have ended: one that has not may abort it."""

import subprocess
import sys
import threading

import pytest
import zenoh

from gigabrain_zenoh.bus.zenoh import workarounds

PROGRAM = """
import sys, threading
from gigabrain_zenoh.bus.zenoh import workarounds
workarounds.await_zenoh_threads_at_exit()
workarounds.await_zenoh_threads_at_exit()

def work():
    ending.wait(0.2)
    print("the thread has ended", flush=True)

ending = threading.Event()
threading.Thread(target=work, name=sys.argv[1], daemon=True).start()
print("the program has ended", flush=True)
"""


@pytest.mark.parametrize("name", ["Thread-1 (pyo3-closure)", workarounds.CLOSING_THREAD])
def test_a_program_waits_for_its_threads(name: str) -> None:
    done = subprocess.run((sys.executable, "-c", PROGRAM, name), capture_output=True, text=True)
    assert done.stdout.splitlines() == ["the program has ended", "the thread has ended"]
    assert done.returncode == 0


def test_it_does_not_wait_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workarounds, "CALLBACK_ENDS_S", 0.01)
    ending = threading.Event()
    thread = threading.Thread(target=ending.wait, name="Thread-1 (pyo3-closure)", daemon=True)
    thread.start()
    workarounds._await_zenoh_threads()
    assert thread.is_alive()
    ending.set()
    thread.join()


CLOSES = """
import asyncio, sys
from gigabrain_zenoh.bus.zenoh import session
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint

async def open_and_close():
    transport = await ZenohTransport.open(Endpoint(listen=("tcp/127.0.0.1:0",)))
    for number in range(20):
        transport.subscribe(f"callback/{number}", lambda key, payload: None, 1)
    await transport.close()

session.CLOSE_S = 0.0
asyncio.run(open_and_close())
"""


def test_a_program_may_end_while_its_session_closes() -> None:
    for _ in range(5):
        done = subprocess.run((sys.executable, "-c", CLOSES), capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")


def test_zenoh_still_calls_its_threads_so() -> None:
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        before = set(threading.enumerate())
        session.declare_subscriber("callback/thread", lambda _: None)
        (started,) = set(threading.enumerate()) - before
        assert workarounds.CALLBACK_THREAD in started.name
