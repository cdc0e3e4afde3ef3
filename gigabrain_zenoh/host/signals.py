"""SIGINT, SIGTERM and SIGHUP of a command: none is lost, from its start to its end.

An entry point calls `interrupts.install` first, so this module imports nothing heavy. The effect of
a signal depends on the command's progress (see `reacting`). Only the first one counts.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import asyncio  # heavy: imported where it is used

HANGUP = getattr(signal, "SIGHUP", None)  # Windows has none
SIGNALS = (signal.SIGINT, signal.SIGTERM, *([HANGUP] if HANGUP else ()))
LIMIT_S = 1.8  # from the first signal until the process is ended by force
RESEND_S = 0.05
React = Callable[[], object]


class Interrupts:
    """The signals of this process. The only instance is `interrupts`."""

    def __init__(self) -> None:
        self.received = 0  # the number of the first signal
        self.limit_s = LIMIT_S
        self._pending = False  # received, without a reaction so far
        self._react: React | None = self._exit
        self._installed = False
        self._wake_fd = -1

    @property
    def exit_code(self) -> int:
        """Return the exit code of a command that a signal ended, as shells do."""
        return 128 + self.received

    def install(self) -> None:
        """Handle the signals until the process ends; before `reacting` they end it at once.

        A SIGHUP that is ignored stays ignored (nohup). SIGINT does not: a shell without job control
        starts `command &` with SIGINT ignored, but `kill -INT` must still end it.
        """
        self._installed = True
        self._set_handlers()
        read_fd, self._wake_fd = os.pipe()
        os.set_blocking(self._wake_fd, False)
        signal.set_wakeup_fd(self._wake_fd, warn_on_full_buffer=False)
        sys.unraisablehook = self._unraisable
        threading.Thread(target=self._watch, args=(read_fd,), name="signals", daemon=True).start()

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Handle the signals while the block runs, where `install` was not called.

        After a signal they stay handled, so that a second one does not interrupt the clean-up.
        """
        if self._installed:
            yield
            return
        before = self._set_handlers()
        self._installed = True
        try:
            yield
        finally:
            self._installed = False
            if not self.received:
                for number, handler in before.items():
                    signal.signal(number, handler)

    @contextlib.contextmanager
    def reacting(self, react: React | None) -> Iterator[None]:
        """Call `react` at the first signal, in the main thread between any two bytecodes.

        None defers the signal to the next reaction, inside the block or after it.
        """
        before, self._react = self._react, react
        try:
            self._settle()
            yield
        finally:
            self._react = before
            self._settle()

    def raising(self) -> contextlib.AbstractContextManager[None]:
        """Raise KeyboardInterrupt at the first signal, for code that has to clean up."""
        return self.reacting(_raise)

    def _set_handlers(self) -> dict[signal.Signals, Any]:
        return {
            number: signal.signal(number, self._on_signal)
            for number in SIGNALS
            if number != HANGUP or signal.getsignal(number) is not signal.SIG_IGN
        }

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if not self.received:
            self.received, self._pending = number, True
            if self._wake_fd >= 0:  # an event loop may have replaced the wakeup descriptor
                with contextlib.suppress(BlockingIOError):
                    os.write(self._wake_fd, bytes([number]))
        self._settle()

    def _settle(self) -> None:
        if self._pending and self._react:
            self._pending = False
            self._react()

    def _exit(self) -> None:
        os._exit(self.exit_code)

    def _watch(self, read_fd: int) -> None:
        """Send the signal to the main thread until it is handled; after `limit_s` end the process.

        A signal just before a system call, or to another thread, does not interrupt the call. So it
        is sent again until the main thread runs its handler.
        """
        number = 0
        while number not in SIGNALS:  # others may be handled as well, such as SIGWINCH
            number = os.read(read_fd, 1)[0]
        began_s = time.monotonic()
        while time.monotonic() - began_s < self.limit_s:
            if self._pending or not self.received:
                _send_to_main_thread(number)
            time.sleep(RESEND_S)
        os._exit(128 + number)

    def _unraisable(self, args: "sys.UnraisableHookArgs") -> None:
        """Repeat a KeyboardInterrupt that was raised where no code can catch it."""
        if not (self.received and isinstance(args.exc_value, KeyboardInterrupt)):
            sys.__unraisablehook__(args)
            return
        self._pending = True  # so `_watch` sends the signal again


def end_on_interrupt() -> None:
    """Make Ctrl-C end this process at once, without a traceback; for worker processes."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _send_to_main_thread(number: int) -> None:
    signal.pthread_kill(threading.main_thread().ident or 0, number)


def _raise() -> None:
    raise KeyboardInterrupt


interrupts = Interrupts()
T = TypeVar("T")


@contextmanager
def stop_signals(limit_s: float = LIMIT_S) -> "Iterator[asyncio.Event]":
    """Yield an event that the first SIGINT, SIGTERM or SIGHUP sets; further signals do nothing.

    A command that has not ended `limit_s` after the signal is terminated by force.
    """
    import asyncio

    stop, loop = asyncio.Event(), asyncio.get_running_loop()

    def react() -> None:
        loop.call_soon_threadsafe(stop.set)

    interrupts.limit_s = limit_s
    with interrupts.installed(), interrupts.reacting(react):
        yield stop


async def run_until(stop: "asyncio.Event", work: Coroutine[Any, Any, None]) -> None:
    """Run `work` until it ends or `stop` is set; raise its exception."""
    import asyncio

    working, stopped = asyncio.ensure_future(work), asyncio.ensure_future(stop.wait())
    try:
        await asyncio.wait((working, stopped), return_when=asyncio.FIRST_COMPLETED)
    finally:
        stopped.cancel()
        if not working.cancel():
            working.result()


def run_async(work: Coroutine[Any, Any, T]) -> T:
    """Run a command's coroutine until it ends; the first signal cancels it.

    Raises KeyboardInterrupt if a signal ended it. Unlike `asyncio.run`, it also does so for
    SIGTERM, for SIGHUP, and for SIGINT where a shell ignores it. It never interrupts asyncio's own
    code.
    """

    import asyncio

    async def cancelled_by_signal() -> T:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task

        def react() -> None:
            loop.call_soon_threadsafe(task.cancel)

        with interrupts.reacting(react):
            return await work

    with interrupts.reacting(None):
        try:
            return asyncio.run(cancelled_by_signal())
        except asyncio.CancelledError:
            if not interrupts.received:
                raise
            raise KeyboardInterrupt from None
