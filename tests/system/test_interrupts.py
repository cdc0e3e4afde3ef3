"""A signal is never lost, and ends a command with its documented exit code."""

import signal
import subprocess
import sys

import pytest

BEGIN = """
import asyncio, os, signal, sys, threading, time
from gigabrain_zenoh.host.signals import interrupts
from gigabrain_zenoh.host.signals import run_async, stop_signals
interrupts.install()
interrupts.limit_s = 0.3

def elsewhere(number):  # the kernel may hand a signal to any thread; the main thread sleeps on
    time.sleep(0.1)
    signal.pthread_kill(threading.get_ident(), number)

def main():
"""
END = """
try:
    with interrupts.raising():
        code = main()
except KeyboardInterrupt:
    code = interrupts.exit_code
print("in good order", flush=True)
os._exit(code or 0)
"""


def ended(body: str, sigint: object = signal.default_int_handler) -> tuple[int, str, str]:
    """Run a program whose `main` has this body; return its exit code, output and errors."""
    lines = "".join(f"    {line}\n" for line in body.strip().splitlines())
    # a child inherits ignored signals, such as SIGHUP under nohup
    wanted = {signal.SIGINT: sigint, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, action) for number, action in wanted.items()}  # type: ignore[arg-type]
    try:
        words = (sys.executable, "-c", BEGIN + lines + END)
        done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    finally:
        for number, action in before.items():
            signal.signal(number, action)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_received_by_another_thread_ends_a_sleeping_event_loop(number: int) -> None:
    body = f"""
threading.Thread(target=elsewhere, args=({number},), daemon=True).start()
run_async(asyncio.sleep(3600))
"""
    assert ended(body) == (128 + number, "in good order\n", "")


def test_a_signal_received_by_another_thread_ends_a_sleeping_program() -> None:
    body = """
threading.Thread(target=elsewhere, args=(2,), daemon=True).start()
time.sleep(3600)
"""
    assert ended(body) == (130, "in good order\n", "")


def test_sigint_works_although_a_shell_ignored_it() -> None:
    body = """
os.kill(os.getpid(), 2)
time.sleep(3600)
"""
    assert ended(body, signal.SIG_IGN) == (130, "in good order\n", "")


def test_a_signal_swallowed_by_a_destructor_is_raised_again() -> None:
    body = """
class Swallows:
    def __del__(self):
        os.kill(os.getpid(), 15)
        time.sleep(0.01)
Swallows()
time.sleep(3600)
"""
    assert ended(body) == (143, "in good order\n", "")


def test_a_signal_before_the_loop_runs_cancels_its_main_task() -> None:
    body = """
with interrupts.reacting(None):
    os.kill(os.getpid(), 15)
    run_async(asyncio.sleep(3600))
"""
    assert ended(body) == (143, "in good order\n", "")


def test_a_second_signal_does_not_interrupt_the_clean_up() -> None:
    body = """
async def work():
    try:
        os.kill(os.getpid(), 2)
        await asyncio.sleep(3600)
    finally:
        os.kill(os.getpid(), 2)
        await asyncio.sleep(0.01)
        print("cleaned up")
run_async(work())
"""
    assert ended(body) == (130, "cleaned up\nin good order\n", "")


def test_a_command_stopped_by_a_signal_has_its_own_exit_code() -> None:
    body = """
async def work():
    with stop_signals(0.3) as stop:
        os.kill(os.getpid(), 15)
        await stop.wait()
    os.kill(os.getpid(), 15)
    return 7
return run_async(work())
"""
    assert ended(body) == (7, "in good order\n", "")


@pytest.mark.parametrize(
    "stuck",
    [
        "await asyncio.to_thread(time.sleep, 3600)",  # the loop waits for this thread
        "time.sleep(3600)",  # in a callback
    ],
)
def test_a_program_that_does_not_end_is_killed(stuck: str) -> None:
    body = f"""
async def work():
    threading.Timer(0.1, os.kill, (os.getpid(), 15)).start()
    {stuck}
run_async(work())
"""
    assert ended(body) == (143, "", "")


def test_a_signal_before_the_work_begins_ends_the_program_at_once() -> None:
    done = subprocess.run(
        (
            sys.executable,
            "-c",
            BEGIN.partition("\ndef")[0] + "\nos.kill(os.getpid(), 15)\nprint(1)",
        ),
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "")
