"""JSON Schema of a message in the flat form that Foxglove and Lichtblick accept.

They refuse `$ref`, `$defs`, `anyOf`, an `enum` without `type` and arrays of arrays, and one
property that they refuse loses the whole channel. What cannot be said flatly is left out of the
schema; the data carries it all the same.
"""

from typing import Any

import msgspec

DEEPEST = 12  # a Struct that holds itself would go on for ever
SCALARS = {str: "string", bool: "boolean", int: "integer", float: "number"}
BOUNDS = ("type", "minimum", "exclusiveMinimum")


def flat_schema(message: type[msgspec.Struct]) -> bytes:
    """The schema of `message`, as JSON."""
    whole = msgspec.json.schema(message)
    parts = whole.pop("$defs", {})
    flat = _flat(whole, parts, 0, item=False) or {"type": "object"}
    return msgspec.json.encode({"title": message.__name__, **flat})


def _flat(
    part: dict[str, Any], parts: dict[str, Any], depth: int, *, item: bool
) -> dict[str, Any] | None:
    """One property; None where it has to be left out."""
    if depth > DEEPEST:
        return None
    if "$ref" in part:
        return _flat(parts[part["$ref"].rsplit("/", 1)[-1]], parts, depth + 1, item=item)
    if "anyOf" in part:  # `X | None` becomes X
        kinds = [kind for kind in part["anyOf"] if kind.get("type") != "null"]
        return _flat(kinds[0], parts, depth + 1, item=item) if len(kinds) == 1 else None
    kind = part.get("type")
    if "enum" in part:
        return {"type": kind or SCALARS[type(part["enum"][0])]}
    if kind in SCALARS.values():
        kept = BOUNDS if item else (*BOUNDS, "contentEncoding")
        return {name: part[name] for name in kept if name in part}
    if kind == "array" and not item:
        return _array(part, parts, depth)
    if kind == "object":
        return _object(part, parts, depth)
    return None


def _array(part: dict[str, Any], parts: dict[str, Any], depth: int) -> dict[str, Any] | None:
    items = part.get("items") or (part.get("prefixItems") or [None])[0]
    inner = _flat(items, parts, depth + 1, item=True) if isinstance(items, dict) else None
    return inner and {"type": "array", "items": inner}


def _object(part: dict[str, Any], parts: dict[str, Any], depth: int) -> dict[str, Any]:
    properties = part.get("properties", {}).items()
    flat = {name: _flat(value, parts, depth + 1, item=False) for name, value in properties}
    return {"type": "object", "properties": {name: value for name, value in flat.items() if value}}
