"""Ctrl-C ends a process cleanly, however often it is pressed."""

import subprocess
import sys

ENDS = """
import asyncio, os, signal
from gigabrain_zenoh.host.signals import stop_signals

# a shell's `&` starts the tests with SIGINT ignored
signal.signal(signal.SIGINT, signal.default_int_handler)

async def work():
    with stop_signals() as stop:
        if {stopped}:
            os.kill(os.getpid(), signal.SIGINT)
            await stop.wait()
    os.kill(os.getpid(), signal.SIGINT)
    await asyncio.sleep(0.01)

asyncio.run(work())
print("in good order")
"""


def ended(*, stopped: bool) -> tuple[int, str]:
    """Return exit code and output of a process that is interrupted after its work."""
    words = (sys.executable, "-c", ENDS.format(stopped=stopped))
    done = subprocess.run(words, capture_output=True, text=True)
    return done.returncode, done.stdout


def test_ctrl_c_after_a_stop_does_not_interrupt_the_end() -> None:
    assert ended(stopped=True) == (0, "in good order\n")


def test_ctrl_c_after_completed_work_ends_the_process() -> None:
    code, out = ended(stopped=False)
    assert code != 0
    assert out == ""
