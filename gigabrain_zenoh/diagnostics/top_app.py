"""`gigabrain top` in the terminal: two tables, refreshed once a second."""

import asyncio
from typing import ClassVar

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import BindingType
from textual.widgets import DataTable, Footer, Header

from gigabrain_zenoh.diagnostics.top import (
    PROCESS_COLUMNS,
    TOPIC_COLUMNS,
    Cell,
    Feed,
    Rows,
    cell_text,
    sorted_rows,
)
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.host.signals import stop_signals

PERIOD_S = 1.0
COLUMNS = {"processes": PROCESS_COLUMNS, "topics": TOPIC_COLUMNS}


class TopApp(App[None]):
    """Two tables, each sorted by a column that the user chooses."""

    CSS = """
    DataTable { height: auto; max-height: 50%; margin: 0 1 1 1; }
    #topics { max-height: 1fr; }
    """
    TITLE = "gigabrain top"
    BINDINGS: ClassVar[list[BindingType]] = [
        ("q", "quit", "Quit"),
        ("tab", "app.focus_next", "Other table"),
        ("less_than_sign,comma", "column(-1)", "Sort left"),
        ("greater_than_sign,full_stop", "column(1)", "Sort right"),
        ("r", "reverse", "Reverse"),
        ("space", "pause", "Pause"),
    ]
    ENABLE_COMMAND_PALETTE = False

    def __init__(self, feed: Feed) -> None:
        super().__init__()
        self._feed = feed
        self._sorted: dict[str, tuple[int, bool]] = dict.fromkeys(COLUMNS, (0, False))
        self._rows: dict[str, Rows] = {name: {} for name in COLUMNS}
        self._paused = False

    def compose(self) -> ComposeResult:
        """Yield the two tables between header and footer."""
        yield Header()
        for name in COLUMNS:
            yield DataTable(id=name, cursor_type="none", zebra_stripes=True)
        yield Footer()

    def on_mount(self) -> None:
        """Add the columns, and start to refresh."""
        for name, columns in COLUMNS.items():
            table = self._table(name)
            for i, label in enumerate(columns):
                table.add_column(f"{label}  ", key=str(i))  # spaces for the arrow
        self._table("processes").focus()
        self._refresh()
        self.set_interval(PERIOD_S, self._refresh)

    def _table(self, name: str) -> DataTable[Text]:
        return self.query_one(f"#{name}", DataTable)

    def on_data_table_header_selected(self, event: DataTable.HeaderSelected) -> None:
        """Sort by the column that was clicked; a second click reverses the order."""
        name = event.data_table.id or "topics"
        column, down = self._sorted[name]
        clicked = event.column_index
        self._sorted[name] = clicked, not down if column == clicked else down
        self._draw(name)

    def action_column(self, step: int) -> None:
        """Sort by the next column to the left or right."""
        name = self._focused_table()
        column, down = self._sorted[name]
        self._sorted[name] = (column + step) % len(COLUMNS[name]), down
        self._draw(name)

    def action_reverse(self) -> None:
        """Reverse the order."""
        name = self._focused_table()
        column, down = self._sorted[name]
        self._sorted[name] = column, not down
        self._draw(name)

    def action_pause(self) -> None:
        """Stop refreshing, or continue."""
        self._paused = not self._paused
        self.title = "gigabrain top (paused)" if self._paused else "gigabrain top"

    def _focused_table(self) -> str:
        return "topics" if self.focused is self._table("topics") else "processes"

    def _refresh(self) -> None:
        if self._paused:
            return
        self._rows["processes"], self._rows["topics"] = self._feed.refresh()
        for name in COLUMNS:
            self._draw(name)

    def _draw(self, name: str) -> None:
        """Update the cells in place, which keeps the scroll position, and sort the rows."""
        table, (column, down) = self._table(name), self._sorted[name]
        for i, (label, shown) in enumerate(zip(COLUMNS[name], table.ordered_columns, strict=True)):
            arrow = "▼" if down else "▲"
            shown.label = Text(f"{label} {arrow if i == column else ' '}")
        rank = {}
        for i, (key, row) in enumerate(sorted_rows(self._rows[name], column, down=down)):
            texts = [_text(cell) for cell in row]
            rank[texts[0].plain] = i
            if key in table.rows:
                for j, text in enumerate(texts):
                    table.update_cell(key, str(j), text, update_width=True)
            else:
                table.add_row(*texts, key=key)
        table.sort("0", key=lambda text: rank.get(text.plain, len(rank)))


def _text(cell: Cell) -> Text:
    return Text(printable(cell_text(cell)), justify="left" if isinstance(cell, str) else "right")


async def watch(feed: Feed) -> None:
    """Show the tables until the user quits or a signal arrives."""
    app = TopApp(feed)
    with stop_signals() as stop:
        running = asyncio.ensure_future(app.run_async())
        stopped = asyncio.ensure_future(stop.wait())
        await asyncio.wait((running, stopped), return_when=asyncio.FIRST_COMPLETED)
        stopped.cancel()
        while not running.done():  # Textual shows a traceback if cancelled while it starts
            app.exit()
            await asyncio.wait((running,), timeout=0.1)
        running.result()
