"""A process that stops motors over a serial line when their driver dies or hangs.

Motors without a watchdog keep turning when their commands end. So the driver starts this process,
which shares its line, and reports each command to it: moving, or at rest. If the driver ends or
falls silent while motors move, the process writes a frame that stops them. It cannot help if the
line is cut, or the computer is off.

The process loads only this file and the standard library.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import time

MOVING, AT_REST, QUIT = b"m", b"0", b"q"
SILENCE_NS = 100_000_000  # motors are stopped after this time without a report that they move
STOPS_NS = 200_000_000  # stop frames are repeated this long, because one may get lost
PERIOD_NS = 20_000_000
CLOSE_TIMEOUT_S = 1.0


class GuardState:
    """Decides when to stop motors. Pure."""

    def __init__(self, silence_ns: int = SILENCE_NS, stops_ns: int = STOPS_NS) -> None:
        """Set the silence before a stop, and the duration of stop frames [ns]."""
        self.gone = False  # True once the driver ended
        self._silence_ns, self._stops_ns = silence_ns, stops_ns
        self._moving_ns: int | None = None  # time of the last report of moving motors
        self._stop_ns: int | None = None  # start of stopping them

    def take(self, words: bytes, now_ns: int) -> None:
        """Handle the driver's reports; no bytes mean that the driver ended."""
        if not words:
            self.gone = True
            return
        if QUIT in words:
            self.gone, self._moving_ns, self._stop_ns = True, None, None
            return
        self._moving_ns = now_ns if words[-1:] == MOVING else None
        self._stop_ns = None

    def stops(self, now_ns: int) -> bool:
        """Return whether to stop the motors now."""
        since = self._moving_ns
        begins = since is not None and (self.gone or now_ns - since >= self._silence_ns)
        if begins and self._stop_ns is None:
            self._stop_ns = now_ns
        return self._stop_ns is not None and now_ns - self._stop_ns <= self._stops_ns

    def ended(self, now_ns: int) -> bool:
        """Return whether the process may end."""
        return self.gone and not self.stops(now_ns)


class LineGuard:
    """The driver's side: starts the process, and restarts it if it ends."""

    def __init__(self, frame: bytes) -> None:
        """Set the frame that stops the motors."""
        self._frame = frame
        self._process: subprocess.Popen[bytes] | None = None
        self._fd: int | None = None  # of the shared line

    @property
    def pid(self) -> int | None:
        """The id of the process, if it runs."""
        return self._process.pid if self._process else None

    def tell(self, fd: int | None, *, moving: bool) -> None:
        """Report a command that was sent over the line `fd`; None if the line is cut."""
        if fd is None:
            self.close()
            return
        if self._process is None or self._process.poll() is not None or fd != self._fd:
            self.close()
            self._start(fd)
        self._write(MOVING if moving else AT_REST)

    def close(self) -> None:
        """End the process without stopping the motors."""
        process, self._process = self._process, None
        if process is None:
            return
        if process.stdin and process.poll() is None:
            with contextlib.suppress(OSError):
                os.write(process.stdin.fileno(), QUIT)
        if process.stdin:
            process.stdin.close()
        try:
            process.wait(CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:  # it hangs
            process.kill()
            process.wait()

    def _start(self, fd: int) -> None:
        self._fd = fd
        self._process = subprocess.Popen(
            (sys.executable, "-S", "-E", __file__, str(fd), self._frame.hex()),
            stdin=subprocess.PIPE,
            pass_fds=(fd,),
            start_new_session=True,  # signals to the driver's group must not end it
        )
        assert self._process.stdin
        os.set_blocking(self._process.stdin.fileno(), False)

    def _write(self, word: bytes) -> None:
        assert self._process
        assert self._process.stdin
        with contextlib.suppress(OSError):  # it ended or hangs; `tell` restarts it only if it ended
            os.write(self._process.stdin.fileno(), word)


def guard(fd: int, frame: bytes) -> None:
    """Guard the motors on a line until the driver ended and they are stopped."""
    state, words = GuardState(), sys.stdin.fileno()
    while not state.ended(time.monotonic_ns()):
        waits_for = [] if state.gone else [words]
        if select.select(waits_for, [], [], PERIOD_NS / 1e9)[0]:
            state.take(os.read(words, 4096), time.monotonic_ns())
        if state.stops(time.monotonic_ns()):
            with contextlib.suppress(OSError):  # the line is cut
                os.write(fd, frame)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends it through the driver
    guard(int(sys.argv[1]), bytes.fromhex(sys.argv[2]))
