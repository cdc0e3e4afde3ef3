"""The options of every command that is for a running robot."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.runtime.connect import Where


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Which:
    """Which robot."""

    connect: Annotated[
        str | None,
        Parameter(help="The router's Zenoh endpoint; without it, the only robot that runs here."),
    ] = None
    namespace: Annotated[str, Parameter(help="The robot's own part of the key space.")] = ""
    keys: Annotated[
        Path | None,
        Parameter(help="The folder of your identity, for a router that wants one."),
    ] = None

    @property
    def folder(self) -> str:
        """The folder of the identity; empty for none."""
        return str(self.keys) if self.keys else ""

    def where(self) -> "Where":
        """As the tools take it."""
        from gigabrain_zenoh.runtime.connect import Where

        return Where(connect=self.connect, namespace=self.namespace, keys=self.folder)


HERE = Which()  # the only robot of this machine


WIDE = 160  # columns, where nobody says how many there are


def show(table: "Table") -> None:
    """A table as wide as the terminal; in a pipe as wide as it has to be."""
    import sys

    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else WIDE).print(table)


def say(line: str) -> None:
    """A line for people or pipes, at once."""
    print(line, flush=True)
