"""`gigabrain topic echo`, `hz`, `bw` and `delay`: what comes, until Ctrl-C."""

import asyncio
import sys
from collections.abc import Callable, Coroutine, Iterator
from typing import Any, Literal

from msgspec import Struct

from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.hearing import Heard, messages
from gigabrain_zenoh.diagnostics.names import Target
from gigabrain_zenoh.diagnostics.readable import as_json, in_a_line, lines, pick, read
from gigabrain_zenoh.diagnostics.reader import ended_with_reader
from gigabrain_zenoh.diagnostics.roll_call import receivers, roll_call, senders
from gigabrain_zenoh.diagnostics.tally import Figures, tallied
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.host.signals import stop_signals

QUIET_S = 2.0  # without a message, and somebody is told
REPORT_S = 1.0
What = Literal["hz", "bw", "delay"]


class Shown(Struct, frozen=True, kw_only=True):
    """How messages are shown."""

    json: bool = False
    fields: tuple[str, ...] = ()
    count: int | None = None  # then it ends
    within_s: float | None = None  # without a first message in this time it ends with 1


def shown(heard: Heard, how: Shown) -> Iterator[str]:
    """One message as lines. Raises UnknownName for a field that it has not."""
    value = read(heard.key, heard.payload, whole=how.json)
    if how.fields and "invalid" not in value:
        value = pick(value, how.fields)
    if how.json:
        yield as_json({"key": heard.key, **value})
    elif how.fields:
        yield "  ".join(f"{name}={in_a_line(inner)}" for name, inner in value.items())
    else:
        yield f"--- {heard.key}"
        yield from lines(value)


async def echo(bus: Bus, aim: Target, how: Shown, out: Callable[[str], None]) -> int:
    """Show what comes; the exit code. Raises BodyLost where nothing does in time."""
    left = how.count

    async def show() -> None:
        nonlocal left
        async for heard in messages(bus, aim):
            first.set()
            if isinstance(heard, int):
                print(f"{heard} messages came too fast to be shown", file=sys.stderr, flush=True)
                continue
            for line in shown(heard, how):
                out(line)
            left = None if left is None else left - 1
            if left == 0:
                return

    first = asyncio.Event()
    return await _until_stopped(show(), _complain(bus, aim, first, how.within_s))


async def measure(
    bus: Bus, aim: Target, what: What, count: int | None, out: Callable[[str], None]
) -> int:
    """A line per key and second; the exit code."""
    first = asyncio.Event()

    async def report() -> None:
        left = count
        with tallied(bus, aim.pattern) as tally:
            while left is None or left > 0:
                since_ns = bus.clock.now_ns()
                await asyncio.sleep(REPORT_S)
                found = tally.figures(since_ns)
                for key, figures in found.items():
                    first.set()
                    out(
                        f"{key}  {in_words(what, figures, aim.topic)}{_missing(tally.missing(key))}"
                    )
                if not found and first.is_set():
                    out(f"{aim.pattern}  nothing came")
                left = left if left is None or not found else left - 1

    return await _until_stopped(report(), _complain(bus, aim, first, None))


def in_words(what: What, figures: Figures, topic: Topic | None) -> str:  # type: ignore[type-arg]
    """One second of a stream, in a line."""
    if what == "bw":
        return f"{figures.bytes_s / 1e3:.1f} kB/s  {figures.size} bytes  {figures.count} messages"
    if what == "delay":
        if figures.delay_median_ms is None:
            return "no stamps"
        return (
            f"delay median {figures.delay_median_ms:.2f} ms  min {figures.delay_min_ms:.2f}  "
            f"max {figures.delay_max_ms:.2f}"
        )
    promised = f"  promised {topic.hz:g}" if topic else ""
    if figures.gap_max_ms is None:
        return f"{figures.hz:.2f} Hz{promised}"
    return (
        f"{figures.hz:.2f} Hz{promised}  gap min {figures.gap_min_ms:.1f} ms  "
        f"max {figures.gap_max_ms:.1f}  std {figures.gap_std_ms:.1f}"
    )


def _missing(count: int) -> str:
    return f"  {count} missing" if count else ""


async def _complain(bus: Bus, aim: Target, first: asyncio.Event, within_s: float | None) -> None:
    """Say once that nobody sends. Raises BodyLost when there is no time left to wait."""
    try:
        await asyncio.wait_for(first.wait(), within_s or QUIET_S)
    except TimeoutError:
        there = (await roll_call(bus)).values()
        by = ", ".join(senders(aim.pattern, there)) or "nobody"
        to = ", ".join(receivers(aim.pattern, there)) or "nobody"
        text = f"nothing comes on {aim.pattern} (senders: {by}; receivers: {to})"
        if within_s:
            raise BodyLost(text) from None
        print(f"{text}; waiting", file=sys.stderr, flush=True)
        await first.wait()


async def _until_stopped(work: Coroutine[Any, Any, None], beside: Coroutine[Any, Any, None]) -> int:
    """Until `work` is done, a signal comes or nobody reads on; what either raises is raised."""
    tasks = [asyncio.ensure_future(work), asyncio.ensure_future(beside)]
    with stop_signals() as stop, ended_with_reader(stop):
        stopped = asyncio.ensure_future(stop.wait())
        pending = {*tasks, stopped}
        while tasks[0] in pending and stopped in pending:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
            if any(not task.cancelled() and task.exception() for task in done):
                break
    for task in (*tasks, stopped):
        task.cancel()
    ended = await asyncio.gather(*tasks, return_exceptions=True)
    for result in ended:
        if isinstance(result, BaseException) and not isinstance(result, asyncio.CancelledError):
            raise result
    return 0
