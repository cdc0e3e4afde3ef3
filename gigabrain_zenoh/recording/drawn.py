"""Parts of drawings for viewers: frames, poses, labels, and the schemas that viewers accept."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
from foxglove import Schema
from foxglove import messages as fox

from gigabrain_schemas.base import Message

MAP, ODOM, BASE = "map", "odom", "base_link"
LIDAR = "base_scan"  # as in LaserScan
BLUE = fox.Color(r=0.04, g=0.37, b=0.49, a=1.0)
LABEL_SIZE_M = 0.25
LAST_STAMP_NS = 2**32 * 1_000_000_000 - 1  # Foxglove's seconds have 32 bits

MAX_SCHEMA_DEPTH = 12  # a Struct may contain itself
SCALARS = {str: "string", bool: "boolean", int: "integer", float: "number"}
BOUNDS = ("type", "minimum", "exclusiveMinimum")


class Drawn(NamedTuple):
    """One encoded message for viewers."""

    topic: str
    encoding: str  # protobuf or json
    schema: Callable[[], Schema]
    data: bytes


def as_drawn(topic: str, message: Any) -> Drawn:
    """Encode a message of Foxglove's schemas for a recording or a viewer."""
    return Drawn(f"/viz/{topic}", "protobuf", type(message).get_schema, message.encode())


def stamp(message: Message) -> fox.Timestamp:
    """Return the stamp of `message`."""
    return fox.Timestamp(message.stamp_ns // 1_000_000_000, message.stamp_ns % 1_000_000_000)


def quaternion(yaw: float) -> fox.Quaternion:
    """Return a heading [rad] as a quaternion."""
    return fox.Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def pose_of(x: float, y: float, yaw: float, z: float = 0.0) -> fox.Pose:
    """Return an upright pose [m, m, rad, m]."""
    return fox.Pose(position=fox.Vector3(x=x, y=y, z=z), orientation=quaternion(yaw))


def label(x: float, y: float, text: str, z: float = 0.0) -> fox.TextPrimitive:
    """Return a text that faces the viewer, at a place [m]."""
    return fox.TextPrimitive(
        pose=pose_of(x, y, 0.0, z), billboard=True, font_size=LABEL_SIZE_M, color=BLUE, text=text
    )


class KnownEntities:
    """Remembers the entities of a scene, to delete those that are gone."""

    def __init__(self) -> None:
        self._ids: set[str] = set()

    def update(self, at: Message, entities: dict[str, fox.SceneEntity]) -> fox.SceneUpdate:
        """Return an update that draws `entities` (by id), and deletes the other known ones."""
        gone = [
            fox.SceneEntityDeletion(
                timestamp=stamp(at), type=fox.SceneEntityDeletionType.MatchingId, id=name
            )
            for name in sorted(self._ids - set(entities))
        ]
        self._ids = set(entities)
        return fox.SceneUpdate(entities=list(entities.values()), deletions=gone)


def json_schema(kind: type[Message]) -> Schema:
    """Return the schema of a message type in the form that viewers accept."""
    return Schema(name=f"gigabrain.{kind.__name__}", encoding="jsonschema", data=flat_schema(kind))


def flat_schema(message: type[msgspec.Struct]) -> bytes:
    """Return the JSON Schema of `message` in the flat form that Foxglove and Lichtblick accept.

    They refuse `$ref`, `$defs`, `anyOf`, an `enum` without `type`, and arrays of arrays. One such
    property makes them ignore the whole channel, so it is left out of the schema.
    """
    whole = msgspec.json.schema(message)
    parts = whole.pop("$defs", {})
    flat = _flat(whole, parts, 0, item=False) or {"type": "object"}
    return msgspec.json.encode({"title": message.__name__, **flat})


def _flat(
    part: dict[str, Any], parts: dict[str, Any], depth: int, *, item: bool
) -> dict[str, Any] | None:
    """Return the flat schema of one property; None if viewers would refuse it."""
    if depth > MAX_SCHEMA_DEPTH:
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
