"""The process that stops motors over a serial line when their driver dies or hangs."""

import os
import pty
import subprocess
import sys
import textwrap
from collections.abc import Iterator

import pytest

from gigabrain_drivers.links.line_guard import GuardState, LineGuard

MS = 1_000_000
FRAME = b"\xff\xffstand"


def state() -> GuardState:
    return GuardState(150 * MS, 1000 * MS)


def test_motors_are_stopped_when_the_driver_falls_silent_while_they_move() -> None:
    guard = state()
    guard.take(b"0m", 0)
    assert not guard.stops(149 * MS)
    assert guard.stops(150 * MS)
    assert guard.stops(1150 * MS)
    assert not guard.stops(1151 * MS)
    guard.take(b"m", 2000 * MS)
    assert not guard.stops(2100 * MS)
    assert guard.stops(2200 * MS)
    guard.take(b"m0", 2210 * MS)
    assert not guard.stops(9000 * MS)


def test_motors_are_stopped_at_once_when_the_driver_ends() -> None:
    guard = state()
    guard.take(b"m", 0)
    guard.take(b"", MS)
    assert guard.stops(MS)
    assert not guard.ended(1000 * MS)
    assert guard.ended(1002 * MS)


@pytest.mark.parametrize("words", [b"0", b"mq"])
def test_motors_at_rest_or_of_a_driver_that_quits_are_not_stopped(words: bytes) -> None:
    guard = state()
    guard.take(words, 0)
    guard.take(b"", MS)
    assert not guard.stops(MS)
    assert guard.ended(MS)


@pytest.fixture
def line() -> Iterator[tuple[int, int]]:
    """Yield both ends of a serial line: the motors', and the driver's."""
    motors, driver = pty.openpty()
    yield motors, driver
    os.close(motors)
    os.close(driver)


def test_the_process_stops_motors_of_a_silent_driver(line: tuple[int, int]) -> None:
    motors, driver = line
    guard = LineGuard(FRAME)
    guard.tell(driver, moving=True)
    assert os.read(motors, len(FRAME)) == FRAME
    guard.close()


def test_a_killed_guard_is_restarted(line: tuple[int, int]) -> None:
    motors, driver = line
    guard = LineGuard(FRAME)
    guard.tell(driver, moving=False)
    assert guard.pid
    os.kill(guard.pid, 9)
    os.waitid(os.P_PID, guard.pid, os.WEXITED | os.WNOWAIT)
    guard.tell(driver, moving=True)
    assert os.read(motors, len(FRAME)) == FRAME
    guard.close()


def test_there_is_no_guard_without_a_line(line: tuple[int, int]) -> None:
    guard = LineGuard(FRAME)
    guard.tell(None, moving=True)
    assert guard.pid is None
    guard.tell(line[1], moving=True)
    guard.tell(None, moving=False)
    assert guard.pid is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("last_words", "stopped"),
    [("os._exit(1)", True), ("guard.close()", False)],
)
def test_motors_are_stopped_if_the_driver_dies_but_not_if_it_closes_the_guard(
    line: tuple[int, int], last_words: str, stopped: bool
) -> None:
    motors, driver = line
    program = f"""
        import os
        from gigabrain_drivers.links.line_guard import LineGuard
        guard = LineGuard({FRAME!r})
        guard.tell({driver}, moving=True)
        {last_words}
        os.write({driver}, b"the end")
    """
    subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], pass_fds=[driver], check=not stopped
    )
    wanted = FRAME if stopped else b"the end"
    assert os.read(motors, len(wanted)) == wanted
