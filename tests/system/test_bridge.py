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


class Counting:
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
        self.waker = Counting(kind())
        self.bridge = Bridge(lambda: self.waker)
        self.got: list[int] = []

    async def until(self, count: int) -> None:
        await until(lambda: len(self.got) >= count)


@pytest.fixture(params=KINDS, ids=lambda kind: kind.__name__)
async def bench(request: pytest.FixtureRequest) -> AsyncIterator[Bench]:
    bench = Bench(request.param)
    yield bench
    bench.bridge.close()


def test_linux_needs_one_descriptor_only() -> None:
    assert WAKER is (EventFd if hasattr(os, "eventfd") else SocketPair)


async def test_what_is_posted_runs_on_the_loop_in_order(bench: Bench) -> None:
    threads: set[int] = set()

    def take(number: int) -> None:
        threads.add(threading.get_ident())
        bench.got.append(number)

    def post() -> None:
        for number in range(1000):
            bench.bridge.post(take, number)

    posting = start_thread(post)
    await bench.until(1000)
    posting.join()
    assert bench.got == list(range(1000))
    assert threads == {threading.get_ident()}


async def test_any_number_of_posts_to_a_busy_loop_cost_one_wake_up(bench: Bench) -> None:
    for number in range(10_000):  # from the loop's own thread, which is what keeps it busy
        bench.bridge.post(bench.got.append, number)
    assert bench.waker.signals == 1
    await bench.until(10_000)
    assert bench.got == list(range(10_000))
    bench.bridge.post(bench.got.append, 10_000)
    assert bench.waker.signals == 2
    await bench.until(10_001)


async def test_many_threads_lose_nothing_and_keep_the_order_of_each(bench: Bench) -> None:
    def post(first: int) -> None:
        for number in range(first, first + 5000):
            bench.bridge.post(bench.got.append, number)

    firsts = (0, 10_000, 20_000, 30_000)
    threads = [start_thread(functools.partial(post, first)) for first in firsts]
    await bench.until(20_000)
    for thread in threads:
        thread.join()
    for first in firsts:
        own = [number for number in bench.got if first <= number < first + 5000]
        assert own == list(range(first, first + 5000))


async def test_a_post_that_meets_the_end_of_a_drain_is_not_forgotten(bench: Bench) -> None:
    """One at a time, so that each has to wake a loop that has just fallen asleep."""
    turn = threading.Semaphore(0)

    def take(number: int) -> None:
        bench.got.append(number)
        turn.release()

    def post() -> None:
        for number in range(3000):
            bench.bridge.post(take, number)
            assert turn.acquire(timeout=20)

    posting = start_thread(post)
    await bench.until(3000)
    posting.join()
    assert bench.got == list(range(3000))


async def test_what_is_posted_while_draining_waits_for_the_next_turn(bench: Bench) -> None:
    turns: list[str] = []

    def again(count: int) -> None:
        turns.append("post")
        asyncio.get_running_loop().call_soon(turns.append, "others")
        if count:
            bench.bridge.post(again, count - 1)
        bench.got.append(count)

    bench.bridge.post(again, 2)
    await bench.until(3)
    await asyncio.sleep(0)
    assert turns == ["post", "others"] * 3


async def test_an_exception_does_not_hold_up_the_others(bench: Bench) -> None:
    told: list[str] = []
    asyncio.get_running_loop().set_exception_handler(
        lambda _, context: told.append(repr(context.get("exception")))
    )

    def fail(number: int) -> None:
        raise ValueError(number)

    for number in (1, 2, 3):
        bench.bridge.post(fail, number)
        bench.bridge.post(bench.got.append, number)
    await bench.until(3)
    assert bench.got == [1, 2, 3]
    assert told == ["ValueError(1)", "ValueError(2)", "ValueError(3)"]


async def test_nothing_is_called_after_the_close(bench: Bench) -> None:
    bench.bridge.post(bench.got.append, 1)
    bench.bridge.close()
    bench.bridge.close()
    bench.bridge.post(bench.got.append, 2)
    await asyncio.sleep(0.01)
    assert bench.got == []
    assert bench.waker.closed
    assert bench.waker.signals == 1


async def test_one_that_closes_the_bridge_is_the_last(bench: Bench) -> None:
    bench.bridge.post(bench.got.append, 1)
    bench.bridge.post(lambda _: bench.bridge.close(), None)
    bench.bridge.post(bench.got.append, 2)
    await asyncio.sleep(0.01)
    assert bench.got == [1]


async def test_a_close_waits_for_a_signal_that_is_on_its_way() -> None:
    """Else the number of the descriptor might be somebody else's when the signal is written."""
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


async def closed_while_threads_post() -> None:
    """In a process where nobody else opens anything."""
    before = os.listdir("/dev/fd")
    for kind in 10 * KINDS:
        bench = Bench(kind)

        def post(bench: Bench = bench) -> None:
            for number in range(200):
                bench.bridge.post(bench.got.append, number)
                time.sleep(0)

        threads = [start_thread(post) for _ in range(3)]
        await bench.until(10)
        bench.bridge.close()
        for thread in threads:
            thread.join()
    assert os.listdir("/dev/fd") == before


def test_closing_while_threads_post_leaves_nothing_open() -> None:
    program = "import asyncio; from tests.system import test_bridge as here; asyncio.run(here.{}())"
    lines = program.format(closed_while_threads_post.__name__)
    root = Path(__file__).parents[2]
    ran = subprocess.run((sys.executable, "-c", lines), cwd=root, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


async def test_a_full_socket_pair_is_readable_and_that_is_enough() -> None:
    pair = SocketPair()
    bridge = Bridge(lambda: pair)
    with contextlib.suppress(BlockingIOError):
        while True:
            pair._write.send(b"\1")
    pair.signal()
    got: list[int] = []
    bridge.post(got.append, 1)
    await until(lambda: got)
    bridge.close()
