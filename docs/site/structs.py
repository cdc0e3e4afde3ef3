"""Tables of the fields of Structs: type, unit, default and comment, as they stand in the source."""

import ast
import functools
import importlib
import json
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import NODEFAULT, inspect

from gigabrain_schemas.base import Message

UNIT = re.compile(r"^\[([^\]]+)\][,;:]?\s*")
BOUNDS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
ATOMS = {
    "BoolType": "true or false",
    "BytesType": "bytes",
    "NoneType": "null",
    "AnyType": "anything",
}


Comments = dict[int, tuple[str, bool]]  # by line: the text, and whether it is alone


class Field(NamedTuple):
    """One field of a Struct."""

    name: str
    kind: str  # Markdown
    unit: str
    default: str
    about: str


def section(kind: type[msgspec.Struct], title: str = "", level: int = 2) -> Iterator[str]:
    """Yield the lines of a section about `kind`."""
    yield from ("", f"{'#' * level} {title or kind.__name__}", "", _sentences(kind), "")
    rows = list(fields(kind))
    if not rows:
        yield "It has no fields of its own."
        return
    yield from ("| field | type | unit | default | meaning |", "|---|---|---|---|---|")
    for one in rows:
        default = f"`{cell(one.default)}`" if one.default else "required"
        yield (f"| `{one.name}` | {cell(one.kind)} | {one.unit} | {default} | {cell(one.about)} |")


def fields(kind: type[msgspec.Struct]) -> Iterator[Field]:
    """Yield the fields of a Struct and of its bases, except those that every message has."""
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    types = {one.name: one.type for one in info.fields}
    written = {one.name: one.encode_name for one in info.fields}
    defaults = {one.name: _default(one) for one in info.fields}
    for base in reversed(kind.__mro__):
        if base is Message or not base.__module__.startswith("gigabrain_"):
            continue
        for name, comment in comments_of(base):
            if name in types:
                unit = UNIT.match(comment)
                about = comment[unit.end() :] if unit else comment
                about = about or _about(types[name])
                yield Field(
                    written[name],
                    text_of(types[name]),
                    unit[1] if unit else "",
                    defaults[name],
                    about,
                )


def header() -> Iterator[Field]:
    """Yield the fields that every message has."""
    info = inspect.type_info(Message)
    assert isinstance(info, inspect.StructType)
    comments = dict(comments_of(Message))
    for one in info.fields:
        yield Field(one.name, text_of(one.type), "", _default(one), comments[one.name])


def nested(kind: type[msgspec.Struct]) -> list[type[msgspec.Struct]]:
    """Return the Structs that the fields of `kind` hold, at any depth, in order of appearance."""
    found: dict[type, None] = {}

    def look(one: Any) -> None:
        if isinstance(one, inspect.StructType):
            if one.cls in found:
                return
            found[one.cls] = None
            for part in one.fields:
                look(part.type)
        for name in ("types", "item_types"):
            for part in getattr(one, name, ()):
                look(part)
        for name in ("item_type", "value_type"):
            if hasattr(one, name):
                look(getattr(one, name))

    look(inspect.type_info(kind))
    return list(found)[1:]


def text_of(one: Any) -> str:
    """Return a type in words, with its bounds; Structs are links."""
    name = type(one).__name__
    if name in ATOMS:
        return ATOMS[name]
    if isinstance(one, inspect.StructType):
        return f"[{one.cls.__name__}](#{anchor(one.cls.__name__)})"
    if isinstance(one, inspect.LiteralType):
        return ", ".join(f"`{value}`" for value in one.values)
    if isinstance(one, inspect.UnionType):
        return " or ".join(text_of(part) for part in one.types)
    if isinstance(one, inspect.DictType):
        return f"map of {text_of(one.value_type)}"
    if isinstance(one, inspect.TupleType):
        return f"({', '.join(text_of(part) for part in one.item_types)})"
    if hasattr(one, "item_type"):
        return f"list of {text_of(one.item_type)}"
    return {"IntType": "integer", "FloatType": "number"}.get(name, "text") + _bounds(one)


def _bounds(one: Any) -> str:
    limits = [
        f"{sign} {value:.7g}"
        for name, sign in BOUNDS.items()
        if (value := getattr(one, name, None)) is not None and abs(value) < 1e9
    ]
    longest = getattr(one, "max_length", None)
    return " " + ", ".join(limits) if limits else f" up to {longest}" if longest else ""


def comments_of(kind: type) -> Iterator[tuple[str, str]]:
    """Yield the name and the comment of each field in the body of a class."""
    path = Path(importlib.import_module(kind.__module__).__file__ or "")
    classes, comments = _source(path)
    node = classes.get(kind.__name__)
    for one in node.body if node else ():
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
            yield one.target.id, _comment(one, comments)


def _comment(one: ast.AnnAssign, comments: Comments) -> str:
    """Return the comment behind a field, or that below it with a unit, or that above it."""
    end = one.end_lineno or one.lineno
    behind = [comments[line][0] for line in range(one.lineno, end + 1) if line in comments]
    if behind:
        return " ".join(behind)

    def alone(line: int, step: int, *, unit: bool) -> Iterator[str]:
        while line in comments and comments[line][1] and comments[line][0].startswith("[") == unit:
            yield comments[line][0]
            line += step

    below = list(alone(end + 1, 1, unit=True))
    above = list(alone(one.lineno - 1, -1, unit=False))
    return " ".join(below or reversed(above))


def _default(one: inspect.Field) -> str:
    """Return a default as a reader of YAML knows it; empty for a field that is required."""
    if one.required:
        return ""
    value = one.default if one.default is not NODEFAULT else one.default_factory()
    if isinstance(value, msgspec.Struct):
        return "its defaults"
    return json.dumps(value, ensure_ascii=False, default=repr)


def _about(one: Any) -> str:
    """Return what a Struct is about, for a field without a comment of its own."""
    for part in (one, *getattr(one, "types", ())):
        if isinstance(part, inspect.StructType):
            return (part.cls.__doc__ or "").partition("\n")[0]
    return ""


@functools.cache
def _source(path: Path) -> tuple[dict[str, ast.ClassDef], Comments]:
    """Return the classes of a module, and its comments by line: text, and whether it is alone."""
    tree = ast.parse(path.read_text("utf-8"))
    with path.open("rb") as file:
        comments = {
            token.start[0]: (token.string.lstrip("# "), not token.line[: token.start[1]].strip())
            for token in tokenize.tokenize(file.readline)
            if token.type == tokenize.COMMENT
        }
    return {one.name: one for one in tree.body if isinstance(one, ast.ClassDef)}, comments


def _sentences(kind: type) -> str:
    return " ".join((kind.__doc__ or "").split())


def cell(text: str) -> str:
    """Return text that may stand in a cell of a table."""
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def anchor(heading: str) -> str:
    """Return the anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
