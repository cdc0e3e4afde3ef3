"""What may be changed while a process runs: a few named values, each with what it may be."""

import difflib
from collections.abc import Callable
from typing import TypeVar

import msgspec

from gigabrain_schemas.requests import Param
from gigabrain_zenoh.errors import Refused

S = TypeVar("S", bound=msgspec.Struct)
Get = Callable[[], str]
Set = Callable[[str], None]  # raises ValueError for what it cannot be


class Params:
    """The parameters of one process."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[str, Get, Set]] = {}

    def add(self, name: str, expected: str, get: Get, put: Set) -> None:
        """One more; `put` raises ValueError for what it cannot be."""
        self._known[name] = expected, get, put

    def add_field(
        self, name: str, expected: str, settings: Callable[[], S], configure: Callable[[S], None]
    ) -> None:
        """A field of the settings that a node goes by."""

        def put(text: str) -> None:
            before = settings()
            values = msgspec.structs.asdict(before) | {name: text}
            configure(msgspec.convert(values, type(before), strict=False))

        self.add(name, expected, lambda: _shown(getattr(settings(), name)), put)

    def change(self, name: str, text: str) -> tuple[str, str]:
        """Its value before and now. Raises Refused, which says what was expected."""
        if name not in self._known:
            near = difflib.get_close_matches(name, self._known, n=1, cutoff=0.5)
            hint = f"; did you mean {near[0]!r}?" if near else ";"
            known = ", ".join(self._known)
            raise Refused(f"no parameter {name!r}{hint} known: {known}")
        expected, get, put = self._known[name]
        before = get()
        try:
            put(text)
        except ValueError:  # msgspec's are among them
            raise Refused(f"{name}: expected {expected}, got {text!r}") from None
        return before, get()

    def all(self) -> tuple[Param, ...]:
        """What there is."""
        return tuple(
            Param(name=name, value=get(), expected=expected)
            for name, (expected, get, _) in self._known.items()
        )


def _shown(value: object) -> str:
    if value is None:
        return "null"
    return f"{value:g}" if isinstance(value, float) else str(value)
