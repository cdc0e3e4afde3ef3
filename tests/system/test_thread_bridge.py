import asyncio
import contextlib
import functools
import os
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from gigabrain_zenoh.bus.bridge import WAKER, Bridge, EventFd, SocketPair, Waker
from gigabrain_zenoh.testing.waiting import start_thread, until

KINDS: list[Callable[[], Waker]] = [SocketPair]
if hasattr(os, "eventfd"):
    KINDS.append(EventFd)


class CountingWaker:
    """A waker that counts its signals."""

    def __init__(self, inner: Waker) -> None:
        self._inner, self.signals, self.closed = inner, 0, False

    def fileno(self) -> int:
        return self._inner.fileno()

    def signal(self) -> None:
        assert not self.closed, "signalled a descriptor that may be somebody else's by now"
        self.signals += 1
        self._inner.signal()

    def clear(self) -> None:
        self._inner.clear()

    def close(self) -> None:
        self.closed = True
        self._inner.close()


class Bench:
    """A bridge whose wake-ups are counted."""

    def __init__(self, kind: Callable[[], Waker]) -> None:
        self.waker = CountingWaker(kind())
        self.bridge = Bridge(lambda: self.waker)
        self.received: list[int] = []

    async def until(self, count: int) -> None:
        await until(lambda: len(self.received) >= count)


@pytest.fixture(params=KINDS, ids=lambda kind: kind.__name__)
async def bench(request: pytest.FixtureRequest) -> AsyncIterator[Bench]:
    bench = Bench(request.param)
    yield bench
    bench.bridge.close()


def test_an_event_descriptor_is_used_where_there_is_one() -> None:
    assert WAKER is (EventFd if hasattr(os, "eventfd") else SocketPair)


async def test_posted_calls_run_on_the_loop_in_order(bench: Bench) -> None:
    threads: set[int] = set()

    def take(number: int) -> None:
        threads.add(threading.get_ident())
        bench.received.append(number)

    def post() -> None:
        for number in range(1000):
            bench.bridge.post(take, number)

    posting = start_thread(post)
    await bench.until(1000)
    posting.join()
    assert bench.received == list(range(1000))
    assert threads == {threading.get_ident()}


async def test_many_posts_to_a_busy_loop_need_one_wake_up(bench: Bench) -> None:
    for number in range(10_000):  # posting from the loop's own thread keeps it busy
        bench.bridge.post(bench.received.append, number)
    assert bench.waker.signals == 1
    await bench.until(10_000)
    assert bench.received == list(range(10_000))
    bench.bridge.post(bench.received.append, 10_000)
    assert bench.waker.signals == 2
    await bench.until(10_001)


async def test_posts_of_many_threads_all_run_in_the_order_of_each_thread(bench: Bench) -> None:
    def post(first: int) -> None:
        for number in range(first, first + 5000):
            bench.bridge.post(bench.received.append, number)

    firsts = (0, 10_000, 20_000, 30_000)
    threads = [start_thread(functools.partial(post, first)) for first in firsts]
    await bench.until(20_000)
    for thread in threads:
        thread.join()
    for first in firsts:
        own = [number for number in bench.received if first <= number < first + 5000]
        assert own == list(range(first, first + 5000))


async def test_a_post_at_the_end_of_a_drain_is_not_lost(bench: Bench) -> None:
    """Post one at a time, so that each has to wake a loop that just fell asleep."""
    turn = threading.Semaphore(0)

    def take(number: int) -> None:
        bench.received.append(number)
        turn.release()

    def post() -> None:
        for number in range(3000):
            bench.bridge.post(take, number)
            assert turn.acquire(timeout=20)

    posting = start_thread(post)
    await bench.until(3000)
    posting.join()
    assert bench.received == list(range(3000))


async def test_posts_during_a_drain_run_in_the_next_turn_of_the_loop(bench: Bench) -> None:
    turns: list[str] = []

    def again(count: int) -> None:
        turns.append("post")
        asyncio.get_running_loop().call_soon(turns.append, "others")
        if count:
            bench.bridge.post(again, count - 1)
        bench.received.append(count)

    bench.bridge.post(again, 2)
    await bench.until(3)
    await asyncio.sleep(0)
    assert turns == ["post", "others"] * 3


async def test_an_exception_does_not_stop_the_other_calls(bench: Bench) -> None:
    exceptions: list[str] = []
    asyncio.get_running_loop().set_exception_handler(
        lambda _, context: exceptions.append(repr(context.get("exception")))
    )

    def fail(number: int) -> None:
        raise ValueError(number)

    for number in (1, 2, 3):
        bench.bridge.post(fail, number)
        bench.bridge.post(bench.received.append, number)
    await bench.until(3)
    assert bench.received == [1, 2, 3]
    assert exceptions == ["ValueError(1)", "ValueError(2)", "ValueError(3)"]


async def test_no_call_runs_after_the_close(bench: Bench) -> None:
    bench.bridge.post(bench.received.append, 1)
    bench.bridge.close()
    bench.bridge.close()
    bench.bridge.post(bench.received.append, 2)
    await asyncio.sleep(0.01)
    assert bench.received == []
    assert bench.waker.closed
    assert bench.waker.signals == 1


async def test_no_call_runs_after_one_that_closes_the_bridge(bench: Bench) -> None:
    bench.bridge.post(bench.received.append, 1)
    bench.bridge.post(lambda _: bench.bridge.close(), None)
    bench.bridge.post(bench.received.append, 2)
    await asyncio.sleep(0.01)
    assert bench.received == [1]


async def test_a_close_waits_for_a_signal_in_progress() -> None:
    """Else the descriptor's number might belong to another file when the signal is written."""
    signalling = threading.Event()
    events: list[str] = []

    class Slow(SocketPair):
        def signal(self) -> None:
            signalling.set()
            time.sleep(0.05)
            events.append("signalled")
            super().signal()

        def close(self) -> None:
            events.append("closed")
            super().close()

    bridge = Bridge(Slow)
    posting = start_thread(lambda: bridge.post(print, "never"))
    assert signalling.wait(20)
    bridge.close()
    posting.join()
    assert events == ["signalled", "closed"]


async def close_while_threads_post() -> None:
    """Count descriptors in a process that opens no others meanwhile."""
    before = os.listdir("/dev/fd")
    for kind in 10 * KINDS:
        bench = Bench(kind)

        def post(bench: Bench = bench) -> None:
            for number in range(200):
                bench.bridge.post(bench.received.append, number)
                time.sleep(0)

        threads = [start_thread(post) for _ in range(3)]
        await bench.until(10)
        bench.bridge.close()
        for thread in threads:
            thread.join()
    assert os.listdir("/dev/fd") == before


def test_closing_while_threads_post_leaks_no_descriptor() -> None:
    program = (
        "import asyncio; from tests.system import test_thread_bridge as t; asyncio.run(t.{}())"
    )
    lines = program.format(close_while_threads_post.__name__)
    root = Path(__file__).parents[2]
    ran = subprocess.run((sys.executable, "-c", lines), cwd=root, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


async def test_a_full_socket_pair_still_wakes_the_loop() -> None:
    pair = SocketPair()
    bridge = Bridge(lambda: pair)
    with contextlib.suppress(BlockingIOError):
        while True:
            pair._write.send(b"\1")
    pair.signal()
    received: list[int] = []
    bridge.post(received.append, 1)
    await until(lambda: received)
    bridge.close()
