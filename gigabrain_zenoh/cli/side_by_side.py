"""A table whose columns are what was measured, and whose rows are figures: it fits a terminal."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table


def side_by_side(
    title: str, caption: str, names: Sequence[str], rows: Mapping[str, Sequence[str]]
) -> "Table":
    """`rows` are what each figure is called, and its value for each of `names`."""
    from rich.table import Table
    from rich.text import Text

    table = Table("", title=title, caption=caption)
    for name in names:
        table.add_column(name, justify="right")
    for figure, cells in rows.items():
        table.add_row(Text(figure), *map(Text, cells))
    return table
