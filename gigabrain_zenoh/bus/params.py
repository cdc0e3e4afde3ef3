"""Parameters of a process: named values that may change while it runs."""

import difflib
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import msgspec

from gigabrain_schemas.requests import Param
from gigabrain_zenoh.errors import Refused, listed

S = TypeVar("S", bound=msgspec.Struct)
Get = Callable[[], str]
Set = Callable[[str], None]  # raises ValueError, or Refused with its own text


class _Entry(NamedTuple):
    expected: str
    get: Get
    put: Set
    key: str  # dotted place in a deployment file
    initial: str


class Params:
    """The parameters of one process."""

    def __init__(self) -> None:
        self._known: dict[str, _Entry] = {}
        self._renamed: dict[str, str] = {}

    def add(self, name: str, expected: str, get: Get, put: Set, *, key: str = "") -> None:
        """Add a parameter.

        `put` raises ValueError for a value that is not allowed, or Refused with the reason. `key`
        is the parameter's dotted place in a deployment file, if it has one.
        """
        self._known[name] = _Entry(expected, get, put, key, get())

    def add_field(
        self,
        name: str,
        expected: str,
        settings: Callable[[], S],
        configure: Callable[[S], None],
        *,
        section: str = "",
    ) -> None:
        """Add a field of a node's settings; `configure` receives the changed settings.

        `section` is the place of the settings in a deployment file, such as `decision.settings`.
        """

        def put(text: str) -> None:
            before = settings()
            values = msgspec.structs.asdict(before) | {name: text}
            configure(msgspec.convert(values, type(before), strict=False))

        key = f"{section}.{name}" if section else ""
        self.add(name, expected, lambda: shown(getattr(settings(), name)), put, key=key)

    def rename(self, old: str, new: str) -> None:
        """Accept an old name as well, for one release."""
        self._renamed[old] = new

    def change(self, name: str, text: str) -> tuple[str, str]:
        """Set a parameter; return its old and new value. Raises Refused with what is expected."""
        name = name if name in self._known else self._renamed.get(name, name)
        if name not in self._known:
            near = difflib.get_close_matches(name, self._known, n=1, cutoff=0.5)
            hint = f"; did you mean {near[0]!r}?" if near else ";"
            raise Refused(f"no parameter {name!r}{hint} known: {listed(self._known)}")
        entry = self._known[name]
        before = entry.get()
        try:
            entry.put(text)
        except ValueError:  # msgspec.ValidationError is one
            raise Refused(f"{name}: expected {entry.expected}, got {text!r}") from None
        return before, entry.get()

    def all(self) -> tuple[Param, ...]:
        """Return all parameters with their current values."""
        return tuple(
            Param(
                name=name,
                value=entry.get(),
                expected=entry.expected,
                key=entry.key,
                initial=entry.initial,
            )
            for name, entry in self._known.items()
        )


def shown(value: object) -> str:
    """Return the value of a parameter as people type it."""
    if value is None:
        return "null"
    return f"{value:g}" if isinstance(value, float) else str(value)
