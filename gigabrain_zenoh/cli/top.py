"""`gigabrain top`: processes and topics, live."""

import asyncio
from typing import TYPE_CHECKING

from gigabrain_zenoh.cli.where import HERE, Which, show
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.signals import run_async, stop_signals

if TYPE_CHECKING:
    from gigabrain_zenoh.diagnostics.top_feed import Feed

NEEDS = "for the live table: pip install 'gigabrain-zenoh[view]'; without it: gigabrain top --once"


def top(*, at: Which = HERE, once: bool = False) -> int:
    """Watch processes and topics: load, rates, sizes and latencies.

    Example: gigabrain top

    TAB goes to the other table, < and > choose the column to sort by, r turns the order round,
    the space bar holds all still, q ends it.

    Parameters
    ----------
    once
        Print two tables and end.
    """
    from gigabrain_zenoh.diagnostics.hearing import NAME, everything
    from gigabrain_zenoh.diagnostics.tally import tallied
    from gigabrain_zenoh.diagnostics.top_feed import BusFeed
    from gigabrain_zenoh.runtime.connect import joined

    async def run() -> None:
        where = at.where()
        async with joined(where, NAME) as (bus, _):
            with tallied(bus, everything(where)) as tally:
                feed = BusFeed(bus, tally)
                if once:
                    await _once(feed)
                else:
                    await _live(feed)

    run_async(run())
    return 0


async def _live(feed: "Feed") -> None:
    try:
        from gigabrain_zenoh.diagnostics.top import Top
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}; {NEEDS}") from None
    app = Top(feed, "")
    with stop_signals() as stop:
        running = asyncio.ensure_future(app.run_async())
        stopped = asyncio.ensure_future(stop.wait())
        await asyncio.wait((running, stopped), return_when=asyncio.FIRST_COMPLETED)
        stopped.cancel()
        while not running.done():  # cancelled while it starts, Textual would show a traceback
            app.exit()
            await asyncio.wait((running,), timeout=0.1)
        running.result()


async def _once(feed: "Feed") -> None:
    from rich.table import Table

    from gigabrain_zenoh.diagnostics.top_rows import PROCESS_COLUMNS, TOPIC_COLUMNS, in_order, shown

    await asyncio.sleep(1.3)
    for columns, rows in zip((PROCESS_COLUMNS, TOPIC_COLUMNS), feed.refresh(), strict=True):
        table = Table(box=None, pad_edge=False, header_style="dim")
        for i, column in enumerate(columns):
            table.add_column(column, justify="right" if i else "left", no_wrap=True)
        for _, cells in in_order(rows, 0, down=False):
            table.add_row(*map(shown, cells))
        show(table)
