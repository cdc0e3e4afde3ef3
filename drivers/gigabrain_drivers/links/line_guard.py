"""A process that stops motors over a serial line when their driver has died or hangs.

Motors without a watchdog turn on for ever when their commands end. So the driver starts this
process, which shares its line, and tells it of each command: moving, or at rest. When moving
commands stop coming, or the driver is gone, the process writes a frame that stops the motors. It
cannot help where the line itself is cut, or the computer is off.

The process loads nothing but this file, and of that the standard library alone.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import time

MOVING, AT_REST, QUIT = b"m", b"0", b"q"
SILENCE_NS = 100_000_000  # after the last word of moving motors, until they are stopped,
STOPS_NS = 200_000_000  # for so long, as a single frame may get lost
PERIOD_NS = 20_000_000
CLOSE_S = 1.0


class GuardState:
    """Decides when motors are stopped. Pure."""

    def __init__(self, silence_ns: int = SILENCE_NS, stops_ns: int = STOPS_NS) -> None:
        """Take the silence of a moving driver, and for how long motors are told to stop [ns]."""
        self.gone = False  # whether the driver is
        self._silence_ns, self._stops_ns = silence_ns, stops_ns
        self._moving_ns: int | None = None  # when it last said that the motors move
        self._stop_ns: int | None = None  # since when they are stopped

    def take(self, words: bytes, now_ns: int) -> None:
        """Take what the driver has said; nothing means that it has ended."""
        if not words:
            self.gone = True
            return
        if QUIT in words:
            self.gone, self._moving_ns, self._stop_ns = True, None, None
            return
        self._moving_ns = now_ns if words[-1:] == MOVING else None
        self._stop_ns = None

    def stops(self, now_ns: int) -> bool:
        """Return whether motors are to be stopped now."""
        since = self._moving_ns
        begins = since is not None and (self.gone or now_ns - since >= self._silence_ns)
        if begins and self._stop_ns is None:
            self._stop_ns = now_ns
        return self._stop_ns is not None and now_ns - self._stop_ns <= self._stops_ns

    def ended(self, now_ns: int) -> bool:
        """Return whether there is nothing left to do."""
        return self.gone and not self.stops(now_ns)


class LineGuard:
    """The driver's end: starts the process, and again if it ends."""

    def __init__(self, frame: bytes) -> None:
        """`frame` stops the motors."""
        self._frame = frame
        self._process: subprocess.Popen[bytes] | None = None
        self._fd: int | None = None  # of the line that it shares

    @property
    def pid(self) -> int | None:
        """The process, where there is one."""
        return self._process.pid if self._process else None

    def tell(self, fd: int | None, *, moving: bool) -> None:
        """Tell it of a command that was sent over the line `fd`; None for a line that is cut."""
        if fd is None:
            self.close()
            return
        if self._process is None or self._process.poll() is not None or fd != self._fd:
            self.close()
            self._start(fd)
        self._write(MOVING if moving else AT_REST)

    def close(self) -> None:
        """End it; nothing is left to guard."""
        process, self._process = self._process, None
        if process is None:
            return
        if process.stdin and process.poll() is None:
            with contextlib.suppress(OSError):
                os.write(process.stdin.fileno(), QUIT)
        if process.stdin:
            process.stdin.close()
        try:
            process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:  # it hangs
            process.kill()
            process.wait()

    def _start(self, fd: int) -> None:
        self._fd = fd
        self._process = subprocess.Popen(
            (sys.executable, "-S", "-E", __file__, str(fd), self._frame.hex()),
            stdin=subprocess.PIPE,
            pass_fds=(fd,),
            start_new_session=True,  # what ends the driver's group must not end it
        )
        assert self._process.stdin
        os.set_blocking(self._process.stdin.fileno(), False)

    def _write(self, word: bytes) -> None:
        assert self._process
        assert self._process.stdin
        with contextlib.suppress(OSError):  # it has ended, or hangs: it is replaced, or left alone
            os.write(self._process.stdin.fileno(), word)


def guard(fd: int, frame: bytes) -> None:
    """Guard the motors on a line until the driver ends, and a moment longer."""
    state, words = GuardState(), sys.stdin.fileno()
    while not state.ended(time.monotonic_ns()):
        waits_for = [] if state.gone else [words]
        if select.select(waits_for, [], [], PERIOD_NS / 1e9)[0]:
            state.take(os.read(words, 4096), time.monotonic_ns())
        if state.stops(time.monotonic_ns()):
            with contextlib.suppress(OSError):  # the line is gone
                os.write(fd, frame)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the driver, whose end ends it
    guard(int(sys.argv[1]), bytes.fromhex(sys.argv[2]))
