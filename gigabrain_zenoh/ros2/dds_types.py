"""ROS types as cyclonedds knows them, made from the definitions of rosbags.

Only their layout is used: cyclonedds checks received samples by it and announces it to peers that
compare types. Samples go in and out as CDR.
"""

from collections.abc import Callable
from typing import Any

import cyclonedds.idl.types as idl
from cyclonedds.idl import make_idl_struct
from rosbags.interfaces import Nodetype

from gigabrain_zenoh.ros2.transport import dds_type
from gigabrain_zenoh.ros2.type_files import Description, Fields

of: Any = idl  # its array and sequence take types in brackets, though they are not generic
PRIMITIVES: dict[str, Any] = {
    "bool": bool,
    "char": idl.uint8,
    "byte": idl.uint8,
    "int8": idl.int8,
    "uint8": idl.uint8,
    "int16": idl.int16,
    "uint16": idl.uint16,
    "int32": idl.int32,
    "uint32": idl.uint32,
    "int64": idl.int64,
    "uint64": idl.uint64,
    "float32": idl.float32,
    "float64": idl.float64,
    "string": str,
}


class IdlTypes:
    """Makes each type once."""

    def __init__(self, fields_of: Callable[[str], Fields]) -> None:
        self._fields_of = fields_of
        self._made: dict[str, Any] = {}

    def struct(self, name: str) -> Any:
        """Return the type of a message. Raises what `fields_of` raises."""
        if name not in self._made:
            fields = {field: self._element(kind) for field, kind in self._fields_of(name)}
            whole = dds_type(name).replace("::", ".")
            self._made[name] = make_idl_struct(whole.rpartition(".")[2], whole, fields)
        return self._made[name]

    def _element(self, kind: Description) -> Any:
        if kind[0] == Nodetype.NAME:
            return self.struct(kind[1])
        if kind[0] == Nodetype.BASE:
            primitive, longest = kind[1]
            return of.bounded_str[longest] if longest else PRIMITIVES[primitive]
        inner, size = kind[1]
        element = self._element(inner)
        if kind[0] == Nodetype.ARRAY:
            return of.array[element, size]
        return of.sequence[element, size] if size else of.sequence[element]
