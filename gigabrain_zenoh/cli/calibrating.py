"""Questions of `gigabrain driver calibrate`, and its table of the joints' ranges."""

import math
from collections.abc import Mapping

from rich.console import Console
from rich.live import Live
from rich.table import Table

from gigabrain_drivers.bodies.feetech.calibration import JointRange
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.terminal import typed_text

REFRESH_HZ = 5


class Terminal:
    """Terminal of the person at the arm."""

    def __init__(self) -> None:
        self._console = Console()
        self._live: Live | None = None

    async def ask(self, text: str) -> str:
        """Print a request, and return the typed line. Raises ConfigError at the end of input."""
        self._console.print(text, markup=False, soft_wrap=True)
        try:
            line = await typed_text()
        finally:
            live, self._live = self._live, None
            if live:
                live.stop()
        if line is None:
            raise ConfigError(
                "no input: the calibration was not finished or written; run it in a terminal"
            )
        return line

    def show(self, ranges: Mapping[str, JointRange]) -> None:
        """Show the range over which each joint was moved."""
        if self._live is None:
            self._live = Live(console=self._console, refresh_per_second=REFRESH_HZ)
            self._live.start()
        self._live.update(_table(ranges))


def _table(ranges: Mapping[str, JointRange]) -> Table:
    table = Table()
    for title in ("joint", "least", "now", "most", "missing"):
        table.add_column(title, justify="left" if title == "joint" else "right")
    for name, moved in ranges.items():
        missing = f"{math.degrees(moved.missing):.0f} deg" if moved.missing else "nothing"
        ticks = map(str, (moved.lower, moved.ticks, moved.upper))
        table.add_row(name, *ticks, missing)
    return table
