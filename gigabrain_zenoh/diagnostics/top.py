"""`gigabrain top`: processes and topics in the terminal, live."""

from typing import ClassVar

from textual.app import App, ComposeResult
from textual.binding import BindingType
from textual.widgets import Footer, Header

from gigabrain_zenoh.diagnostics.plain_table import PlainTable
from gigabrain_zenoh.diagnostics.top_feed import Feed, Rows
from gigabrain_zenoh.diagnostics.top_rows import PROCESS_COLUMNS, TOPIC_COLUMNS, in_order

PERIOD_S = 1.0
DOWN, UP = " ▼", " ▲"


class Top(App[None]):
    """Two tables. Left and right choose the column that a table is sorted by."""

    CSS = """
    PlainTable { max-height: 50%; margin: 0 1 1 1; }
    #topics { max-height: 1fr; }
    """
    TITLE = "gigabrain top"
    BINDINGS: ClassVar[list[BindingType]] = [
        ("q", "quit", "Quit"),
        ("tab", "app.focus_next", "Other table"),
        ("less_than_sign,comma", "column(-1)", "Sort left"),
        ("greater_than_sign,full_stop", "column(1)", "Sort right"),
        ("r", "turn", "Reverse"),
        ("space", "hold", "Hold still"),
    ]
    ENABLE_COMMAND_PALETTE = False

    def __init__(self, feed: Feed, about: str) -> None:
        super().__init__()
        self._feed, self.sub_title = feed, about
        self._sorted: dict[str, tuple[int, bool]] = {"processes": (0, False), "topics": (0, False)}
        self._rows: dict[str, Rows] = {"processes": {}, "topics": {}}
        self._holds = False

    def compose(self) -> ComposeResult:
        """The two tables."""
        yield Header()
        for name in self._sorted:
            yield PlainTable(name=name)
        yield Footer()

    def on_mount(self) -> None:
        """Begin to look."""
        self.query_one("#processes").focus()
        self._refresh()
        self.set_interval(PERIOD_S, self._refresh)

    def on_plain_table_heading_clicked(self, event: PlainTable.HeadingClicked) -> None:
        """A click on a column sorts by it; another turns the order round."""
        name = event.table.id or "topics"
        column, down = self._sorted[name]
        self._sorted[name] = event.column, not down if column == event.column else down
        self._draw(name)

    def action_column(self, step: int) -> None:
        """Sort by the next column."""
        name = self._chosen()
        column, down = self._sorted[name]
        self._sorted[name] = (column + step) % len(self._columns(name)), down
        self._draw(name)

    def action_turn(self) -> None:
        """Turn the order round."""
        name = self._chosen()
        column, down = self._sorted[name]
        self._sorted[name] = column, not down
        self._draw(name)

    def action_hold(self) -> None:
        """Hold still, or go on."""
        self._holds = not self._holds
        self.title = "gigabrain top (held)" if self._holds else "gigabrain top"

    def _chosen(self) -> str:
        return "topics" if self.focused is self.query_one("#topics") else "processes"

    @staticmethod
    def _columns(name: str) -> tuple[str, ...]:
        return PROCESS_COLUMNS if name == "processes" else TOPIC_COLUMNS

    def _refresh(self) -> None:
        if self._holds:
            return
        self._rows["processes"], self._rows["topics"] = self._feed.refresh()
        for name in self._sorted:
            self._draw(name)

    def _draw(self, name: str) -> None:
        column, down = self._sorted[name]
        headings = [
            label + (DOWN if down else UP) if i == column else label
            for i, label in enumerate(self._columns(name))
        ]
        rows = [cells for _, cells in in_order(self._rows[name], column, down=down)]
        self.query_one(f"#{name}", PlainTable).show(headings, rows)
