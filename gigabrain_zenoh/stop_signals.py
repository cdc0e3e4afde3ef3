"""The signals that mean: come to an end in good order."""

import asyncio
import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stop_signals() -> Iterator[asyncio.Event]:
    """An event that Ctrl-C, SIGTERM and the end of the terminal set; repeating them does no harm.

    Where whoever started this process wants the end of the terminal ignored (nohup), it is. After
    a stop Ctrl-C does nothing any more: what is left to do until the process ends is not cut short.
    """
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    for number in numbers:
        loop.add_signal_handler(number, stop.set)
    try:
        yield stop
    finally:
        if stop.is_set():
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        for number in numbers:
            loop.remove_signal_handler(number)
