"""Parameters that can change while a process runs: named values with their allowed values."""

import difflib
from collections.abc import Callable
from typing import TypeVar

import msgspec

from gigabrain_schemas.requests import Param
from gigabrain_zenoh.errors import Refused

S = TypeVar("S", bound=msgspec.Struct)
Get = Callable[[], str]
Set = Callable[[str], None]  # raises ValueError for a value that is not allowed


class Params:
    """The parameters of one process."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[str, Get, Set]] = {}
        self._renamed: dict[str, str] = {}

    def add(self, name: str, expected: str, get: Get, put: Set) -> None:
        """Add a parameter; `put` raises ValueError for a value that is not allowed."""
        self._known[name] = expected, get, put

    def add_field(
        self, name: str, expected: str, settings: Callable[[], S], configure: Callable[[S], None]
    ) -> None:
        """Add a field of a node's settings; `configure` receives the changed settings."""

        def put(text: str) -> None:
            before = settings()
            values = msgspec.structs.asdict(before) | {name: text}
            configure(msgspec.convert(values, type(before), strict=False))

        self.add(name, expected, lambda: _shown(getattr(settings(), name)), put)

    def rename(self, old: str, new: str) -> None:
        """Accept an old name as well, for one release."""
        self._renamed[old] = new

    def change(self, name: str, text: str) -> tuple[str, str]:
        """Set a parameter; return its old and new value. Raises Refused with what is expected."""
        name = name if name in self._known else self._renamed.get(name, name)
        if name not in self._known:
            near = difflib.get_close_matches(name, self._known, n=1, cutoff=0.5)
            hint = f"; did you mean {near[0]!r}?" if near else ";"
            known = ", ".join(self._known)
            raise Refused(f"no parameter {name!r}{hint} known: {known}")
        expected, get, put = self._known[name]
        before = get()
        try:
            put(text)
        except ValueError:  # msgspec.ValidationError is one
            raise Refused(f"{name}: expected {expected}, got {text!r}") from None
        return before, get()

    def all(self) -> tuple[Param, ...]:
        """Return all parameters with their current values."""
        return tuple(
            Param(name=name, value=get(), expected=expected)
            for name, (expected, get, _) in self._known.items()
        )


def _shown(value: object) -> str:
    if value is None:
        return "null"
    return f"{value:g}" if isinstance(value, float) else str(value)
